//! The frames of an array, in a file without compression.

use std::path::PathBuf;
use std::sync::atomic::AtomicBool;

use super::error::ImportError;
use super::recording::{ImageSource, Record};
use foreframe_core::files::PositionedFile;
use foreframe_core::frame::{Frame, MAX_SIDE_PX, codec};

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

/// Which sides of an array are sequences, time, rows and columns.
pub(super) struct FrameLayout {
    sequences: usize,
    frames: usize,
    height: usize,
    width: usize,
    number: NumberType,
    is_rgb: bool,
    time_first: bool,
    /// The sides before the rows.
    pub(super) leading: Vec<usize>,
}

impl FrameLayout {
    /// Errors: `Record` if the array holds no frames.
    pub(super) fn of(number: NumberType, shape: &[usize], place: &str) -> Result<Self, ImportError> {
        let wrong = |reason: String| Err(ImportError::record(place, reason));
        if matches!(number, NumberType::I32 | NumberType::I64) {
            let reason = "its values are int32 or int64; frames must be uint8, or float32 or float64 from 0 to 1";
            return wrong(reason.to_owned());
        }
        // Frames of three columns are not worth predicting, so these are colors.
        let (sides, is_rgb) = match shape {
            [sides @ .., 3] if sides.len() >= 3 && number == NumberType::U8 => (sides, true),
            sides => (sides, false),
        };
        let (sequences, frames, height, width, time_first) = match *sides {
            [frames, height, width] => (1, frames, height, width, false),
            [frames, sequences, height, width] if frames <= sequences => (sequences, frames, height, width, true),
            [sequences, frames, height, width] => (sequences, frames, height, width, false),
            _ => {
                return wrong(format!(
                    "the array's shape is {shape:?}; it must be T×H×W, T×N×H×W or N×T×H×W, or the same with 3 colors at the end"
                ));
            }
        };
        let possible = 1..=MAX_SIDE_PX as usize;
        if !possible.contains(&height) || !possible.contains(&width) {
            return wrong(format!(
                "its frames are {width}×{height} px; each side must be 1 to {MAX_SIDE_PX} px"
            ));
        }
        let layout = Self {
            sequences,
            frames,
            height,
            width,
            number,
            is_rgb,
            time_first,
            leading: sides[..sides.len() - 2].to_vec(),
        };
        let count = sequences.checked_mul(frames);
        match count.and_then(|count| count.checked_mul(layout.frame_bytes())) {
            Some(_) => Ok(layout),
            None => wrong(format!("its shape {shape:?} is too large")),
        }
    }

    /// The bytes of a frame.
    fn frame_bytes(&self) -> usize {
        let samples = if self.is_rgb { 3 } else { 1 };
        self.height * self.width * samples * self.number.bytes()
    }

    /// Every frame, sequence by sequence.
    pub(super) fn positions(&self) -> impl Iterator<Item = FramePosition> {
        (0..self.sequences * self.frames).map(|image| self.position(image))
    }

    fn position(&self, image: usize) -> FramePosition {
        let (sequence, frame) = (image / self.frames, image % self.frames);
        let index = if self.time_first {
            frame * self.sequences + sequence
        } else {
            image
        };
        FramePosition { sequence, frame, index }
    }
}

/// A frame of an array.
pub(super) struct FramePosition {
    pub(super) sequence: usize,
    pub(super) frame: usize,
    /// Its position in the array, in frames.
    pub(super) index: usize,
}

impl FramePosition {
    /// Its record without action and state.
    pub(super) fn record(&self, timestamp_s: f64, place: &str) -> Record {
        let (sequence, frame) = (self.sequence, self.frame);
        Record {
            timestamp_s,
            session: sequence.to_string(),
            place: format!("{place} sequence {sequence} frame {frame}"),
            ..Record::default()
        }
    }
}

/// The frames of an array that begins at `start` in a file, in the order of [`FrameLayout::positions`].
pub(super) struct RawImages {
    pub(super) path: PathBuf,
    pub(super) file: PositionedFile,
    pub(super) start: u64,
    pub(super) layout: FrameLayout,
}

impl ImageSource for RawImages {
    fn read(&self, wanted: &Record, _cancelled: &AtomicBool) -> Result<Frame, ImportError> {
        let (layout, place) = (&self.layout, &wanted.place);
        let mut bytes = vec![0; layout.frame_bytes()];
        let start = self.start + (layout.position(wanted.image).index * bytes.len()) as u64;
        let read = self.file.read_at(&mut bytes, start);
        read.map_err(ImportError::io("read", &self.path))?;
        let pixels = match layout.number {
            NumberType::U8 if layout.is_rgb => codec::gray_from_rgb(&bytes),
            NumberType::U8 => bytes,
            number => {
                let levels = number.values(&bytes).into_iter().map(|value| gray_level(value, place));
                levels.collect::<Result<_, _>>()?
            }
        };
        let frame = Frame::new(layout.width as u32, layout.height as u32, pixels);
        frame.map_err(ImportError::image(place, &self.path))
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
#[cfg(test)]
mod tests {
    use super::*;

    fn layout(number: NumberType, shape: &[usize]) -> FrameLayout {
        FrameLayout::of(number, shape, "a.npy").unwrap()
    }

    #[test]
    fn time_is_the_shorter_of_the_first_sides() {
        let of_digits = layout(NumberType::U8, &[20, 10000, 64, 64]);
        assert_eq!((of_digits.sequences, of_digits.frames), (10000, 20));
        assert_eq!(of_digits.position(3 * 20 + 2).index, 2 * 10000 + 3);
        let colors = layout(NumberType::U8, &[9, 48, 64, 3]);
        assert_eq!((colors.frames, colors.width, colors.is_rgb), (9, 64, true));
    }
}
