//! The records of a recording before they are brought to one frame rate.

use std::fs::File;
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::sync::PoisonError;
use std::sync::atomic::{AtomicBool, Ordering};

use rayon::prelude::*;

use super::bag::BagImages;
use super::lerobot::ImageTable;
use super::video::VideoFrames;
use super::{ImportError, SkippedList, read_file};
use foreframe_core::files::is_transient;
use foreframe_core::frame::warp::CameraModel;
use foreframe_core::frame::{Frame, codec};
use foreframe_core::types::Channel;

/// One recorded image with its time, action and state.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Record {
    pub(super) timestamp_s: f64,
    /// Records of different sessions are never in one episode.
    pub(super) session: String,
    pub(super) action: Vec<f32>,
    pub(super) state: Vec<f32>,
    /// Where [`Images`] finds the image.
    pub(super) image: usize,
    /// File and line, frame or position, for messages.
    pub(super) place: String,
}

/// Everything that a source holds, in the order of time.
pub(super) struct Recording {
    pub(super) name: String,
    pub(super) action_channels: Vec<Channel>,
    pub(super) state_channels: Vec<Channel>,
    /// How the camera projects the fitted images, where the source says it.
    pub(super) camera: Option<CameraModel>,
    pub(super) records: Vec<Record>,
    pub(super) images: Images,
    pub(super) skipped: SkippedList,
}

/// Where the images are.
pub(super) enum Images {
    /// Image files.
    Files(Vec<PathBuf>),
    /// Gray frames of one size in one file, from an offset on.
    Raw(RawImages),
    /// A column of the tables of a `LeRobot` data set.
    Table(ImageTable),
    /// Frames of videos.
    Videos(VideoFrames),
    /// Messages of a bag.
    Bag(BagImages),
}

/// An image that is needed next.
pub(super) struct WantedImage<'a> {
    pub(super) image: usize,
    /// File and line, frame or position, for messages.
    pub(super) place: &'a str,
}

/// Resizes an image; the second argument is its place.
pub(super) type FitImage<'a> = &'a (dyn Fn(&Frame, &str) -> Result<Frame, ImportError> + Sync);

/// Gray frames of one size in a file. A frame can lie in one piece or, for a `NumPy` array of another layout, at any stride.
pub(super) struct RawImages {
    pub(super) path: PathBuf,
    pub(super) file: Mutex<File>,
    pub(super) width_px: u32,
    pub(super) height_px: u32,
    /// The position of a frame's first byte, by image number.
    pub(super) offsets: Vec<u64>,
    pub(super) pixel: PixelType,
}

/// How a pixel is stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum PixelType {
    U8,
    /// Red, green and blue.
    Rgb8,
    /// Little endian, 0 to 1.
    F32,
    /// Little endian, 0 to 1.
    F64,
}

impl PixelType {
    pub(super) fn bytes(self) -> usize {
        match self {
            Self::U8 => 1,
            Self::Rgb8 => 3,
            Self::F32 => 4,
            Self::F64 => 8,
        }
    }
}

impl Images {
    /// Decodes images as gray and passes each to `fit`, in parallel. They are wanted in the order of the recording. Errors, for each
    /// image: `Image`, `Io`, `Record`, `Program`, `Stopped`, and those of `fit`.
    pub(super) fn read_all(
        &self,
        wanted: &[WantedImage<'_>],
        fit: FitImage<'_>,
        cancelled: &AtomicBool,
    ) -> Vec<Result<Frame, ImportError>> {
        let in_parallel = |read: &(dyn Fn(&WantedImage<'_>) -> Result<Frame, ImportError> + Sync)| {
            let fitted = |wanted: &WantedImage<'_>| {
                if cancelled.load(Ordering::Relaxed) {
                    return Err(ImportError::Stopped);
                }
                fit(&read(wanted)?, wanted.place)
            };
            wanted.par_iter().map(fitted).collect()
        };
        match self {
            Self::Files(paths) => in_parallel(&|wanted| decode_file(&paths[wanted.image], wanted.place)),
            Self::Raw(raw) => in_parallel(&|wanted| raw.read(wanted.image, wanted.place)),
            Self::Table(table) => in_parallel(&|wanted| table.read(wanted.image, wanted.place)),
            Self::Bag(bag) => in_parallel(&|wanted| bag.read(wanted.image, wanted.place)),
            Self::Videos(videos) => videos.read_all(wanted, fit, cancelled),
        }
    }
}

fn decode_file(path: &Path, place: &str) -> Result<Frame, ImportError> {
    codec::decode(&read_image(path, place)?).map_err(|source| ImportError::Image {
        place: place.to_owned(),
        path: path.to_owned(),
        source,
    })
}

/// The bytes of an image file. Errors: `Record` if it is missing or cannot be read, `Io` where trying again may help.
pub(super) fn read_image(path: &Path, place: &str) -> Result<Vec<u8>, ImportError> {
    read_file(path).map_err(|error| match error {
        ImportError::Io { source, .. } if source.kind() == std::io::ErrorKind::NotFound => {
            ImportError::record(place, format!("the image {} is missing", path.display()))
        }
        ImportError::Io { source, .. } if !is_transient(&source) => {
            ImportError::record(place, format!("the image {} cannot be read: {source}", path.display()))
        }
        other => other,
    })
}

impl RawImages {
    pub(super) fn read(&self, image: usize, place: &str) -> Result<Frame, ImportError> {
        use std::io::{Read as _, Seek as _, SeekFrom};
        let count = self.width_px as usize * self.height_px as usize;
        let mut bytes = vec![0; count * self.pixel.bytes()];
        {
            let mut file = self.file.lock().unwrap_or_else(PoisonError::into_inner);
            file.seek(SeekFrom::Start(self.offsets[image]))
                .and_then(|_| file.read_exact(&mut bytes))
                .map_err(ImportError::io("read", &self.path))?;
        }
        let pixels = match self.pixel {
            PixelType::U8 => bytes,
            PixelType::Rgb8 => codec::gray_from_rgb(&bytes),
            PixelType::F32 => {
                let values = bytes.as_chunks::<4>().0.iter();
                gray_levels(values.map(|bytes| f64::from(f32::from_le_bytes(*bytes))), place)?
            }
            PixelType::F64 => gray_levels(bytes.as_chunks::<8>().0.iter().map(|b| f64::from_le_bytes(*b)), place)?,
        };
        Frame::new(self.width_px, self.height_px, pixels).map_err(|source| ImportError::Image {
            place: place.to_owned(),
            path: self.path.clone(),
            source,
        })
    }
}

/// 8-bit gray levels of intensities 0…1. Errors: `Record` if one is not in that range.
fn gray_levels(values: impl Iterator<Item = f64>, place: &str) -> Result<Vec<u8>, ImportError> {
    values
        .map(|value| match value {
            0.0..=1.0 => Ok((value * 255.0).round() as u8),
            _ => Err(ImportError::record(
                place,
                format!("a pixel is {value}; floating-point pixels must be 0 to 1"),
            )),
        })
        .collect()
}
