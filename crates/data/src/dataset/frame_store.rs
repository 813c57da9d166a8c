//! The frames of an open data set: all in memory, or in a file of decoded frames; in another light if asked for.

mod brightness;
pub(super) mod frame_file;

use std::borrow::Cow;
use std::sync::Arc;

use self::brightness::Brightness;
use self::frame_file::FrameFile;
use super::DatasetError;

/// What was read of some frames, in their order. The images are left out if they are in a file.
#[derive(Default)]
pub(super) struct FrameContent {
    pub(super) pixels: Vec<Box<[u8]>>,
    pub(super) masks: Vec<Box<[u8]>>,
    pub(super) actions: Vec<f32>,
    pub(super) states: Vec<f32>,
    pub(super) timestamps_s: Vec<f64>,
}

impl FrameContent {
    /// Adds the frames that follow these.
    pub(super) fn append(&mut self, mut next: Self) {
        self.pixels.append(&mut next.pixels);
        self.masks.append(&mut next.masks);
        self.actions.append(&mut next.actions);
        self.states.append(&mut next.states);
        self.timestamps_s.append(&mut next.timestamps_s);
    }
}

/// Where the images are: first those of all frames, then their masks if the data set has them.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum FrameStore {
    Memory(Vec<Box<[u8]>>),
    File(Arc<FrameFile>),
    /// Those of joined data sets.
    Joined(Vec<JoinedStore>),
    /// Those of another store in another light.
    Changed(Box<ChangedStore>),
}

/// The images of one of several joined data sets.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct JoinedStore {
    /// Its first frame among those of all.
    pub(super) first_frame: usize,
    pub(super) frame_count: usize,
    pub(super) has_masks: bool,
    pub(super) images: FrameStore,
}

/// Images whose frames are changed when they are read; their masks are as they were.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct ChangedStore {
    images: FrameStore,
    frame_count: usize,
    brightness: Brightness,
}

impl FrameStore {
    /// The same with frames, the first `frame_count` images, whose intensities are multiplied by this factor instead of any
    /// earlier one.
    pub(super) fn with_brightness(self, factor: f64, frame_count: usize) -> Self {
        let images = match self {
            Self::Changed(changed) => changed.images,
            images => images,
        };
        Self::Changed(Box::new(ChangedStore {
            images,
            frame_count,
            brightness: Brightness::new(factor),
        }))
    }

    /// What the frames' intensities are multiplied by.
    pub(super) fn brightness(&self) -> f64 {
        match self {
            Self::Changed(changed) => changed.brightness.factor,
            _ => 1.0,
        }
    }

    /// These intensities in the light of the frames.
    pub(super) fn changed<'a>(&self, pixels: Cow<'a, [u8]>) -> Cow<'a, [u8]> {
        match self {
            Self::Changed(changed) => Cow::Owned(changed.brightness.of(&pixels)),
            _ => pixels,
        }
    }

    /// The pixels of an image: borrowed from memory, or read from the file. Panics if there is no such image.
    pub(super) fn read(&self, image: usize) -> Result<Cow<'_, [u8]>, DatasetError> {
        match self {
            Self::Memory(images) => Ok(Cow::Borrowed(&images[image])),
            Self::File(file) => file.read(image).map(Cow::Owned),
            Self::Joined(parts) => {
                let all = parts.last().map_or(0, |last| last.first_frame + last.frame_count);
                let (frame, is_mask) = (image % all, image >= all);
                let part = &parts[parts.partition_point(|part| part.first_frame <= frame) - 1];
                let masks = if is_mask { part.frame_count } else { 0 };
                part.images.read(masks + frame - part.first_frame)
            }
            Self::Changed(changed) => {
                let stored = changed.images.read(image)?;
                Ok(if image < changed.frame_count {
                    self.changed(stored)
                } else {
                    stored
                })
            }
        }
    }

    /// Whether a frame has a mask, in a store of a data set with masks.
    pub(super) fn has_mask(&self, frame: usize) -> bool {
        match self {
            Self::Memory(_) | Self::File(_) => true,
            Self::Joined(parts) => parts[parts.partition_point(|part| part.first_frame <= frame) - 1].has_masks,
            Self::Changed(changed) => changed.images.has_mask(frame),
        }
    }

    /// Bytes of the images in memory.
    pub(super) fn bytes_in_memory(&self) -> usize {
        match self {
            Self::Memory(images) => images.iter().map(|image| image.len()).sum(),
            Self::File(_) => 0,
            Self::Joined(parts) => parts.iter().map(|part| part.images.bytes_in_memory()).sum(),
            Self::Changed(changed) => changed.images.bytes_in_memory(),
        }
    }
}
