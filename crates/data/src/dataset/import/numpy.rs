//! `NumPy` arrays of frames (`.npy`): T×H×W, or many sequences as T×N×H×W or N×T×H×W (the shorter of the two first sides
//! is time, as in Moving MNIST's test file), as bytes or as floating-point numbers 0…1, in gray or RGB.
//!
//! The header is parsed here, not by the crate `npyz`: it allocates whatever length a header states, up to 4 GiB.

use std::io::{BufReader, Read};
use std::path::Path;

use super::files::{open_file, stem};
use super::raw_images::{FrameLayout, FramePosition, NumberType, RawImages};
use super::recording::Recording;
use super::{ImportError, ImportOptions};
use foreframe_core::files::PositionedFile;

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

/// Reads the header of an array. Errors: `Option` (no rate), `Io`, `Record`.
pub(super) fn open(path: &Path, options: &ImportOptions) -> Result<Recording, ImportError> {
    options.names_no_values("an .npy file")?;
    let Some(rate) = options.rate_hz else {
        return Err(ImportError::Option(format!(
            "{} has no timestamps; give the frames per second with --rate",
            path.display()
        )));
    };
    let file = open_file(path)?;
    let place = path.display().to_string();
    let header = ArrayHeader::read(BufReader::new(&file), &place)?;
    let layout = FrameLayout::of(header.number, &header.shape, &place)?;
    let needed = header.data_offset.saturating_add(header.bytes());
    let found = file.metadata().map_err(ImportError::io("read", path))?.len();
    if found < needed {
        return Err(ImportError::record(
            format!("{place} byte {found}"),
            format!("the file ends here; its shape {:?} needs {needed} bytes", header.shape),
        ));
    }
    let record = |at: FramePosition| at.record(at.frame as f64 / rate, &place);
    let records = layout.positions().map(record).collect();
    let images = RawImages {
        path: path.to_owned(),
        file: PositionedFile::new(file),
        start: header.data_offset,
        layout,
    };
    Ok(Recording::new(stem(path, "array"), records, images))
}

impl ArrayHeader {
    /// The bytes of all values.
    pub(super) fn bytes(&self) -> u64 {
        let sides = self.shape.iter().map(|&side| side as u64);
        sides.fold(self.number.bytes() as u64, u64::saturating_mul)
    }

    /// Reads the `.npy` header, format versions 1 to 3. Errors: `Record`.
    pub(super) fn read(reader: impl Read, place: &str) -> Result<Self, ImportError> {
        let wrong = |reason: &str| ImportError::record(place, reason);
        let (text, data_offset) = header_text(reader, place)?;
        let kind = kind(&text).ok_or_else(|| wrong("its header names no type"))?;
        let number = match kind {
            "|u1" | "<u1" | ">u1" | "u1" => NumberType::U8,
            "|b1" => NumberType::Bool,
            "|i1" => NumberType::I8,
            "<i2" => NumberType::I16,
            "<u2" => NumberType::U16,
            "<f2" => NumberType::F16,
            "<i4" => NumberType::I32,
            "<u4" => NumberType::U32,
            "<i8" => NumberType::I64,
            "<u8" => NumberType::U64,
            "<f4" => NumberType::F32,
            "<f8" => NumberType::F64,
            kind if kind.contains('O') => {
                let reason = "it holds Python objects (pickle), which are never read; save an array of uint8";
                return Err(wrong(reason));
            }
            other => {
                return Err(wrong(&format!(
                    "its values have type {other}; frames must be uint8, or float32 or float64 (little endian) from 0 to 1; other \
                     numbers little-endian integers or floats of at most 64 bits"
                )));
            }
        };
        if after(&text, "fortran_order").is_some_and(|rest| rest.starts_with("True")) {
            return Err(wrong("it is in Fortran order; save numpy.ascontiguousarray of it"));
        }
        let shape = after(&text, "shape").and_then(|rest| {
            let (sides, _) = rest.strip_prefix('(')?.split_once(')')?;
            let sides = sides.split(',').map(str::trim).filter(|side| !side.is_empty());
            sides.map(|side| side.parse().ok()).collect::<Option<Vec<usize>>>()
        });
        Ok(Self {
            number,
            shape: shape.ok_or_else(|| wrong("its header has no shape"))?,
            data_offset,
        })
    }
}

/// The dictionary of a `.npy` header, and where the values begin. Errors: `Record`.
fn header_text(mut reader: impl Read, place: &str) -> Result<(String, u64), ImportError> {
    let wrong = |reason: &str| ImportError::record(place, reason);
    let mut read = |bytes: &mut [u8]| {
        let read = reader.read_exact(bytes);
        read.map_err(|_| wrong("the file ends within its header"))
    };
    let mut start = [0; 8];
    read(&mut start)?;
    if !start.starts_with(MAGIC) {
        return Err(wrong("this is not a NumPy array; save one with numpy.save"));
    }
    let mut length = [0; 4];
    let length_bytes = if start[6] == 1 { 2 } else { 4 };
    read(&mut length[..length_bytes])?;
    let length = u32::from_le_bytes(length) as usize;
    if length > MAX_HEADER_BYTES {
        return Err(wrong(&format!(
            "its header has {length} bytes; at most {MAX_HEADER_BYTES} are read"
        )));
    }
    let mut text = vec![0; length];
    read(&mut text)?;
    let text = String::from_utf8_lossy(&text).into_owned();
    Ok((text, (8 + length_bytes + length) as u64))
}

/// The type that a header names, as in `<f4`.
fn kind(text: &str) -> Option<&str> {
    let (kind, _) = after(text, "descr")?.strip_prefix('\'')?.split_once('\'')?;
    Some(kind)
}

/// Whether the values of an array are texts. Errors: `Record`.
pub(super) fn holds_texts(reader: impl Read, place: &str) -> Result<bool, ImportError> {
    let (text, _) = header_text(reader, place)?;
    Ok(kind(&text).is_some_and(|kind| kind.contains(['U', 'S'])))
}

/// The text after `'key':` in a Python dictionary.
fn after<'a>(text: &'a str, key: &str) -> Option<&'a str> {
    let (_, rest) = text.split_once(&format!("'{key}':"))?;
    Some(rest.trim_start())
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
        FrameLayout::of(header.number, &header.shape, "a.npy").map(|_| header)
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
