//! Data sets of recorded and simulated episodes, on disk and in memory.
//!
//! A [`Dataset`] holds actions, states and times in memory. Its frames are in memory too, or, if they are too large for that,
//! decoded in a file. [`sampler`] divides its [`Window`]s into training, validation and test parts. [`collect()`] simulates a
//! data set and writes it in LeRobot's v3.0 layout.

pub mod background;
mod catalog;
mod check;
pub mod collect;
mod collection;
mod digits;
mod error;
pub mod export;
mod files;
mod frame_file;
mod frame_store;
pub mod import;
mod layout;
pub mod moving_mnist;
mod parquet_file;
mod preview;
mod program;
pub mod sampler;
mod shard;
mod shard_reader;
mod stats;
mod store;
mod tables;
mod unfinished;

use std::borrow::Cow;
use std::ops::Range;

use sha2::{Digest, Sha256};

pub use catalog::{find, is_finished, list};
use check::{check_description, check_episode};
pub use collect::{CollectConfig, CollectProgress, collect};
pub use collection::CollectionStatus;
pub use error::DatasetError;
use frame_store::{FrameStore, HeldFrames};
pub use layout::{IMPORT_ARGUMENTS, INFO, METADATA};
pub use parquet_file::silence_caught_panics;
pub use preview::{describe, describe_metadata};
pub use sampler::{Split, Splits, WindowShape};

use foreframe_core::error_text::comma_separated;
use foreframe_core::files::hex;
use foreframe_core::frame::Frame;
use foreframe_core::frame::warp::CameraModel;
use foreframe_core::types::{Channel, Seed};
pub use foreframe_sim::TrialParameters;
use foreframe_sim::WorldConfig;

/// Description of a data set: frame size, frame period, channels, origin and the hash of its content.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct DatasetInfo {
    /// Its name, for reports.
    pub name: String,
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
    /// SHA-256 of the content, in hexadecimal. [`Dataset::from_episodes`] computes it if this is empty.
    pub content_hash: String,
    /// The simulated scenario; none for recordings.
    pub scenario: Option<String>,
    /// The seed it was simulated from; none for recordings.
    pub seed: Option<Seed>,
    /// Number of frames of all episodes; filled in by [`Dataset::from_episodes`].
    pub frame_count: usize,
    /// Number of episodes; filled in by [`Dataset::from_episodes`].
    pub episode_count: usize,
    /// Whether every frame has a mask; filled in by [`Dataset::from_episodes`].
    pub has_masks: bool,
    /// How the camera projects; none where that is not known.
    pub camera: Option<CameraModel>,
    /// How the simulated world was run and seen; none for recordings.
    pub world: Option<WorldConfig>,
}

impl DatasetInfo {
    /// Pixels of one frame.
    #[must_use]
    pub fn frame_pixels(&self) -> usize {
        self.frame_width_px as usize * self.frame_height_px as usize
    }

    /// Bytes of all frames, decoded, with their masks.
    #[must_use]
    pub fn decoded_bytes(&self) -> u64 {
        let images = 1 + u64::from(self.has_masks);
        self.frame_count as u64 * self.frame_pixels() as u64 * images
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

/// `context + horizon` consecutive frames of one episode: the context, then the frames to predict.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Window {
    /// Position in [`Dataset::episodes`].
    pub episode: usize,
    /// The first context frame, counted over the whole data set.
    pub first_frame: usize,
}

/// An open data set.
#[derive(Clone, Debug, PartialEq)]
pub struct Dataset {
    info: DatasetInfo,
    episodes: Vec<Episode>,
    frames: FrameStore,
    actions: Vec<f32>,
    states: Vec<f32>,
    timestamps_s: Vec<f64>,
}

impl Dataset {
    /// A data set of these episodes. Fills in the counts in `info`, and the hash if it is empty. Errors: `Description`,
    /// `PartLength`, `NotFinite`, `TimeOrder`, `MixedMasks`, `Empty`.
    pub fn from_episodes(info: DatasetInfo, episodes: Vec<EpisodeData>) -> Result<Self, DatasetError> {
        check_description(&info)?;
        let has_masks = episodes.first().is_some_and(|episode| episode.masks.is_some());
        let frame_count: usize = episodes.iter().map(|episode| episode.timestamps_s.len()).sum();
        let bytes = frame_count * info.frame_pixels();
        let mut held = HeldFrames {
            pixels: Vec::with_capacity(bytes),
            masks: has_masks.then(|| Vec::with_capacity(bytes)),
        };
        let mut dataset = Self {
            episodes: Vec::with_capacity(episodes.len()),
            frames: FrameStore::Memory(HeldFrames::default()),
            actions: Vec::with_capacity(frame_count * info.action_channels.len()),
            states: Vec::with_capacity(frame_count * info.state_channels.len()),
            timestamps_s: Vec::with_capacity(frame_count),
            info,
        };
        for episode in episodes {
            dataset.push(&mut held, episode)?;
        }
        if dataset.timestamps_s.is_empty() {
            return Err(DatasetError::Empty {
                name: dataset.info.name,
            });
        }
        dataset.info.frame_count = dataset.timestamps_s.len();
        dataset.info.episode_count = dataset.episodes.len();
        dataset.info.has_masks = has_masks;
        if dataset.info.content_hash.is_empty() {
            dataset.info.content_hash = dataset.hash_content(&held);
        }
        dataset.frames = FrameStore::Memory(held);
        Ok(dataset)
    }

    fn push(&mut self, held: &mut HeldFrames, data: EpisodeData) -> Result<(), DatasetError> {
        let index = self.episodes.len();
        check_episode(&self.info, index, &data)?;
        match (&mut held.masks, data.masks) {
            (Some(all), Some(masks)) => all.extend(masks),
            (None, None) => {}
            _ => return Err(DatasetError::MixedMasks { episode: index }),
        }
        self.episodes.push(Episode {
            index,
            first_frame: self.timestamps_s.len(),
            frame_count: data.timestamps_s.len(),
            trial: data.trial,
        });
        held.pixels.extend(data.pixels);
        self.actions.extend(data.actions);
        self.states.extend(data.states);
        self.timestamps_s.extend(data.timestamps_s);
        Ok(())
    }

    fn hash_content(&self, held: &HeldFrames) -> String {
        let mut hasher = Sha256::new();
        for episode in &self.episodes {
            hasher.update((episode.frame_count as u64).to_le_bytes());
        }
        hasher.update(&held.pixels);
        hasher.update(held.masks.as_deref().unwrap_or_default());
        for value in self.actions.iter().chain(&self.states) {
            hasher.update(value.to_le_bytes());
        }
        for value in &self.timestamps_s {
            hasher.update(value.to_le_bytes());
        }
        hex(&hasher.finalize())
    }

    /// The description of the data set.
    #[must_use]
    pub fn info(&self) -> &DatasetInfo {
        &self.info
    }

    /// The episodes in order.
    #[must_use]
    pub fn episodes(&self) -> &[Episode] {
        &self.episodes
    }

    /// The intensities of a frame, row by row: borrowed from memory, or read from the file of decoded frames. Panics if there
    /// is no such frame. Errors: `Io`, `Corrupt`; never if the frames are in memory.
    pub fn pixels(&self, frame: usize) -> Result<Cow<'_, [u8]>, DatasetError> {
        self.frames.pixels(frame, self.info.frame_pixels())
    }

    /// The segmentation mask of a frame, if the data set has masks. Panics if there is no such frame. Errors: as
    /// [`Dataset::pixels`].
    pub fn mask(&self, frame: usize) -> Result<Option<Cow<'_, [u8]>>, DatasetError> {
        self.frames.mask(frame, self.info.frame_pixels())
    }

    /// A frame. Panics if there is no such frame. Errors: as [`Dataset::pixels`].
    pub fn frame(&self, frame: usize) -> Result<Frame, DatasetError> {
        let pixels = self.pixels(frame)?.into_owned();
        Frame::new(self.info.frame_width_px, self.info.frame_height_px, pixels)
            .map_err(|error| DatasetError::Description(error.to_string()))
    }

    /// Bytes of frames and masks that this data set holds in memory; 0 if they are in a file.
    #[must_use]
    pub fn frame_bytes_in_memory(&self) -> usize {
        self.frames.bytes_in_memory()
    }

    /// The action from this frame to the next. Panics if there is no such frame.
    #[must_use]
    pub fn action(&self, frame: usize) -> &[f32] {
        item(&self.actions, frame, self.info.action_channels.len())
    }

    /// The state at this frame. Panics if there is no such frame.
    #[must_use]
    pub fn state(&self, frame: usize) -> &[f32] {
        item(&self.states, frame, self.info.state_channels.len())
    }

    /// Time of the frame in seconds since the start of its episode. Panics if there is no such frame.
    #[must_use]
    pub fn timestamp_s(&self, frame: usize) -> f64 {
        self.timestamps_s[frame]
    }

    /// Errors: `FrameSize` unless the frames have this size.
    pub fn require_frame_size(&self, width_px: u32, height_px: u32) -> Result<(), DatasetError> {
        let info = &self.info;
        if (info.frame_width_px, info.frame_height_px) == (width_px, height_px) {
            return Ok(());
        }
        Err(DatasetError::FrameSize {
            name: info.name.clone(),
            width: info.frame_width_px,
            height: info.frame_height_px,
            wanted_width: width_px,
            wanted_height: height_px,
        })
    }

    /// Errors: `Channels` unless actions have this number of components.
    pub fn require_action_count(&self, wanted: usize) -> Result<(), DatasetError> {
        self.require_channels("action", &self.info.action_channels, wanted)
    }

    /// Errors: `Channels` unless states have this number of components.
    pub fn require_state_count(&self, wanted: usize) -> Result<(), DatasetError> {
        self.require_channels("state", &self.info.state_channels, wanted)
    }

    fn require_channels(&self, kind: &'static str, channels: &[Channel], wanted: usize) -> Result<(), DatasetError> {
        if channels.len() == wanted {
            return Ok(());
        }
        Err(DatasetError::Channels {
            name: self.info.name.clone(),
            kind,
            found: channels.len(),
            names: comma_separated(channels),
            wanted,
        })
    }
}

fn item<T>(all: &[T], index: usize, size: usize) -> &[T] {
    &all[index * size..(index + 1) * size]
}
