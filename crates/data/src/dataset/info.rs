//! What a data set and its episodes consist of.

use std::ops::Range;

use serde::{Deserialize, Serialize};

use foreframe_core::frame::warp::CameraModel;
use foreframe_core::types::{Channel, Seed};
use foreframe_sim::{CameraConfig, TrialParameters, WorldConfig};

/// Description of a data set: frame size, frame period, channels, origin and the hash of its content. The fields in the order
/// of the metadata file.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct DatasetInfo {
    /// Its title, for reports: the name of its directory, or the names of its parts joined by `+`. Not a
    /// [`DatasetName`](foreframe_core::types::DatasetName), by which the program finds a data set: a directory can have any name.
    pub name: String,
    /// The simulated scenario; none for recordings.
    pub scenario: Option<String>,
    /// The seed it was simulated from; none for recordings.
    pub seed: Option<Seed>,
    /// Width of every frame in pixels.
    pub frame_width_px: u32,
    /// Height of every frame in pixels.
    pub frame_height_px: u32,
    /// Seconds from one frame to the next.
    pub frame_period_s: f64,
    /// Components of an action. Action t acts from frame t to frame t + 1.
    pub action_channels: Vec<Channel>,
    /// Components of a state.
    pub state_channels: Vec<Channel>,
    /// Whether every frame has a mask; filled in by [`Dataset::from_episodes`](super::Dataset::from_episodes).
    pub has_masks: bool,
    /// How the camera of all episodes projects; none where that is not known, or where each trial has a camera of its own
    /// ([`Dataset::camera`](super::Dataset::camera)).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub camera: Option<CameraModel>,
    /// SHA-256 of the content, in hexadecimal. [`Dataset::from_episodes`](super::Dataset::from_episodes) computes it if this is empty.
    pub content_hash: String,
    /// Number of frames of all episodes; filled in by [`Dataset::from_episodes`](super::Dataset::from_episodes).
    #[serde(skip)]
    pub frame_count: usize,
    /// Number of episodes; filled in by [`Dataset::from_episodes`](super::Dataset::from_episodes).
    #[serde(skip)]
    pub episode_count: usize,
    /// How the simulated world was run and seen; none for recordings.
    #[serde(skip)]
    pub world: Option<WorldConfig>,
}

impl DatasetInfo {
    /// Pixels of one frame.
    #[must_use]
    pub fn frame_pixels(&self) -> usize {
        self.frame_width_px as usize * self.frame_height_px as usize
    }

    /// The simulated camera, where it is the same in all trials.
    pub(super) fn common_camera(&self) -> Option<&CameraConfig> {
        let world = self.world.as_ref().filter(|world| world.rooms.is_none());
        world.map(|world| &world.camera)
    }

    /// The camera of an episode: the trial's own, else that of all trials, else that of the description. The first two have a
    /// height.
    #[doc(hidden)]
    #[must_use]
    pub fn camera_of(&self, trial: Option<&TrialParameters>) -> Option<CameraModel> {
        let own = trial.and_then(|trial| trial.room.as_ref()).map(|room| &room.camera);
        let simulated = own.or_else(|| self.common_camera());
        simulated.map(CameraConfig::model_with_height).or(self.camera)
    }

    /// Camera, channels, frame size and frame period, as JSON in one line: a model depends on them, but the content hash does not.
    #[doc(hidden)]
    #[must_use]
    pub fn description(&self) -> String {
        let described = (
            self.camera,
            &self.action_channels,
            &self.state_channels,
            (self.frame_width_px, self.frame_height_px, self.frame_period_s),
        );
        serde_json::to_string(&described).expect("a description that JSON cannot hold is a bug")
    }

    /// Number of frames and masks.
    pub(super) fn image_count(&self) -> usize {
        self.frame_count * (1 + usize::from(self.has_masks))
    }

    /// Bytes of all frames, decoded, with their masks.
    #[must_use]
    pub fn decoded_bytes(&self) -> u64 {
        self.image_count() as u64 * self.frame_pixels() as u64
    }
}

/// One trial or recording, and which frames of the data set belong to it.
#[derive(Clone, Debug, PartialEq)]
pub struct Episode {
    /// Its position among the episodes.
    pub index: usize,
    /// Its first frame, counted over the whole data set.
    pub first_frame: usize,
    /// Its number of frames.
    pub frame_count: usize,
    /// Parameters of the trial; none for recordings.
    pub trial: Option<TrialParameters>,
}

impl Episode {
    /// Its frames, counted over the whole data set.
    #[must_use]
    pub fn frames(&self) -> Range<usize> {
        self.first_frame..self.first_frame + self.frame_count
    }
}

/// A part of a data set: all of it, or one of those that were joined.
#[derive(Clone, Debug, PartialEq)]
pub struct DatasetPart {
    /// The description of the part.
    pub info: DatasetInfo,
    /// The positions of its episodes.
    pub episodes: Range<usize>,
    /// Its share of the training windows, 0 to 1.
    pub share: f64,
}

/// The data of one episode. Each field holds one item per frame, one after another.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct EpisodeData {
    /// Seconds since the start of the episode, increasing.
    pub timestamps_s: Vec<f64>,
    /// Intensities, frame by frame, row by row.
    pub pixels: Vec<u8>,
    /// Segmentation masks (0 = scene, 1 = Tb2, 2… = other robots), in the layout of `pixels`.
    pub masks: Option<Vec<u8>>,
    /// Actions, frame by frame.
    pub actions: Vec<f32>,
    /// States, frame by frame.
    pub states: Vec<f32>,
    /// Parameters of the trial; none for recordings.
    pub trial: Option<TrialParameters>,
}
