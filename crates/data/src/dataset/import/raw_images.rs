//! Images without compression, one after another in a file.

use std::fs::File;
use std::io::{Read as _, Seek as _, SeekFrom};
use std::path::PathBuf;
use std::sync::atomic::AtomicBool;
use std::sync::{Mutex, PoisonError};

use super::error::ImportError;
use super::recording::{ImageSource, WantedImage};
use foreframe_core::frame::{Frame, codec};

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

impl ImageSource for RawImages {
    fn read(&self, wanted: &WantedImage<'_>, _cancelled: &AtomicBool) -> Result<Frame, ImportError> {
        let WantedImage { image, place } = *wanted;
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
        Frame::new(self.width_px, self.height_px, pixels).map_err(ImportError::image(place, &self.path))
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
