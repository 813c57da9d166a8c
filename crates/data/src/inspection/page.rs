//! An inspection as one HTML page that needs no other file: pictures are in it as PNG, charts as SVG. The template is
//! `page.html`; it escapes all text of the data set.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use minijinja::{Environment, context};
use serde::Serialize;

use super::findings::Inspection;
use super::numbers::{duration, number};
use super::places::FramePlace;
use crate::dataset::{Dataset, DatasetError};
use foreframe_core::frame::codec;

/// Pictures of frozen frames and exposure jumps, at most.
const SHOWN_PLACES: usize = 8;

/// A frame on the page.
#[derive(Serialize)]
struct Picture {
    place: FramePlace,
    time_s: f64,
    /// The image, in Base64.
    png: String,
}

/// The page. `dataset` is the one that was inspected. Errors: `Encode` if a picture cannot be written.
pub fn page(inspection: &Inspection, dataset: &Dataset) -> Result<String, DatasetError> {
    let mut environment = Environment::new();
    environment.add_filter("number", number);
    environment.add_filter("duration", duration);
    environment.add_filter("fixed", |value: f64, digits: usize| format!("{value:.digits$}"));
    environment.add_filter("signed", |value: f64, digits: usize| format!("{value:+.digits$}"));
    let picture = |place| picture(dataset, place);
    let pair = |first: FramePlace, frames: usize| {
        let frame = first.frame + frames;
        Ok([picture(first)?, picture(FramePlace { frame, ..first })?])
    };
    let contact_sheet: Result<Vec<_>, _> = inspection.contact_sheet.iter().copied().map(picture).collect();
    let frozen = inspection.images.frozen.iter().take(SHOWN_PLACES);
    let frozen: Result<Vec<_>, DatasetError> = frozen.map(|span| pair(span.first, span.frames - 1)).collect();
    let jumps = inspection.images.exposure_jumps.iter().take(SHOWN_PLACES);
    let jumps = jumps.map(|jump| pair(jump.place.before(), 1));
    let content = context! {
        inspection,
        style => include_str!("page.css"),
        version => env!("CARGO_PKG_VERSION"),
        shown => SHOWN_PLACES,
        parts => inspection.images.timeline,
        first_frames => dataset.episodes().iter().map(|episode| episode.first_frame).collect::<Vec<_>>(),
        motions => inspection.delays.iter().map(|delay| delay.motion.to_string()).collect::<Vec<_>>(),
        contact_sheet => contact_sheet?,
        frozen => frozen?,
        exposure_jumps => jumps.collect::<Result<Vec<_>, DatasetError>>()?,
    };
    let page = environment.render_named_str("page.html", include_str!("page.html"), content);
    Ok(page.expect("an inspection that the template cannot show is a bug"))
}

fn picture(dataset: &Dataset, place: FramePlace) -> Result<Picture, DatasetError> {
    let episode = dataset.episodes().get(place.episode);
    let index = episode.map_or(0, |episode| episode.first_frame + place.frame);
    let png = codec::encode_png(&dataset.frame(index)?)?;
    Ok(Picture {
        place,
        time_s: dataset.timestamp_s(index),
        png: STANDARD.encode(png),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::{DatasetInfo, EpisodeData};
    use crate::inspection::inspect;

    #[test]
    fn names_cannot_add_markup() {
        let info = DatasetInfo {
            name: "<b title=\"&\">".to_owned(),
            frame_width_px: 4,
            frame_height_px: 1,
            frame_period_s: 0.1,
            ..DatasetInfo::default()
        };
        let episode = EpisodeData {
            pixels: vec![7; 4],
            timestamps_s: vec![0.0],
            ..EpisodeData::default()
        };
        let dataset = Dataset::from_episodes(info, vec![episode]).unwrap();
        let page = page(&inspect(&dataset).unwrap(), &dataset).unwrap();
        assert!(page.contains("<h1>&lt;b title=&quot;&amp;&quot;&gt;</h1>"), "{page}");
        assert!(!page.contains("NaN"), "{page}");
    }
}
