//! The frames of an array, in a file without compression.

use std::path::PathBuf;
use std::sync::atomic::AtomicBool;

use arrow_array::types::{ArrowPrimitiveType, Float16Type};

use super::error::ImportError;
use super::recording::{ImageSource, Record};
use foreframe_core::files::PositionedFile;
use foreframe_core::frame::{Frame, MAX_SIDE_PX, codec};

/// How a number is stored: little endian.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum NumberType {
    Bool,
    I8,
    U8,
    I16,
    U16,
    F16,
    I32,
    U32,
    F32,
    I64,
    U64,
    F64,
}

impl NumberType {
    pub(super) fn bytes(self) -> usize {
        match self {
            Self::Bool | Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 | Self::F16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::I64 | Self::U64 | Self::F64 => 8,
        }
    }

    pub(super) fn values(self, bytes: &[u8]) -> Vec<f64> {
        type Half = <Float16Type as ArrowPrimitiveType>::Native;
        let twos = bytes.as_chunks::<2>().0.iter();
        let (fours, eights) = (bytes.as_chunks::<4>().0.iter(), bytes.as_chunks::<8>().0.iter());
        match self {
            Self::Bool | Self::U8 => bytes.iter().map(|&value| f64::from(value)).collect(),
            Self::I8 => bytes.iter().map(|&value| f64::from(value.cast_signed())).collect(),
            Self::I16 => twos.map(|bytes| f64::from(i16::from_le_bytes(*bytes))).collect(),
            Self::U16 => twos.map(|bytes| f64::from(u16::from_le_bytes(*bytes))).collect(),
            Self::F16 => twos.map(|bytes| f64::from(Half::from_le_bytes(*bytes))).collect(),
            Self::I32 => fours.map(|bytes| f64::from(i32::from_le_bytes(*bytes))).collect(),
            Self::U32 => fours.map(|bytes| f64::from(u32::from_le_bytes(*bytes))).collect(),
            Self::F32 => fours.map(|bytes| f64::from(f32::from_le_bytes(*bytes))).collect(),
            Self::I64 => eights.map(|bytes| i64::from_le_bytes(*bytes) as f64).collect(),
            Self::U64 => eights.map(|bytes| u64::from_le_bytes(*bytes) as f64).collect(),
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
        if !matches!(number, NumberType::U8 | NumberType::F32 | NumberType::F64) {
            let reason = "its values have another type; frames must be uint8, or float32 or float64 from 0 to 1";
            return wrong(reason.to_owned());
        }
        if let Some(right) = misplaced_channels(shape) {
            return wrong(format!("the array's shape is {shape:?}; {right}"));
        }
        // Frames of one or three columns are not worth predicting, so these are channels.
        let (sides, is_rgb) = match shape {
            [sides @ .., channels @ (1 | 3)] if sides.len() >= 3 => (sides, *channels == 3),
            sides => (sides, false),
        };
        let (sequences, frames, height, width, time_first) = match *sides {
            [frames, height, width] => (1, frames, height, width, false),
            [frames, sequences, height, width] if frames <= sequences => (sequences, frames, height, width, true),
            [sequences, frames, height, width] => (sequences, frames, height, width, false),
            _ => {
                return wrong(format!(
                    "the array's shape is {shape:?}; it must be T×H×W, T×N×H×W or N×T×H×W, or the same with 1 or 3 channels at the end"
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

/// What to do about an array whose channels would be taken for columns or frames.
fn misplaced_channels(shape: &[usize]) -> Option<&'static str> {
    match shape {
        [_, _, _, .., 2] => Some("2 channels are not read; keep one of them, as in frames[..., 0]"),
        [_, _, _, .., 4] => Some("4 channels are not read; keep red, green and blue: frames[..., :3]"),
        [_, _, _, 1 | 3] => None,
        [frames, 1, _, _] if *frames > 1 => {
            Some("a single channel must not come before the rows; leave it out: frames[:, 0]")
        }
        [frames, 3, _, _] if *frames > 3 => {
            Some("the 3 colors must come last; use numpy.transpose(frames, (0, 2, 3, 1)).copy()")
        }
        _ => None,
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
                let levels: Vec<u8> = levels.collect::<Result<_, _>>()?;
                if layout.is_rgb {
                    codec::gray_from_rgb(&levels)
                } else {
                    levels
                }
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

    #[test]
    fn channels_are_never_columns_or_frames() {
        for number in [NumberType::U8, NumberType::F32] {
            let (gray, colors) = (layout(number, &[100, 48, 64, 1]), layout(number, &[100, 48, 64, 3]));
            assert_eq!((gray.frames, gray.width, gray.is_rgb), (100, 64, false));
            assert_eq!((colors.frames, colors.width, colors.is_rgb), (100, 64, true));
            for (shape, right) in [
                ([100, 48, 64, 2], "frames[..., 0]"),
                ([100, 48, 64, 4], "frames[..., :3]"),
                ([100, 1, 48, 64], "frames[:, 0]"),
                ([100, 3, 48, 64], "numpy.transpose(frames, (0, 2, 3, 1))"),
            ] {
                let error = FrameLayout::of(number, &shape, "a.npy").err().unwrap().to_string();
                assert!(error.contains(right), "{error}");
            }
        }
    }

    #[test]
    fn numbers_of_every_type_are_read() {
        for (number, bytes, expected) in [
            (NumberType::Bool, &[1u8][..], 1.0),
            (NumberType::I8, &[0xff], -1.0),
            (NumberType::I16, &[0xfe, 0xff], -2.0),
            (NumberType::U16, &[0xfe, 0xff], 65534.0),
            (NumberType::F16, &[0x00, 0xbe], -1.5),
            (NumberType::U32, &[0, 0, 0, 0x80], 2_147_483_648.0),
            (
                NumberType::U64,
                &[0, 0, 0, 0, 0, 0, 0, 0x80],
                9_223_372_036_854_775_808.0,
            ),
        ] {
            assert_eq!((number.bytes(), number.values(bytes)), (bytes.len(), vec![expected]));
        }
    }
}
