//! `NumPy` arrays of frames (`.npy`): T×H×W, or many sequences as T×N×H×W or N×T×H×W (the shorter of the two first sides
//! is time, as in Moving MNIST's test file), as bytes or as floating-point numbers 0…1, in gray, or as bytes in RGB.
//!
//! The header is parsed here, not by the crate `npyz`, which allocates whatever length a header states (up to 4 GiB).

use std::fs::File;
use std::io::{BufReader, Read};
use std::path::Path;
use std::sync::Mutex;

use super::files::{open_file, stem};
use super::raw_images::{PixelType, RawImages};
use super::recording::{Record, Recording};
use super::{ImportError, ImportOptions};

const MAGIC: &[u8; 6] = b"\x93NUMPY";
/// A header is a short Python dictionary.
const MAX_HEADER_BYTES: usize = 1 << 16;

/// Shape and type of an array, and where its values begin.
#[derive(Debug, PartialEq)]
pub(super) struct ArrayHeader {
    pub(super) number: NumberType,
    pub(super) shape: Vec<usize>,
    pub(super) data_offset: u64,
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

/// Reads the header of an array. Errors: `Option` (no rate), `Io`, `Record`.
pub(super) fn open(path: &Path, options: &ImportOptions) -> Result<Recording, ImportError> {
    let Some(rate) = options.rate_hz else {
        return Err(ImportError::Option(format!(
            "{} has no timestamps; give the frames per second with --rate",
            path.display()
        )));
    };
    let file = open_file(path)?;
    let place = path.display().to_string();
    let header = ArrayHeader::read(BufReader::new(&file), &place)?;
    let layout = FrameLayout::of(&header, &place)?;
    let needed = header.data_offset.saturating_add(header.bytes());
    let found = file.metadata().map_err(ImportError::io("read", path))?.len();
    if found < needed {
        return Err(ImportError::record(
            format!("{place} byte {found}"),
            format!("the file ends here; its shape {:?} needs {needed} bytes", header.shape),
        ));
    }
    let record = |(image, at): (usize, FramePosition)| at.record(image, at.frame as f64 / rate, &place);
    let records = layout.positions().enumerate().map(record).collect();
    let images = layout.images(path, file, header.data_offset);
    Ok(Recording::of_images(stem(path, "array"), records, images))
}

/// Which sides of the array are sequences, time, rows and columns.
pub(super) struct FrameLayout {
    pub(super) sequences: usize,
    pub(super) frames: usize,
    height: usize,
    width: usize,
    pixel: PixelType,
    time_first: bool,
    /// The sides before the rows.
    pub(super) leading: Vec<usize>,
}

impl FrameLayout {
    /// Errors: `Record` if the array holds no frames.
    pub(super) fn of(header: &ArrayHeader, place: &str) -> Result<Self, ImportError> {
        let wrong = |reason: String| Err(ImportError::record(place, reason));
        let pixel = match header.number {
            NumberType::U8 => PixelType::U8,
            NumberType::F32 => PixelType::F32,
            NumberType::F64 => PixelType::F64,
            NumberType::I32 | NumberType::I64 => {
                return wrong(
                    "its values are int32 or int64; frames must be uint8, or float32 or float64 from 0 to 1".to_owned(),
                );
            }
        };
        // Frames of three columns are not worth predicting, so these are colors.
        let (shape, pixel) = match header.shape.as_slice() {
            [shape @ .., 3] if shape.len() >= 3 && pixel == PixelType::U8 => (shape, PixelType::Rgb8),
            shape => (shape, pixel),
        };
        let (sequences, frames, height, width, time_first) = match *shape {
            [frames, height, width] => (1, frames, height, width, false),
            [frames, sequences, height, width] if frames <= sequences => (sequences, frames, height, width, true),
            [sequences, frames, height, width] => (sequences, frames, height, width, false),
            _ => {
                return wrong(format!(
                    "the array's shape is {:?}; it must be T×H×W, T×N×H×W or N×T×H×W, or the same with 3 colors at the end",
                    header.shape
                ));
            }
        };
        let sides = 1..=foreframe_core::frame::MAX_SIDE_PX as usize;
        if !sides.contains(&height) || !sides.contains(&width) {
            return wrong(format!(
                "its frames are {width}×{height} px; each side must be 1 to {} px",
                foreframe_core::frame::MAX_SIDE_PX
            ));
        }
        let bytes = sequences
            .checked_mul(frames)
            .and_then(|count| count.checked_mul(height * width * pixel.bytes()));
        if bytes.is_none() {
            return wrong(format!("its shape {:?} is too large", header.shape));
        }
        Ok(Self {
            sequences,
            frames,
            height,
            width,
            pixel,
            time_first,
            leading: shape[..shape.len() - 2].to_vec(),
        })
    }

    /// Every frame, sequence by sequence.
    pub(super) fn positions(&self) -> impl Iterator<Item = FramePosition> {
        let of = |sequence| (0..self.frames).map(move |frame| (sequence, frame));
        (0..self.sequences).flat_map(of).map(|(sequence, frame)| FramePosition {
            sequence,
            frame,
            index: self.index(sequence, frame),
        })
    }

    /// The frame's position in the array, in frames.
    fn index(&self, sequence: usize, frame: usize) -> usize {
        if self.time_first {
            frame * self.sequences + sequence
        } else {
            sequence * self.frames + frame
        }
    }

    /// The frames of a file whose values begin at `data_offset`, in the order of [`Self::positions`].
    pub(super) fn images(&self, path: &Path, file: File, data_offset: u64) -> RawImages {
        let frame_bytes = (self.height * self.width * self.pixel.bytes()) as u64;
        let offset = |at: FramePosition| data_offset + at.index as u64 * frame_bytes;
        RawImages {
            path: path.to_owned(),
            file: Mutex::new(file),
            width_px: self.width as u32,
            height_px: self.height as u32,
            offsets: self.positions().map(offset).collect(),
            pixel: self.pixel,
        }
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
    pub(super) fn record(&self, image: usize, timestamp_s: f64, place: &str) -> Record {
        let (sequence, frame) = (self.sequence, self.frame);
        Record {
            timestamp_s,
            session: sequence.to_string(),
            image,
            place: format!("{place} sequence {sequence} frame {frame}"),
            ..Record::default()
        }
    }
}

impl ArrayHeader {
    /// The bytes of all values.
    pub(super) fn bytes(&self) -> u64 {
        let sides = self.shape.iter().map(|&side| side as u64);
        sides.fold(self.number.bytes() as u64, u64::saturating_mul)
    }

    /// Reads the `.npy` header, format versions 1 to 3. Errors: `Io`, `Record`.
    pub(super) fn read(mut reader: impl Read, place: &str) -> Result<Self, ImportError> {
        let wrong = |reason: String| ImportError::record(place, reason);
        let mut read = |bytes: &mut [u8]| {
            let what = |_| wrong("the file ends within its header".to_owned());
            reader.read_exact(bytes).map_err(what)
        };
        let mut start = [0; 8];
        read(&mut start)?;
        if &start[..6] != MAGIC {
            return Err(wrong("this is not a NumPy array; save one with numpy.save".to_owned()));
        }
        let mut length = [0; 4];
        let length_bytes = if start[6] == 1 { 2 } else { 4 };
        read(&mut length[..length_bytes])?;
        let length = u32::from_le_bytes(length) as usize;
        if length > MAX_HEADER_BYTES {
            return Err(wrong(format!(
                "its header has {length} bytes; at most {MAX_HEADER_BYTES} are read"
            )));
        }
        let mut text = vec![0; length];
        read(&mut text)?;
        let text = String::from_utf8_lossy(&text);
        let kind = quoted(&text, "descr").ok_or_else(|| wrong("its header names no type".to_owned()))?;
        let number = match kind.as_str() {
            "|u1" | "<u1" | ">u1" | "u1" => NumberType::U8,
            "<i4" => NumberType::I32,
            "<i8" => NumberType::I64,
            "<f4" => NumberType::F32,
            "<f8" => NumberType::F64,
            kind if kind.contains('O') => {
                return Err(wrong(
                    "it holds Python objects (pickle), which are never read; save an array of uint8".to_owned(),
                ));
            }
            other => {
                return Err(wrong(format!(
                    "its values have type {other}; frames must be uint8, or float32 or float64 (little endian) from 0 to 1"
                )));
            }
        };
        if after(&text, "fortran_order").is_some_and(|rest| rest.starts_with("True")) {
            return Err(wrong(
                "it is in Fortran order; save numpy.ascontiguousarray of it".to_owned(),
            ));
        }
        let shape = after(&text, "shape")
            .and_then(|rest| rest.strip_prefix('(')?.split_once(')'))
            .map(|(sides, _)| sides.split(',').map(str::trim).filter(|side| !side.is_empty()))
            .and_then(|sides| sides.map(|side| side.parse().ok()).collect::<Option<Vec<usize>>>());
        Ok(Self {
            number,
            shape: shape.ok_or_else(|| wrong("its header has no shape".to_owned()))?,
            data_offset: (8 + length_bytes + length) as u64,
        })
    }
}

/// The text after `'key':` in a Python dictionary.
fn after<'a>(text: &'a str, key: &str) -> Option<&'a str> {
    let (_, rest) = text.split_once(&format!("'{key}':"))?;
    Some(rest.trim_start())
}

fn quoted(text: &str, key: &str) -> Option<String> {
    let rest = after(text, key)?.strip_prefix('\'')?;
    rest.split_once('\'').map(|(value, _)| value.to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn array(dictionary: &str) -> Vec<u8> {
        let mut bytes = MAGIC.to_vec();
        bytes.extend([1, 0]);
        bytes.extend((dictionary.len() as u16).to_le_bytes());
        bytes.extend(dictionary.as_bytes());
        bytes
    }

    fn read(dictionary: &str) -> Result<ArrayHeader, ImportError> {
        let header = ArrayHeader::read(array(dictionary).as_slice(), "a.npy")?;
        FrameLayout::of(&header, "a.npy").map(|_| header)
    }

    #[test]
    fn moving_mnist_header_is_read() {
        let text = "{'descr': '|u1', 'fortran_order': False, 'shape': (20, 10000, 64, 64), }\n";
        let header = read(text).unwrap();
        assert_eq!(
            header,
            ArrayHeader {
                number: NumberType::U8,
                shape: vec![20, 10000, 64, 64],
                data_offset: 10 + text.len() as u64
            }
        );
        let layout = FrameLayout::of(&header, "a.npy").unwrap();
        assert_eq!((layout.sequences, layout.frames), (10000, 20));
        assert_eq!(layout.index(3, 2), 2 * 10000 + 3);
        let header = read("{'descr': '|u1', 'fortran_order': False, 'shape': (9, 48, 64, 3), }").unwrap();
        let layout = FrameLayout::of(&header, "a.npy").unwrap();
        assert_eq!((layout.frames, layout.width, layout.pixel), (9, 64, PixelType::Rgb8));
    }

    #[test]
    fn pickled_objects_and_other_types_are_refused() {
        for (kind, reason) in [("|O", "pickle"), ("<i8", "uint8"), (">f4", "little endian")] {
            let error = read(&format!(
                "{{'descr': '{kind}', 'fortran_order': False, 'shape': (2, 4, 4), }}"
            ));
            let error = error.unwrap_err().to_string();
            assert!(error.contains(reason), "{error}");
        }
        assert!(read("{'descr': '|u1', 'fortran_order': True, 'shape': (2, 4, 4), }").is_err());
        assert!(read("{'descr': '|u1', 'fortran_order': False}").is_err());
    }
}
