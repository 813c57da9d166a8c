//! Reads handwritten digits: IDX files as those of MNIST, compressed with gzip or not, or folders of PNG images.

use std::fs;
use std::io::Read;
use std::path::{Path, PathBuf};

use flate2::read::MultiGzDecoder;
use sha2::{Digest, Sha256};

use crate::dataset::{DatasetError, Split};
use foreframe_core::files::files_below;
use foreframe_core::frame::codec;
use foreframe_sim::moving_digits::{DIGIT_PIXELS, DIGIT_SIDE_PX};

/// The names of MNIST's files, without and with compression.
const TRAIN_FILES: [&str; 2] = ["train-images-idx3-ubyte", "train-images-idx3-ubyte.gz"];
const TEST_FILES: [&str; 2] = ["t10k-images-idx3-ubyte", "t10k-images-idx3-ubyte.gz"];
/// The folders of PNG images that are told apart.
const TRAIN_FOLDER: &str = "train";
const TEST_FOLDER: &str = "test";
/// The first bytes of a gzip file.
const GZIP: [u8; 2] = [0x1f, 0x8b];
/// The first number of an IDX file of bytes in three dimensions.
const IDX_BYTES_3D: u32 = 0x0000_0803;
const IDX_HEADER_BYTES: usize = 16;
/// Largest decompressed file; MNIST's has 47 MB.
const MAX_FILE_BYTES: u64 = 1 << 28;
/// One digit of this many is kept from training.
const PART: usize = 10;

/// A digit's intensities, row by row, 0 for black.
pub(crate) type DigitImage = [u8; DIGIT_PIXELS];

/// Digits for training, validation and test. No digit is in two of them.
pub(crate) struct DigitPools([Vec<DigitImage>; 3]);

impl DigitPools {
    /// Reads digits from an IDX file, a folder with MNIST's two IDX files, a folder of PNG images, or one with folders
    /// `train` and `test` of them. Of files for training and test, a tenth of those for training is for validation; of a
    /// single file or folder, a tenth each is for validation and test. Errors: `Io`, `Invalid`.
    pub(crate) fn read(path: &Path) -> Result<Self, DatasetError> {
        let found = |names: &[&str]| names.iter().map(|name| path.join(name)).find(|file| file.exists());
        let parts = found(&TRAIN_FILES)
            .zip(found(&TEST_FILES))
            .or_else(|| found(&[TRAIN_FOLDER]).zip(found(&[TEST_FOLDER])));
        let (digits, test) = match &parts {
            Some((train, test)) => (read_images(train)?, Some(read_images(test)?)),
            None => (read_images(path)?, None),
        };
        let count = digits.len();
        if count < PART {
            return refused(path, &format!("{count} digits were found; at least {PART} are needed"));
        }
        if test.as_ref().is_some_and(Vec::is_empty) {
            return refused(path, "the part for tests has no digits; at least one is needed");
        }
        let mut pools: [Vec<DigitImage>; 3] = Default::default();
        for (index, digit) in digits.into_iter().enumerate() {
            let split = match index % PART {
                0 => Split::Validation,
                1 if test.is_none() => Split::Test,
                _ => Split::Train,
            };
            pools[split as usize].push(digit);
        }
        pools[Split::Test as usize].extend(test.unwrap_or_default());
        Ok(Self(pools))
    }

    /// The digits for the trials of a split.
    pub(crate) fn of(&self, split: Split) -> &[DigitImage] {
        &self.0[split as usize]
    }

    /// SHA-256 of all digits, in hexadecimal.
    pub(crate) fn hash(&self) -> String {
        let mut hasher = Sha256::new();
        for pool in &self.0 {
            hasher.update((pool.len() as u64).to_le_bytes());
            hasher.update(pool.as_flattened());
        }
        format!("{:x}", hasher.finalize())
    }
}

fn refused<T>(path: &Path, reason: &str) -> Result<T, DatasetError> {
    let path = path.display();
    Err(DatasetError::Invalid(format!(
        "{path} cannot be used as digits: {reason}"
    )))
}

fn read_images(path: &Path) -> Result<Vec<DigitImage>, DatasetError> {
    if path.is_dir() {
        read_folder(path)
    } else {
        read_idx(path)
    }
}

/// Every PNG image below a folder, in the order of the paths.
fn read_folder(folder: &Path) -> Result<Vec<DigitImage>, DatasetError> {
    let is_png = |path: &&PathBuf| path.extension().is_some_and(|name| name.eq_ignore_ascii_case("png"));
    let files = files_below(folder).map_err(DatasetError::io("read", folder))?;
    let digits: Result<Vec<_>, _> = files.iter().filter(is_png).map(|path| read_png(path)).collect();
    let digits = digits?;
    if digits.is_empty() {
        let reason = format!(
            "it holds no PNG images; give an IDX file, or a folder with PNG images or with {} and {}",
            TRAIN_FILES[1], TEST_FILES[1]
        );
        return refused(folder, &reason);
    }
    Ok(digits)
}

fn read_png(path: &Path) -> Result<DigitImage, DatasetError> {
    let bytes = fs::read(path).map_err(DatasetError::io("read", path))?;
    let frame = match codec::decode(&bytes) {
        Ok(frame) => frame,
        Err(error) => return refused(path, &error.to_string()),
    };
    let (width, height) = (frame.width(), frame.height());
    match <DigitImage>::try_from(frame.pixels()) {
        Ok(digit) if width as usize == DIGIT_SIDE_PX => Ok(digit),
        _ => {
            let side = DIGIT_SIDE_PX;
            let reason = format!("it has {width}×{height} px; a digit has {side}×{side} px");
            refused(path, &reason)
        }
    }
}

/// An IDX file of digits (magic 2051, then the number of digits, rows and columns, big endian, then the pixels).
fn read_idx(path: &Path) -> Result<Vec<DigitImage>, DatasetError> {
    let mut bytes = fs::read(path).map_err(DatasetError::io("read", path))?;
    if bytes.starts_with(&GZIP) {
        let mut plain = Vec::new();
        let mut decoder = MultiGzDecoder::new(bytes.as_slice()).take(MAX_FILE_BYTES);
        if let Err(error) = decoder.read_to_end(&mut plain) {
            return refused(path, &format!("its compression is damaged: {error}"));
        }
        bytes = plain;
    }
    let Some((header, pixels)) = bytes.split_at_checked(IDX_HEADER_BYTES) else {
        return refused(path, "it ends within its header; give an IDX file of images");
    };
    let words = header.as_chunks::<4>().0;
    let [magic, count, rows, columns] = [0, 1, 2, 3].map(|word: usize| u32::from_be_bytes(words[word]));
    let (digits, rest) = pixels.as_chunks::<DIGIT_PIXELS>();
    let side = DIGIT_SIDE_PX;
    let wrong = if magic != IDX_BYTES_3D {
        "it does not begin as an IDX file of images; give one as train-images-idx3-ubyte.gz".to_owned()
    } else if [rows, columns] != [side as u32; 2] {
        format!("its images are {columns}×{rows} px; digits are {side}×{side} px")
    } else if digits.len() != count as usize || !rest.is_empty() {
        format!(
            "its header states {count} images, and {} bytes follow; {} are needed",
            pixels.len(),
            u64::from(count) * DIGIT_PIXELS as u64
        )
    } else {
        return Ok(digits.to_vec());
    };
    refused(path, &wrong)
}
