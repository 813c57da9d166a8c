//! Several data sets as one, each with its share of the training windows.

use sha2::{Digest, Sha256};

use super::frame_store::{FrameContent, FrameStore, JoinedStore};
use super::{Dataset, DatasetError, DatasetInfo, DatasetPart, Episode};
use foreframe_core::error_text::comma_separated;
use foreframe_core::types::Channel;

/// Frame periods may differ by this factor: cameras are not exact.
const MAX_PERIOD_RATIO: f64 = 1.1;

/// What becomes of a channel or of masks that a data set lacks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Lacking {
    /// A channel is refused; masks count only where all have them.
    Refused,
    /// The values are NaN, and masks count where there are some.
    NotKnown,
}

impl Dataset {
    /// Joins data sets, each with its weight: the share of a part is its weight over the sum of all. Frame size, frame period
    /// and channels are those of the first. The channels of the others are found by name and unit; those that the first does
    /// not have are left out. One data set stays as it is. Errors: `Usage` if there is none, a
    /// weight is not above 0, a data set occurs twice, or sizes, periods or channels do not fit.
    #[doc(hidden)]
    pub fn join(mut weighted: Vec<(Self, f64)>, lacking: Lacking) -> Result<Self, DatasetError> {
        check_weights(&weighted)?;
        if weighted.len() == 1 {
            return Ok(weighted.swap_remove(0).0);
        }
        let first = weighted
            .first()
            .map(|(dataset, _)| dataset.info.clone())
            .unwrap_or_default();
        let sum: f64 = weighted.iter().map(|(_, weight)| weight).sum();
        let (mut parts, mut episodes, mut stores) = (Vec::new(), Vec::new(), Vec::new());
        let mut content = FrameContent::default();
        let mut hasher = Sha256::new();
        for (dataset, weight) in weighted {
            check_fit(&first, &dataset.info, lacking)?;
            let (from, first_frame) = (episodes.len(), content.timestamps_s.len());
            hasher.update(format!("{} {}\n", dataset.info.content_hash, weight / sum));
            let frames = dataset.info.frame_count;
            content.append(FrameContent {
                actions: reordered(
                    &dataset.actions,
                    frames,
                    &dataset.info.action_channels,
                    &first.action_channels,
                ),
                states: reordered(
                    &dataset.states,
                    frames,
                    &dataset.info.state_channels,
                    &first.state_channels,
                ),
                timestamps_s: dataset.timestamps_s,
                ..FrameContent::default()
            });
            episodes.extend(dataset.episodes.into_iter().map(|episode| Episode {
                index: from + episode.index,
                first_frame: first_frame + episode.first_frame,
                ..episode
            }));
            stores.push(JoinedStore {
                first_frame,
                frame_count: dataset.info.frame_count,
                has_masks: dataset.info.has_masks,
                images: dataset.images,
            });
            parts.push(DatasetPart {
                info: dataset.info,
                episodes: from..episodes.len(),
                share: weight / sum,
            });
        }
        let counts = [content.timestamps_s.len(), episodes.len()];
        let info = joined_info(first, &parts, lacking, counts, format!("{:x}", hasher.finalize()));
        Ok(Self {
            info,
            parts,
            episodes,
            images: FrameStore::Joined(stores),
            actions: content.actions,
            states: content.states,
            timestamps_s: content.timestamps_s,
        })
    }
}

/// The description of the whole: that of the first part, with these numbers of frames and episodes.
fn joined_info(
    first: DatasetInfo,
    parts: &[DatasetPart],
    lacking: Lacking,
    [frame_count, episode_count]: [usize; 2],
    content_hash: String,
) -> DatasetInfo {
    let names: Vec<&str> = parts.iter().map(|part| part.info.name.as_str()).collect();
    DatasetInfo {
        name: names.join("+"),
        has_masks: match lacking {
            Lacking::Refused => parts.iter().all(|part| part.info.has_masks),
            Lacking::NotKnown => parts.iter().any(|part| part.info.has_masks),
        },
        camera: first
            .camera
            .filter(|camera| parts.iter().all(|part| part.info.camera == Some(*camera))),
        content_hash,
        frame_count,
        episode_count,
        ..first
    }
}

fn check_weights(weighted: &[(Dataset, f64)]) -> Result<(), DatasetError> {
    if weighted.is_empty() {
        return Err(DatasetError::Usage(
            "there is no data set to join; name at least one".to_owned(),
        ));
    }
    for (place, (dataset, weight)) in weighted.iter().enumerate() {
        let name = &dataset.info.name;
        if !(weight.is_finite() && *weight > 0.0) {
            return Err(DatasetError::Usage(format!(
                "the weight of \"{name}\" is {weight}; it must be above 0"
            )));
        }
        let is_same = |(other, _): &(Dataset, f64)| other.info.content_hash == dataset.info.content_hash;
        if let Some((other, _)) = weighted[..place].iter().find(|other| is_same(other)) {
            return Err(DatasetError::Usage(format!(
                "the data sets \"{}\" and \"{name}\" have the same content; name one of them, with a larger weight",
                other.info.name
            )));
        }
    }
    Ok(())
}

/// Errors: `Usage` if frames of `other` cannot stand beside those of `first`.
fn check_fit(first: &DatasetInfo, other: &DatasetInfo, lacking: Lacking) -> Result<(), DatasetError> {
    let size = |info: &DatasetInfo| format!("{}×{} px", info.frame_width_px, info.frame_height_px);
    if size(first) != size(other) {
        return Err(DatasetError::Usage(format!(
            "\"{}\" has frames of {}, and \"{}\" of {}; import or collect it with the same size",
            first.name,
            size(first),
            other.name,
            size(other)
        )));
    }
    let ratio = first.frame_period_s / other.frame_period_s;
    if !(1.0 / MAX_PERIOD_RATIO..=MAX_PERIOD_RATIO).contains(&ratio) {
        return Err(DatasetError::Usage(format!(
            "\"{}\" has a frame every {} s, and \"{}\" every {} s; import or collect it with the same frame period",
            first.name, first.frame_period_s, other.name, other.frame_period_s
        )));
    }
    if lacking == Lacking::NotKnown {
        return Ok(());
    }
    let kinds = [
        ("action", &first.action_channels, &other.action_channels),
        ("state", &first.state_channels, &other.state_channels),
    ];
    for (kind, expected, found) in kinds {
        if let Some(missing) = expected.iter().find(|channel| place_of(found, channel).is_none()) {
            return Err(DatasetError::Usage(format!(
                "\"{}\" lacks the {kind} channel {missing} of \"{}\"; it has {}",
                other.name,
                first.name,
                if found.is_empty() {
                    "none".to_owned()
                } else {
                    comma_separated(found)
                }
            )));
        }
    }
    Ok(())
}

/// Where a channel of this name and unit stands.
fn place_of(channels: &[Channel], wanted: &Channel) -> Option<usize> {
    let is_same = |channel: &Channel| channel.name == wanted.name && channel.unit == wanted.unit;
    channels.iter().position(is_same)
}

/// The values of so many frames, whose channels are `found`, with the channels of `expected`; NaN for those that are not there.
fn reordered(values: &[f32], frames: usize, found: &[Channel], expected: &[Channel]) -> Vec<f32> {
    let places: Vec<Option<usize>> = expected.iter().map(|channel| place_of(found, channel)).collect();
    let row = |frame: usize| &values[frame * found.len()..(frame + 1) * found.len()];
    (0..frames)
        .flat_map(|frame| {
            places
                .iter()
                .map(move |place| place.map_or(f32::NAN, |place| row(frame)[place]))
        })
        .collect()
}
