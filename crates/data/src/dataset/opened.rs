//! An open data set: its numbers are in memory, its frames in memory or in a file of decoded frames.

use std::borrow::Cow;

use sha2::{Digest, Sha256};

use super::check::{check_description, check_episode};
use super::frame_store::{FrameStore, HeldFrames, item};
use super::{DatasetError, DatasetInfo, Episode, EpisodeData};
use foreframe_core::frame::Frame;

/// An open data set.
#[derive(Clone, Debug, PartialEq)]
pub struct Dataset {
    pub(super) info: DatasetInfo,
    pub(super) episodes: Vec<Episode>,
    pub(super) frames: FrameStore,
    pub(super) actions: Vec<f32>,
    pub(super) states: Vec<f32>,
    pub(super) timestamps_s: Vec<f64>,
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
        format!("{:x}", hasher.finalize())
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
}
