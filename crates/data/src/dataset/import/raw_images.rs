//! Images without compression, one after another in a file.

use std::path::PathBuf;
use std::sync::atomic::AtomicBool;

use super::error::ImportError;
use super::recording::{ImageSource, Record};
use foreframe_core::files::PositionedFile;
use foreframe_core::frame::{Frame, codec};

/// Frames of one size in a file. A frame can lie in one piece or, for a `NumPy` array of another layout, at any stride.
pub(super) struct RawImages {
    pub(super) path: PathBuf,
    pub(super) file: PositionedFile,
    pub(super) width_px: u32,
    pub(super) height_px: u32,
    /// The position of a frame's first byte, by image number.
    pub(super) offsets: Vec<u64>,
    /// Intensities are bytes, or floating-point numbers from 0 to 1.
    pub(super) number: NumberType,
    /// Whether a pixel is red, green and blue, in bytes.
    pub(super) is_rgb: bool,
}

/// How a number is stored: little endian.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum NumberType {
    U8,
    I32,
    I64,
    F32,
    F64,
}

impl NumberType {
    pub(super) fn bytes(self) -> usize {
        match self {
            Self::U8 => 1,
            Self::I32 | Self::F32 => 4,
            Self::I64 | Self::F64 => 8,
        }
    }

    pub(super) fn values(self, bytes: &[u8]) -> Vec<f64> {
        let (fours, eights) = (bytes.as_chunks::<4>().0.iter(), bytes.as_chunks::<8>().0.iter());
        match self {
            Self::U8 => bytes.iter().map(|&value| f64::from(value)).collect(),
            Self::I32 => fours.map(|bytes| f64::from(i32::from_le_bytes(*bytes))).collect(),
            Self::F32 => fours.map(|bytes| f64::from(f32::from_le_bytes(*bytes))).collect(),
            Self::I64 => eights.map(|bytes| i64::from_le_bytes(*bytes) as f64).collect(),
            Self::F64 => eights.map(|bytes| f64::from_le_bytes(*bytes)).collect(),
        }
    }
}

impl ImageSource for RawImages {
    fn read(&self, wanted: &Record, _cancelled: &AtomicBool) -> Result<Frame, ImportError> {
        let Record { image, place, .. } = wanted;
        let samples = if self.is_rgb { 3 } else { 1 };
        let count = self.width_px as usize * self.height_px as usize * samples;
        let mut bytes = vec![0; count * self.number.bytes()];
        let read = self.file.read_at(&mut bytes, self.offsets[*image]);
        read.map_err(ImportError::io("read", &self.path))?;
        let pixels = match self.number {
            NumberType::U8 if self.is_rgb => codec::gray_from_rgb(&bytes),
            NumberType::U8 => bytes,
            number => {
                let levels = number.values(&bytes).into_iter().map(|value| gray_level(value, place));
                levels.collect::<Result<_, _>>()?
            }
        };
        Frame::new(self.width_px, self.height_px, pixels).map_err(ImportError::image(place, &self.path))
    }
}

/// The 8-bit gray level of an intensity 0…1. Errors: `Record` if it is not in that range.
fn gray_level(value: f64, place: &str) -> Result<u8, ImportError> {
    if (0.0..=1.0).contains(&value) {
        return Ok((value * 255.0).round() as u8);
    }
    let reason = format!("a pixel is {value}; floating-point pixels must be 0 to 1");
    Err(ImportError::record(place, reason))
}
