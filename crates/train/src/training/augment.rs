//! Changes of training windows that a robot could have seen as well: mirrored (all of it, or what moves), played
//! backwards, brighter, darker, nearer.

use rand::Rng;

use super::TrainError;
use super::config::{DataConfig, Mirror};
use foreframe_core::frame::warp::sample;
use foreframe_core::types::Seed;
use foreframe_data::dataset::background::{Background, MAX_CHANGED_SHARE};
use foreframe_data::dataset::{Dataset, DatasetInfo};

/// What of half of the windows is mirrored.
#[derive(Clone, Debug, PartialEq)]
enum Mirroring {
    Nothing,
    /// Whole frames. The sign of these channels of actions and of states changes.
    Frames([Vec<usize>; 2]),
    /// What differs from this background, 0 to 255.
    Movers(Vec<u8>),
}

/// What a window hides from the network.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Hidden {
    Nothing,
    States,
    /// States and actions.
    All,
}

/// The kinds of channels.
pub(super) const ACTION: usize = 0;
pub(super) const STATE: usize = 1;

/// How training windows are changed; drawn anew for each window of each step.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Augmentation {
    mirror: Mirroring,
    /// Whether half of the windows are played backwards.
    reverse: bool,
    /// The largest relative change of brightness.
    brightness: f32,
    /// The largest share of each side that is cut off.
    crop: f32,
    /// The share of windows that hide states or more.
    hidden: f32,
    seed: Seed,
}

/// The part of a frame that is enlarged to the whole.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct FramePart {
    /// Width and height, as a share of the frame's, above 0, at most 1.
    pub(super) side: f32,
    /// Where it lies between the left and the right border, 0 to 1.
    pub(super) across: f32,
    /// Where it lies between the upper and the lower border, 0 to 1.
    pub(super) down: f32,
}

impl FramePart {
    /// The part of a frame, enlarged to the frame's size. Pixels between those of the frame are interpolated.
    fn enlarge(self, values: &mut [f32], width: usize) {
        let height = values.len() / width;
        let place = |index: usize, length: usize, at: f32| {
            at * (1.0 - self.side) * length as f32 + (index as f32 + 0.5) * self.side
        };
        let across = |index| place(index % width, width, self.across);
        let down = |index| place(index / width, height, self.down);
        let grid: Vec<[f32; 2]> = (0..values.len()).map(|index| [across(index), down(index)]).collect();
        values.copy_from_slice(&sample(values, width, height, &grid).0);
    }
}

/// The change of one window.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct WindowChange {
    pub(super) is_frame_mirrored: bool,
    /// Whether what moves is mirrored, in front of the background, which stays.
    pub(super) are_movers_mirrored: bool,
    /// Whether the window is played backwards.
    pub(super) is_reversed: bool,
    /// Factor of all intensities.
    pub(super) gain: f32,
    /// The part that is seen, after mirroring; `None` for all of it.
    pub(super) part: Option<FramePart>,
    pub(super) hidden: Hidden,
}

impl WindowChange {
    /// No change.
    pub(super) const NONE: Self = Self {
        is_frame_mirrored: false,
        are_movers_mirrored: false,
        is_reversed: false,
        gain: 1.0,
        part: None,
        hidden: Hidden::Nothing,
    };

    /// Changes a frame's intensities, 0 to 1, row by row; `inverted` ones if the model inverts.
    pub(super) fn apply(self, values: &mut [f32], width: usize, is_inverted: bool) {
        if self.is_frame_mirrored {
            values.chunks_exact_mut(width).for_each(<[f32]>::reverse);
        }
        if let Some(part) = self.part {
            part.enlarge(values, width);
        }
        if self.gain == 1.0 {
            return;
        }
        for value in values {
            let intensity = if is_inverted { 1.0 - *value } else { *value };
            let changed = (intensity * self.gain).clamp(0.0, 1.0);
            *value = if is_inverted { 1.0 - changed } else { changed };
        }
    }
}

impl Augmentation {
    /// As the settings say, for these training frames. Errors: `Config` for a channel that the data set does not have, for parts
    /// of frames whose camera model is known, and for movers in front of a camera that moves; those of [`Dataset::pixels`].
    pub(super) fn new(
        config: &DataConfig,
        dataset: &Dataset,
        frames: &[usize],
        seed: Seed,
    ) -> Result<Self, TrainError> {
        let info = dataset.info();
        let mut episodes = dataset.episodes().iter();
        if config.crop > 0.0 && episodes.any(|episode| dataset.camera(episode.index).is_some()) {
            return Err(TrainError::Config(format!(
                "data.crop is {}; it must be 0 for a data set with a camera model, which a part of the frame does not fit",
                config.crop
            )));
        }
        Ok(Self {
            mirror: match &config.mirror {
                Mirror::Off => Mirroring::Nothing,
                Mirror::Movers => Mirroring::Movers(standing_background(dataset, frames)?),
                Mirror::Channels(names) => Mirroring::Frames(signed_channels(names, info)?),
            },
            reverse: config.reverse,
            brightness: config.brightness as f32,
            crop: config.crop as f32,
            hidden: config.hidden as f32,
            seed: seed.derive("augment", 0),
        })
    }

    /// The change of the window at this position of this step's batch.
    pub(super) fn draw(&self, step: usize, position: usize) -> WindowChange {
        if self.mirror == Mirroring::Nothing
            && !self.reverse
            && self.brightness == 0.0
            && self.crop == 0.0
            && self.hidden == 0.0
        {
            return WindowChange::NONE;
        }
        let seed = self.seed.derive("step", step as u64).derive("window", position as u64);
        let mut rng = seed.rng();
        let is_mirrored = rng.random::<bool>();
        WindowChange {
            is_frame_mirrored: is_mirrored && matches!(self.mirror, Mirroring::Frames(_)),
            are_movers_mirrored: is_mirrored && matches!(self.mirror, Mirroring::Movers(_)),
            gain: 1.0 + self.brightness * rng.random_range(-1.0f32..=1.0),
            part: (self.crop > 0.0).then(|| FramePart {
                side: 1.0 - self.crop * rng.random::<f32>(),
                across: rng.random(),
                down: rng.random(),
            }),
            // Drawn last: whether they are set does not change what else is drawn.
            is_reversed: self.reverse && rng.random::<bool>(),
            hidden: match self.hidden > 0.0 && rng.random::<f32>() < self.hidden {
                false => Hidden::Nothing,
                true if rng.random::<bool>() => Hidden::States,
                true => Hidden::All,
            },
        }
    }

    /// Changes the sign of the channels of an action or a state, as a mirror does.
    pub(super) fn turn_signs(&self, kind: usize, values: &mut [f32]) {
        let Mirroring::Frames(channels) = &self.mirror else {
            return;
        };
        for &channel in &channels[kind] {
            values[channel] = -values[channel];
        }
    }

    /// Mirrors what differs from the background in a frame, 0 to 255, row by row.
    pub(super) fn mirror_movers(&self, frame: &mut [u8], width: usize) {
        let Mirroring::Movers(background) = &self.mirror else {
            return;
        };
        let mut differences = vec![0; width];
        for (row, behind) in frame.chunks_exact_mut(width).zip(background.chunks_exact(width)) {
            for ((difference, value), behind) in differences.iter_mut().zip(&*row).zip(behind) {
                *difference = i16::from(*value) - i16::from(*behind);
            }
            for ((value, behind), difference) in row.iter_mut().zip(behind).zip(differences.iter().rev()) {
                *value = (i16::from(*behind) + difference).clamp(0, 255) as u8;
            }
        }
    }
}

/// The background of training frames. Errors: `Config` if too much differs from it; those of [`Dataset::pixels`].
fn standing_background(dataset: &Dataset, frames: &[usize]) -> Result<Vec<u8>, TrainError> {
    let Background { pixels, changed_share } = Background::of(dataset, frames)?;
    if changed_share > MAX_CHANGED_SHARE {
        return Err(TrainError::Config(format!(
            "data.mirror is \"movers\", but {:.0} % of the training frames' pixels differ from their median, and at most {:.0} % \
             may: probably the camera moves, or the light changes; use \"off\", or a list of channels to mirror whole frames",
            100.0 * changed_share,
            100.0 * MAX_CHANGED_SHARE
        )));
    }
    Ok(pixels)
}

fn signed_channels(names: &[String], info: &DatasetInfo) -> Result<[Vec<usize>; 2], TrainError> {
    let kinds = [&info.action_channels, &info.state_channels];
    let known: Vec<&str> = kinds
        .into_iter()
        .flatten()
        .map(|channel| channel.name.as_str())
        .collect();
    if let Some(name) = names.iter().find(|name| !known.contains(&name.as_str())) {
        return Err(TrainError::Config(format!(
            "data.mirror names {name:?}, which is no channel of this data set; there are: {}",
            known.join(", ")
        )));
    }
    Ok(kinds.map(|channels| {
        (0..channels.len())
            .filter(|&at| names.contains(&channels[at].name))
            .collect()
    }))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_mirrored_frame_is_reversed_row_by_row() {
        let mut values = [0.1, 0.2, 0.3, 0.4, 0.5, 0.6];
        let change = WindowChange {
            is_frame_mirrored: true,
            ..WindowChange::NONE
        };
        change.apply(&mut values, 3, false);
        assert_eq!(values, [0.3, 0.2, 0.1, 0.6, 0.5, 0.4]);
    }

    #[test]
    fn half_of_the_windows_are_reversed_and_nothing_else_changes() {
        let plain = Augmentation {
            mirror: Mirroring::Nothing,
            reverse: false,
            brightness: 0.0,
            crop: 0.0,
            hidden: 0.0,
            seed: Seed(1),
        };
        let changed = Augmentation {
            mirror: Mirroring::Frames(Default::default()),
            brightness: 0.2,
            crop: 0.1,
            ..plain.clone()
        };
        for augmentation in [plain, changed] {
            let reversing = Augmentation {
                reverse: true,
                ..augmentation.clone()
            };
            let mut reversed = 0;
            for step in 0..1000 {
                let change = reversing.draw(step, 3);
                reversed += usize::from(change.is_reversed);
                let forwards = WindowChange {
                    is_reversed: false,
                    ..change
                };
                assert_eq!(forwards, augmentation.draw(step, 3));
            }
            assert!((400..600).contains(&reversed), "{reversed}");
        }
    }

    #[test]
    fn movers_are_mirrored_in_front_of_the_background() {
        let augmentation = Augmentation {
            mirror: Mirroring::Movers(vec![10, 20, 30, 250, 5, 5, 5, 5]),
            reverse: false,
            brightness: 0.0,
            crop: 0.0,
            hidden: 0.0,
            seed: Seed(1),
        };
        // The first pixel is 30 brighter than the background and the third of the second row 4 darker.
        let mut frame = [40, 20, 30, 250, 5, 5, 1, 5];
        augmentation.mirror_movers(&mut frame, 4);
        assert_eq!(frame, [10, 20, 30, 255, 5, 1, 5, 5]);
    }

    #[test]
    fn a_part_is_enlarged_to_the_whole_frame() {
        let mut ramp: Vec<f32> = (0..32).map(|index| (index % 8) as f32).collect();
        let upper_right = FramePart {
            side: 0.5,
            across: 1.0,
            down: 0.0,
        };
        upper_right.enlarge(&mut ramp, 8);
        let row = [3.75, 4.25, 4.75, 5.25, 5.75, 6.25, 6.75, 7.0];
        assert_eq!(ramp, row.repeat(4));
        let whole = FramePart {
            side: 1.0,
            ..upper_right
        };
        let mut same = ramp.clone();
        whole.enlarge(&mut same, 8);
        assert_eq!(same, ramp);
    }

    #[test]
    fn brightness_changes_the_camera_s_intensities() {
        let change = WindowChange {
            gain: 2.0,
            ..WindowChange::NONE
        };
        let mut plain = [0.25, 0.75];
        change.apply(&mut plain, 2, false);
        assert_eq!(plain, [0.5, 1.0]);
        let mut inverted = [0.75, 0.25];
        change.apply(&mut inverted, 2, true);
        assert_eq!(inverted, [0.5, 0.0]);
    }
}
