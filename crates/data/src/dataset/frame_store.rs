//! The frames of an open data set: all in memory, or in a file of decoded frames.

pub(super) mod frame_file;

use std::borrow::Cow;
use std::sync::Arc;

use self::frame_file::{FrameFile, FrameImage};
use super::{DatasetError, DatasetInfo};

/// Frames in memory, one after another.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct HeldFrames {
    pub(super) pixels: Vec<u8>,
    pub(super) masks: Option<Vec<u8>>,
}

impl HeldFrames {
    /// Black frames, and empty masks if the data set has masks.
    pub(super) fn zeroed(info: &DatasetInfo) -> Self {
        let bytes = info.frame_count * info.frame_pixels();
        Self {
            pixels: vec![0; bytes],
            masks: info.has_masks.then(|| vec![0; bytes]),
        }
    }
}

/// Where the frames are.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum FrameStore {
    Memory(HeldFrames),
    File(Arc<FrameFile>),
}

impl FrameStore {
    /// The intensities of a frame of `size` pixels. Panics if there is no such frame. Errors: `Io`, `Corrupt`.
    pub(super) fn pixels(&self, frame: usize, size: usize) -> Result<Cow<'_, [u8]>, DatasetError> {
        Ok(match self {
            Self::Memory(held) => Cow::Borrowed(item(&held.pixels, frame, size)),
            Self::File(file) => Cow::Owned(file.read(FrameImage::Pixels, frame)?),
        })
    }

    /// The mask of a frame of `size` pixels, if there are masks. Panics if there is no such frame. Errors: `Io`, `Corrupt`.
    pub(super) fn mask(&self, frame: usize, size: usize) -> Result<Option<Cow<'_, [u8]>>, DatasetError> {
        Ok(match self {
            Self::Memory(held) => {
                let masks = held.masks.as_deref();
                masks.map(|masks| Cow::Borrowed(item(masks, frame, size)))
            }
            Self::File(file) if file.has_masks() => Some(Cow::Owned(file.read(FrameImage::Mask, frame)?)),
            Self::File(_) => None,
        })
    }

    /// Bytes of frames and masks in memory.
    pub(super) fn bytes_in_memory(&self) -> usize {
        match self {
            Self::Memory(held) => held.pixels.len() + held.masks.as_ref().map_or(0, Vec::len),
            Self::File(_) => 0,
        }
    }
}

/// Item `index` of those of equal size that lie one after another.
pub(super) fn item<T>(all: &[T], index: usize, size: usize) -> &[T] {
    &all[index * size..(index + 1) * size]
}
