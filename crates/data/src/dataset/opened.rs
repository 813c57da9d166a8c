//! An open data set: its numbers are in memory, its frames in memory or in a file of decoded frames.

use std::borrow::Cow;
use std::sync::Arc;

use sha2::{Digest, Sha256};

use super::check::{check_description, check_episode};
use super::frame_store::frame_file::FrameFile;
use super::frame_store::{FrameContent, FrameStore};
use super::{DatasetError, DatasetInfo, DatasetPart, Episode, EpisodeData};
use foreframe_core::frame::Frame;
use foreframe_core::frame::warp::CameraModel;

/// An open data set.
#[derive(Clone, Debug, PartialEq)]
pub struct Dataset {
    pub(super) info: DatasetInfo,
    /// Those that were joined; empty if the data set is not joined.
    pub(super) parts: Vec<DatasetPart>,
    pub(super) episodes: Vec<Episode>,
    pub(super) images: FrameStore,
    pub(super) actions: Vec<f32>,
    pub(super) states: Vec<f32>,
    pub(super) timestamps_s: Vec<f64>,
}

impl Dataset {
    /// A data set of these episodes. Fills in the counts in `info`, and the hash if it is empty. Errors: `Invalid`, `TimeOrder`.
    pub fn from_episodes(info: DatasetInfo, episodes: Vec<EpisodeData>) -> Result<Self, DatasetError> {
        check_description(&info)?;
        let has_masks = episodes.first().is_some_and(|episode| episode.masks.is_some());
        let size = info.frame_pixels();
        let mut content = FrameContent::default();
        let mut placed = Vec::with_capacity(episodes.len());
        for (index, data) in episodes.into_iter().enumerate() {
            check_episode(&info, index, &data)?;
            if data.masks.is_some() != has_masks {
                return Err(DatasetError::Invalid(format!(
                    "episode {index}: either every episode must have masks, or none"
                )));
            }
            placed.push(Episode {
                index,
                first_frame: content.timestamps_s.len(),
                frame_count: data.timestamps_s.len(),
                trial: data.trial,
            });
            let images = |pixels: Vec<u8>| pixels.chunks(size).map(Box::from).collect();
            content.append(FrameContent {
                pixels: images(data.pixels),
                masks: images(data.masks.unwrap_or_default()),
                actions: data.actions,
                states: data.states,
                timestamps_s: data.timestamps_s,
            });
        }
        if content.timestamps_s.is_empty() {
            return Err(DatasetError::Invalid(format!(
                "the data set \"{}\" has no frames; at least one episode with one frame is needed",
                info.name
            )));
        }
        let info = DatasetInfo {
            frame_count: content.timestamps_s.len(),
            episode_count: placed.len(),
            has_masks,
            ..info
        };
        let mut dataset = Self::new(info, placed, content, None);
        if dataset.info.content_hash.is_empty() {
            dataset.info.content_hash = dataset.hash_content()?;
        }
        Ok(dataset)
    }

    /// The data set with this content; its images are in the file if there is one.
    pub(super) fn new(
        info: DatasetInfo,
        episodes: Vec<Episode>,
        mut content: FrameContent,
        file: Option<FrameFile>,
    ) -> Self {
        content.pixels.append(&mut content.masks);
        Self {
            info,
            parts: Vec::new(),
            episodes,
            images: file.map_or(FrameStore::Memory(content.pixels), |file| {
                FrameStore::File(Arc::new(file))
            }),
            actions: content.actions,
            states: content.states,
            timestamps_s: content.timestamps_s,
        }
    }

    fn hash_content(&self) -> Result<String, DatasetError> {
        let mut hasher = Sha256::new();
        for episode in &self.episodes {
            hasher.update((episode.frame_count as u64).to_le_bytes());
        }
        let (frames, masks) = (self.info.frame_count, self.info.image_count() - self.info.frame_count);
        for frame in 0..frames {
            hasher.update(self.image(0, frame)?);
        }
        for frame in 0..masks {
            hasher.update(self.image(frames, frame)?);
        }
        for value in self.actions.iter().chain(&self.states) {
            hasher.update(value.to_le_bytes());
        }
        for value in &self.timestamps_s {
            hasher.update(value.to_le_bytes());
        }
        Ok(format!("{:x}", hasher.finalize()))
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

    /// The parts in order; one that is the whole data set if it was not joined.
    #[must_use]
    pub fn parts(&self) -> Vec<DatasetPart> {
        if self.parts.is_empty() {
            return vec![DatasetPart {
                info: self.info.clone(),
                episodes: 0..self.episodes.len(),
                share: 1.0,
            }];
        }
        self.parts.clone()
    }

    /// The descriptions of the parts ([`DatasetInfo::description`]), one a line.
    #[doc(hidden)]
    #[must_use]
    pub fn description(&self) -> String {
        let parts = self.parts();
        let descriptions = parts.iter().map(|part| part.info.description());
        descriptions.collect::<Vec<_>>().join("\n")
    }

    /// Whether a part has a camera that the whole has not, because the parts do not have the same.
    #[doc(hidden)]
    #[must_use]
    pub fn lost_camera(&self) -> bool {
        self.info.camera.is_none() && self.parts.iter().any(|part| part.info.camera.is_some())
    }

    /// The description of the part that this episode belongs to.
    fn info_of(&self, episode: usize) -> &DatasetInfo {
        let part = self.parts.iter().find(|part| part.episodes.contains(&episode));
        part.map_or(&self.info, |part| &part.info)
    }

    /// The camera of an episode: that of its trial, else the one of all trials, both with their height, else the one in the
    /// description. None where no camera is known.
    #[must_use]
    pub fn camera(&self, episode: usize) -> Option<CameraModel> {
        let trial = self.episodes.get(episode).and_then(|episode| episode.trial.as_ref());
        self.info_of(episode).camera_of(trial)
    }

    /// The same, taken by this camera where none is known.
    #[doc(hidden)]
    #[must_use]
    pub fn with_camera(mut self, camera: CameraModel) -> Self {
        self.info.camera = Some(camera);
        self
    }

    /// The same in darker or brighter light: the intensities of all frames are multiplied by `factor`, above 0, and limited to
    /// white. Masks, numbers and the content hash stay; a factor that was given before does not count.
    #[doc(hidden)]
    #[must_use]
    pub fn with_brightness(mut self, factor: f64) -> Self {
        self.images = self.images.with_brightness(factor, self.info.frame_count);
        self
    }

    /// What the intensities of the stored frames are multiplied by; 1 unless another brightness was asked for.
    #[doc(hidden)]
    #[must_use]
    pub fn brightness(&self) -> f64 {
        self.images.brightness()
    }

    /// A frame from elsewhere, for example from the simulator, in the light of this data set's frames.
    #[doc(hidden)]
    #[must_use]
    pub fn in_its_light<'a>(&self, pixels: &'a [u8]) -> Cow<'a, [u8]> {
        self.images.changed(Cow::Borrowed(pixels))
    }

    /// The camera of each of the episodes, given by position, or this other one where it is not known; empty unless all are known then.
    pub fn cameras(
        &self,
        episodes: impl IntoIterator<Item = usize>,
        otherwise: Option<CameraModel>,
    ) -> Vec<CameraModel> {
        let cameras = episodes.into_iter().map(|episode| self.camera(episode).or(otherwise));
        cameras.collect::<Option<_>>().unwrap_or_default()
    }

    /// The intensities of a frame, row by row: borrowed from memory, or read from the file of decoded frames. Panics if there
    /// is no such frame. Errors: `Io`, `Corrupt`; never if the frames are in memory.
    pub fn pixels(&self, frame: usize) -> Result<Cow<'_, [u8]>, DatasetError> {
        self.image(0, frame)
    }

    /// The segmentation mask of a frame, if there is one. Panics if there is no such frame. Errors: as
    /// [`Dataset::pixels`].
    pub fn mask(&self, frame: usize) -> Result<Option<Cow<'_, [u8]>>, DatasetError> {
        let mask = || self.image(self.info.frame_count, frame);
        (self.info.has_masks && self.images.has_mask(frame))
            .then(mask)
            .transpose()
    }

    /// The pixels of a frame, or of its mask if `first` is where the masks begin.
    fn image(&self, first: usize, frame: usize) -> Result<Cow<'_, [u8]>, DatasetError> {
        let frames = self.info.frame_count;
        assert!(frame < frames, "frame {frame} of {frames} frames is a bug");
        self.images.read(first + frame)
    }

    /// A frame. Panics if there is no such frame. Errors: as [`Dataset::pixels`].
    pub fn frame(&self, frame: usize) -> Result<Frame, DatasetError> {
        let pixels = self.pixels(frame)?.into_owned();
        Ok(Frame::new(self.info.frame_width_px, self.info.frame_height_px, pixels)?)
    }

    /// Bytes of frames and masks that this data set holds in memory; 0 if they are in a file.
    #[must_use]
    pub fn frame_bytes_in_memory(&self) -> usize {
        self.images.bytes_in_memory()
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

/// Item `index` of those of equal size that lie one after another.
fn item<T>(all: &[T], index: usize, size: usize) -> &[T] {
    &all[index * size..(index + 1) * size]
}
