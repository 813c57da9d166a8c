//! `NumPy` arrays of frames (`.npy`): T×H×W, or many sequences as T×N×H×W or N×T×H×W (the shorter of the two first sides
//! is time, as in Moving MNIST's test file), as bytes or as floating-point numbers 0…1.

use std::fs::File;
use std::io::{BufReader, Read};
use std::path::Path;
use std::sync::Mutex;

use super::recording::{Images, PixelType, RawImages, Record, Recording};
use super::{ImportError, ImportOptions};

const MAGIC: &[u8; 6] = b"\x93NUMPY";
/// A header is a short Python dictionary.
const MAX_HEADER_BYTES: usize = 1 << 16;

/// Shape and type of an array, and where its values begin.
#[derive(Debug, PartialEq)]
struct Header {
    pixel: PixelType,
    shape: Vec<usize>,
    data_offset: u64,
}

/// Reads the header of an array. Errors: `Option` (no rate), `Io`, `Record`.
pub(super) fn open(path: &Path, options: &ImportOptions) -> Result<Recording, ImportError> {
    let Some(rate) = options.rate_hz else {
        return Err(ImportError::Option(format!(
            "{} has no timestamps; give the frames per second with --rate",
            path.display()
        )));
    };
    let file = File::open(path).map_err(ImportError::io("read", path))?;
    let header = Header::read(BufReader::new(&file), path)?;
    let layout = ArrayLayout::of(&header, path)?;
    let frame_bytes = (layout.height * layout.width * header.pixel.bytes()) as u64;
    let needed = header.data_offset + (layout.sequences * layout.frames) as u64 * frame_bytes;
    let found = file.metadata().map_err(ImportError::io("read", path))?.len();
    if found < needed {
        return Err(ImportError::record(
            format!("{} byte {found}", path.display()),
            format!("the file ends here; its shape {:?} needs {needed} bytes", header.shape),
        ));
    }
    let (mut records, mut offsets) = (Vec::new(), Vec::new());
    for sequence in 0..layout.sequences {
        for frame in 0..layout.frames {
            records.push(Record {
                timestamp_s: frame as f64 / rate,
                session: sequence.to_string(),
                action: Vec::new(),
                state: Vec::new(),
                image: offsets.len(),
                place: format!("{} sequence {sequence} frame {frame}", path.display()),
            });
            offsets.push(header.data_offset + layout.position(sequence, frame) as u64 * frame_bytes);
        }
    }
    Ok(Recording {
        name: path
            .file_stem()
            .map_or_else(|| "array".to_owned(), |name| name.to_string_lossy().into_owned()),
        action_channels: Vec::new(),
        state_channels: Vec::new(),
        records,
        images: Images::Raw(RawImages {
            path: path.to_owned(),
            file: Mutex::new(file),
            width_px: layout.width as u32,
            height_px: layout.height as u32,
            offsets,
            pixel: header.pixel,
        }),
        skipped: Vec::new(),
    })
}

/// Which sides of the array are sequences, time, rows and columns.
struct ArrayLayout {
    sequences: usize,
    frames: usize,
    height: usize,
    width: usize,
    time_first: bool,
}

impl ArrayLayout {
    fn of(header: &Header, path: &Path) -> Result<Self, ImportError> {
        let (sequences, frames, height, width, time_first) = match *header.shape.as_slice() {
            [frames, height, width] => (1, frames, height, width, false),
            [frames, sequences, height, width] if frames <= sequences => (sequences, frames, height, width, true),
            [sequences, frames, height, width] => (sequences, frames, height, width, false),
            _ => {
                return Err(ImportError::record(
                    path.display().to_string(),
                    format!(
                        "the array's shape is {:?}; it must be T×H×W, T×N×H×W or N×T×H×W",
                        header.shape
                    ),
                ));
            }
        };
        let sides = 1..=crate::frame::MAX_SIDE_PX as usize;
        if !sides.contains(&height) || !sides.contains(&width) {
            return Err(ImportError::record(
                path.display().to_string(),
                format!(
                    "its frames are {width}×{height} px; each side must be 1 to {} px",
                    crate::frame::MAX_SIDE_PX
                ),
            ));
        }
        Ok(Self {
            sequences,
            frames,
            height,
            width,
            time_first,
        })
    }

    /// The frame's position in the file, in frames.
    fn position(&self, sequence: usize, frame: usize) -> usize {
        if self.time_first {
            frame * self.sequences + sequence
        } else {
            sequence * self.frames + frame
        }
    }
}

impl Header {
    /// Reads the `.npy` header, format versions 1 to 3. Errors: `Io`, `Record`.
    fn read(mut reader: impl Read, path: &Path) -> Result<Self, ImportError> {
        let wrong = |reason: String| ImportError::record(path.display().to_string(), reason);
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
        let pixel = match kind.as_str() {
            "|u1" | "<u1" | ">u1" | "u1" => PixelType::U8,
            "<f4" => PixelType::F32,
            "<f8" => PixelType::F64,
            kind if kind.contains('O') => {
                return Err(wrong(
                    "it holds Python objects (pickle), which are never read; save an array of uint8".to_owned(),
                ));
            }
            other => {
                return Err(wrong(format!(
                    "its values have type {other}; they must be uint8, or float32 or float64 (little endian) from 0 to 1"
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
            pixel,
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

    fn read(dictionary: &str) -> Result<Header, ImportError> {
        Header::read(array(dictionary).as_slice(), Path::new("a.npy"))
    }

    #[test]
    fn moving_mnist_header_is_read() {
        let text = "{'descr': '|u1', 'fortran_order': False, 'shape': (20, 10000, 64, 64), }\n";
        let header = read(text).unwrap();
        assert_eq!(
            header,
            Header {
                pixel: PixelType::U8,
                shape: vec![20, 10000, 64, 64],
                data_offset: 10 + text.len() as u64
            }
        );
        let layout = ArrayLayout::of(&header, Path::new("a.npy")).unwrap();
        assert_eq!((layout.sequences, layout.frames), (10000, 20));
        assert_eq!(layout.position(3, 2), 2 * 10000 + 3);
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
