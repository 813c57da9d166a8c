//! An inspection as one HTML page that needs no other file: pictures are in it as PNG, charts as SVG.

use std::fmt::Write as _;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;

use super::channels::ChannelSummary;
use super::charts::{self, Mark, number};
use super::delays::ActionDelay;
use super::findings::Inspection;
use super::places::{FramePlace, counted};
use crate::dataset::{Dataset, DatasetError};
use foreframe_core::frame::codec;

const STYLE: &str = include_str!("page.css");
/// Pictures of frozen frames and exposure jumps, at most.
const SHOWN_PLACES: usize = 8;

/// The page. `dataset` is the one that was inspected. Errors: `Encode` if a picture cannot be written.
pub fn page(inspection: &Inspection, dataset: &Dataset) -> Result<String, DatasetError> {
    let mut body = header(inspection);
    body += &warnings(inspection);
    body += &contact_sheet(inspection, dataset)?;
    body += &images(inspection, dataset);
    body += &places(inspection, dataset)?;
    body += &channels(inspection);
    body += &delays(inspection);
    body += &times(inspection);
    let name = escaped(&inspection.name);
    Ok(format!(
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\"><meta name=\"viewport\" \
         content=\"width=device-width,initial-scale=1\"><title>{name} – data set</title><style>\n{STYLE}</style></head>\n\
         <body>\n{body}<footer>Made by <code>foreframe inspect</code> {}. Content SHA-256 <code>{}</code></footer>\n</body></html>\n",
        env!("CARGO_PKG_VERSION"),
        escaped(&inspection.content_hash)
    ))
}

fn header(inspection: &Inspection) -> String {
    let timing = &inspection.timing;
    let origin = inspection.scenario.as_ref().map_or_else(
        || "A recording".to_owned(),
        |scenario| format!("Simulated: {}", escaped(scenario)),
    );
    let tiles = [
        (inspection.frame_count.to_string(), "frames"),
        (inspection.episode_count.to_string(), "episodes"),
        (duration(timing.total_s), "recorded"),
        (number(1.0 / timing.frame_period_s), "frames per second"),
        (
            format!("{}×{}", inspection.frame_width_px, inspection.frame_height_px),
            "pixels, gray",
        ),
        (inspection.warnings.len().to_string(), "warnings"),
    ];
    let tiles: Vec<String> = tiles
        .iter()
        .map(|(value, what)| format!("<div><b>{value}</b><span>{what}</span></div>"))
        .collect();
    let tiles = tiles.concat();
    format!(
        "<header><h1>{}</h1><p class=\"quiet\">{origin}. Episodes of {} to {} frames, median {}.</p></header>\n\
         <div class=\"tiles\">{tiles}</div>\n",
        escaped(&inspection.name),
        timing.shortest_episode_frames,
        timing.longest_episode_frames,
        timing.median_episode_frames
    )
}

/// Minutes and seconds, or hours and minutes.
pub(super) fn duration(seconds: f64) -> String {
    let whole = seconds.round() as u64;
    match whole {
        0..60 => format!("{seconds:.1} s"),
        60..3600 => format!("{} min {} s", whole / 60, whole % 60),
        _ => format!("{} h {} min", whole / 3600, whole % 3600 / 60),
    }
}

fn warnings(inspection: &Inspection) -> String {
    if inspection.warnings.is_empty() {
        return "<p class=\"fine\">Nothing in this data set looks wrong.</p>\n".to_owned();
    }
    let items = inspection.warnings.iter();
    let items: Vec<String> = items.map(|warning| format!("<li>{}</li>", escaped(warning))).collect();
    format!("<h2>Warnings</h2><ul class=\"warnings\">{}</ul>\n", items.concat())
}

fn contact_sheet(inspection: &Inspection, dataset: &Dataset) -> Result<String, DatasetError> {
    let mut figures = String::new();
    for &place in &inspection.contact_sheet {
        let _ = write!(
            figures,
            "<figure>{}<figcaption>episode {}, {}</figcaption></figure>",
            picture(dataset, place)?,
            place.episode,
            duration(time_s(dataset, place))
        );
    }
    Ok(format!("<h2>Contact sheet</h2><div class=\"sheet\">{figures}</div>\n"))
}

/// The frame's number in the data set.
fn index(dataset: &Dataset, place: FramePlace) -> usize {
    let episode = dataset.episodes().get(place.episode);
    episode.map_or(0, |episode| episode.first_frame + place.frame)
}

fn time_s(dataset: &Dataset, place: FramePlace) -> f64 {
    dataset.timestamp_s(index(dataset, place))
}

fn picture(dataset: &Dataset, place: FramePlace) -> Result<String, DatasetError> {
    let frame = dataset.frame(index(dataset, place))?;
    let png = codec::encode_png(&frame).map_err(DatasetError::Encode)?;
    Ok(format!(
        "<img alt=\"\" src=\"data:image/png;base64,{}\">",
        STANDARD.encode(png)
    ))
}

fn images(inspection: &Inspection, dataset: &Dataset) -> String {
    let images = &inspection.images;
    let part = |place: FramePlace| index(dataset, place) as f64 / inspection.frame_count.max(1) as f64;
    let jumps = images.exposure_jumps.iter().map(|jump| Mark {
        at: part(jump.place),
        title: format!(
            "exposure jump, episode {} frame {}",
            jump.place.episode, jump.place.frame
        ),
    });
    let frozen = images.frozen.iter().map(|span| Mark {
        at: part(span.first),
        title: format!(
            "{} equal frames, episode {} frame {}",
            span.frames, span.first.episode, span.first.frame
        ),
    });
    let marks: Vec<Mark> = jumps.chain(frozen).collect();
    let facts = facts(&[
        ("mean gray level", number(images.mean_level)),
        ("mean change to the next frame", number(images.mean_change)),
        ("black pixels", percent(images.black_share)),
        ("white pixels", percent(images.white_share)),
        ("repeated frames", images.repeated_frames.len().to_string()),
        ("frozen places", images.frozen.len().to_string()),
        ("exposure jumps", images.exposure_jumps.len().to_string()),
    ]);
    format!(
        "<h2>Images</h2><p class=\"quiet\">Mean gray level (0 to 255) of the frames over the whole data set. Red lines: frozen \
         frames and exposure jumps.</p>{}<div class=\"ends\"><span>first frame</span><span>last frame</span></div>\
         <div class=\"cards\" style=\"margin-top:1rem\"><div class=\"card\"><h3>Gray levels</h3>{}<div class=\"ends\">\
         <span>0</span><span>255</span></div></div><div class=\"card\"><h3>In numbers</h3>{facts}</div></div>\n",
        charts::timeline(&images.timeline, &marks),
        charts::bars(&images.level_counts)
    )
}

fn percent(share: f64) -> String {
    format!("{:.1} %", 100.0 * share)
}

fn facts(facts: &[(&str, String)]) -> String {
    let items = facts.iter();
    let items: Vec<String> = items
        .map(|(what, value)| format!("<dt>{what}</dt><dd>{value}</dd>"))
        .collect();
    format!("<dl>{}</dl>", items.concat())
}

/// Pictures of the first frozen frames and exposure jumps, with the frame before each.
fn places(inspection: &Inspection, dataset: &Dataset) -> Result<String, DatasetError> {
    let images = &inspection.images;
    let frozen = images.frozen.iter().map(|span| {
        let what = format!("{} equal frames", span.frames);
        (span.first, span.frames - 1, what)
    });
    let jumps = images.exposure_jumps.iter().map(|jump| {
        let what = format!("exposure {:.0} → {:.0}", jump.from_level, jump.to_level);
        (before(jump.place), 1, what)
    });
    let mut cards = String::new();
    for (place, length, what) in frozen.take(SHOWN_PLACES).chain(jumps.take(SHOWN_PLACES)) {
        let last = FramePlace {
            frame: place.frame + length,
            ..place
        };
        let _ = write!(
            cards,
            "<div class=\"place\"><p>{what}<br>episode {}, frames {} and {}</p><div>{}{}</div></div>",
            place.episode,
            place.frame,
            last.frame,
            picture(dataset, place)?,
            picture(dataset, last)?
        );
    }
    if cards.is_empty() {
        return Ok(cards);
    }
    Ok(format!(
        "<h2>Frozen frames and exposure jumps</h2><div class=\"places\">{cards}</div>\n"
    ))
}

fn before(place: FramePlace) -> FramePlace {
    FramePlace {
        frame: place.frame.saturating_sub(1),
        ..place
    }
}

fn channels(inspection: &Inspection) -> String {
    if inspection.channels.is_empty() {
        return "<h2>Actions and states</h2><p>None: only images were recorded.</p>\n".to_owned();
    }
    let cards: String = inspection.channels.iter().map(channel).collect();
    format!("<h2>Actions and states</h2><div class=\"cards\">{cards}</div>\n")
}

fn channel(channel: &ChannelSummary) -> String {
    format!(
        "<div class=\"card\"><h3>{} <span class=\"quiet\">{}</span></h3>{}{}</div>",
        escaped(&channel.name),
        channel.role,
        charts::histogram(&channel.histogram, &escaped(&channel.unit)),
        facts(&[
            ("mean", number(channel.mean)),
            ("standard deviation", number(channel.std)),
            (
                "commonest value",
                format!("{} ({})", number(channel.commonest), percent(channel.commonest_share)),
            ),
        ])
    )
}

fn delays(inspection: &Inspection) -> String {
    if inspection.delays.is_empty() {
        return String::new();
    }
    let card = |delay: &ActionDelay| {
        let found = delay.delay_frames.map_or_else(
            || "too little correlation to say".to_owned(),
            |frames| {
                format!(
                    "{frames:+.1} frames ({:+.2} s)",
                    frames * inspection.timing.frame_period_s
                )
            },
        );
        format!(
            "<div class=\"card\"><h3>{} <span class=\"quiet\">→ {}</span></h3>{}{}</div>",
            escaped(&delay.action),
            delay.motion,
            charts::lags(&delay.lags, delay.delay_frames),
            facts(&[
                ("delay", found),
                ("correlation there", number(delay.correlation)),
                ("without a lag", number(delay.correlation_without_lag)),
            ])
        )
    };
    let cards: String = inspection.delays.iter().map(card).collect();
    format!(
        "<h2>From action to motion</h2><p class=\"quiet\">Correlation of each action with the image's motion, by lag. A \
         positive delay: the image follows the action.</p><div class=\"cards\">{cards}</div>\n"
    )
}

fn times(inspection: &Inspection) -> String {
    let timing = &inspection.timing;
    let ms = |seconds: f64| format!("{:.1} ms", seconds * 1e3);
    let mut text = format!(
        "<h2>Times</h2><div class=\"cards\"><div class=\"card\"><h3>From frame to frame</h3>{}</div><div class=\"card\">\
         <h3>In numbers</h3>{}</div></div>",
        charts::histogram(&timing.step_ms_histogram, "ms"),
        facts(&[
            ("frame period", ms(timing.frame_period_s)),
            ("median step", ms(timing.median_step_s)),
            ("shortest step", ms(timing.shortest_step_s)),
            ("longest step", ms(timing.longest_step_s)),
            (
                "irregular steps",
                format!("{} of {}", timing.irregular_steps, timing.steps)
            ),
            ("gaps within episodes", timing.gaps.len().to_string()),
        ])
    );
    let shown = timing.gaps.iter().take(SHOWN_PLACES).map(|gap| {
        format!(
            "<li>{:.2} s after episode {} frame {}</li>",
            gap.seconds, gap.before.episode, gap.before.frame
        )
    });
    let shown: String = shown.collect();
    if !shown.is_empty() {
        let _ = write!(
            text,
            "<p>{}, of which:</p><ul>{shown}</ul>",
            counted(timing.gaps.len(), "gap")
        );
    }
    text + "\n"
}

/// The text with the characters that HTML reads as markup replaced.
fn escaped(text: &str) -> String {
    text.replace('&', "&amp;")
        .replace('<', "&lt;")
        .replace('>', "&gt;")
        .replace('"', "&quot;")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_cannot_add_markup() {
        assert_eq!(escaped("<b title=\"&\">"), "&lt;b title=&quot;&amp;&quot;&gt;");
    }

    #[test]
    fn durations_are_read_at_a_glance() {
        assert_eq!(
            [9.04, 150.0, 7300.0].map(duration),
            ["9.0 s", "2 min 30 s", "2 h 1 min"]
        );
    }
}
