//! The decoded frames of a data set in one file, for data sets that memory does not hold.
//!
//! The file is in the directory `.cache` of the data set. Its name contains the size of the frames and the content hash, so
//! that it is never used for other data. It holds all frames in order, then all masks; each is a record of the pixels, row by
//! row, and their CRC-32. Reading a frame costs one read of the system, whose own cache keeps what memory allows. The file is
//! only a copy: it can be deleted at any time, and is written again when it is needed.

use std::fs::{self, File, TryLockError};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::time::{Duration, Instant};

use crate::dataset::{DatasetError, DatasetInfo};
use foreframe_core::files::{PositionedFile, is_partial, open_lock, partial_path};

/// The directory in a data set's directory. Backups leave out hidden directories.
const DIRECTORY: &str = ".cache";
/// The file that is locked while frames are decoded.
const LOCK: &str = "lock";
const CHECKSUM_BYTES: usize = 4;
/// Digits of the content hash in the file's name.
const HASH_DIGITS: usize = 16;
/// How often the log states how far the decoding is.
const LOG_EVERY: Duration = Duration::from_secs(10);

/// An image of a frame: what the camera saw, or which pixels show which robot.
#[derive(Clone, Copy, Debug)]
pub(crate) enum FrameImage {
    Pixels,
    Mask,
}

/// Where the records of a file are.
#[derive(Clone, Copy, Debug, PartialEq)]
struct FileLayout {
    frames: usize,
    frame_pixels: usize,
    has_masks: bool,
}

impl FileLayout {
    fn of(info: &DatasetInfo) -> Self {
        Self {
            frames: info.frame_count,
            frame_pixels: info.frame_pixels(),
            has_masks: info.has_masks,
        }
    }

    fn record_bytes(&self) -> usize {
        self.frame_pixels + CHECKSUM_BYTES
    }

    fn records(&self) -> usize {
        self.frames * (1 + usize::from(self.has_masks))
    }

    fn total_bytes(&self) -> u64 {
        self.records() as u64 * self.record_bytes() as u64
    }

    fn position(&self, image: FrameImage, frame: usize) -> u64 {
        let record = match image {
            FrameImage::Pixels => frame,
            FrameImage::Mask => self.frames + frame,
        };
        record as u64 * self.record_bytes() as u64
    }
}

/// The place of a data set's file of decoded frames.
pub(crate) struct FrameFilePlace {
    path: PathBuf,
    layout: FileLayout,
}

impl FrameFilePlace {
    pub(crate) fn of(directory: &Path, info: &DatasetInfo) -> Self {
        let hash = info.content_hash.get(..HASH_DIGITS).unwrap_or(&info.content_hash);
        let name = format!("frames-{}x{}-{hash}", info.frame_width_px, info.frame_height_px);
        Self {
            path: directory.join(DIRECTORY).join(name),
            layout: FileLayout::of(info),
        }
    }

    /// The file, if it is complete. Errors: `Io`.
    pub(crate) fn open(&self) -> Result<Option<FrameFile>, DatasetError> {
        let opened = File::open(&self.path).and_then(|file| Ok((file.metadata()?.len(), file)));
        match opened {
            Ok((length, file)) if length == self.layout.total_bytes() => Ok(Some(FrameFile {
                path: self.path.clone(),
                file: PositionedFile::new(file),
                layout: self.layout,
            })),
            Ok((length, _)) => {
                let expected = self.layout.total_bytes();
                let path = self.path.display();
                tracing::warn!(%path, length, expected, "the decoded frames have a wrong length and are written again");
                Ok(None)
            }
            // What is wrong with the directory is reported when the file is written.
            Err(error) if matches!(error.kind(), io::ErrorKind::NotFound | io::ErrorKind::NotADirectory) => Ok(None),
            Err(error) => Err(DatasetError::io("read", &self.path)(error)),
        }
    }

    /// Locks the directory, creating it if it is missing. Waits while another process decodes. Errors: `FrameFile`.
    pub(crate) fn lock(&self) -> Result<File, DatasetError> {
        let directory = self.path.parent().unwrap_or(Path::new("."));
        let opened = fs::create_dir_all(directory).and_then(|()| open_lock(&directory.join(LOCK)));
        let lock = opened.map_err(|error| self.failed(error))?;
        if matches!(lock.try_lock(), Err(TryLockError::WouldBlock)) {
            tracing::info!(directory = %directory.display(), "another process decodes this data set; waiting for it");
            lock.lock().map_err(|error| self.failed(error))?;
        }
        // Without locks, as on some network drives, two processes may decode the same frames; both files are complete.
        Ok(lock)
    }

    /// Starts to write the file. Deletes those of other data and of killed writers; the caller holds the lock.
    /// Errors: `FrameFile`.
    pub(crate) fn create(&self) -> Result<FrameFileWriter<'_>, DatasetError> {
        let directory = self.path.parent().unwrap_or(Path::new("."));
        for entry in fs::read_dir(directory).map_err(|error| self.failed(error))?.flatten() {
            let name = entry.file_name();
            if name.as_encoded_bytes().starts_with(b"frames-") || is_partial(&entry.path()) {
                // A file that cannot be deleted costs only disk space.
                let _ = fs::remove_file(entry.path());
            }
        }
        let partial = partial_path(&self.path).map_err(|error| self.failed(error))?;
        let file = File::options().read(true).write(true).create_new(true).open(&partial);
        tracing::info!(
            frames = self.layout.frames, mb = self.layout.total_bytes() >> 20, path = %self.path.display(),
            "decoding the frames of the data set into a file, once"
        );
        Ok(FrameFileWriter {
            place: self,
            file: PositionedFile::new(file.map_err(|error| self.failed(error))?),
            partial,
            progress: Mutex::new(DecodingProgress::start()),
        })
    }

    fn failed(&self, source: io::Error) -> DatasetError {
        DatasetError::FrameFile {
            path: self.path.clone(),
            size_mib: self.layout.total_bytes().div_ceil(1 << 20),
            source,
        }
    }
}

/// A file of decoded frames that is being written.
pub(crate) struct FrameFileWriter<'a> {
    place: &'a FrameFilePlace,
    file: PositionedFile,
    partial: PathBuf,
    progress: Mutex<DecodingProgress>,
}

impl FrameFileWriter<'_> {
    /// Writes a frame; threads may write different frames at the same time. Errors: `FrameFile`.
    pub(crate) fn write(&self, image: FrameImage, frame: usize, pixels: &[u8]) -> Result<(), DatasetError> {
        let mut record = Vec::with_capacity(self.place.layout.record_bytes());
        record.extend_from_slice(pixels);
        record.extend_from_slice(&crc32fast::hash(pixels).to_le_bytes());
        self.file
            .write_at(&record, self.place.layout.position(image, frame))
            .map_err(|error| self.place.failed(error))?;
        let mut progress = self.progress.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        progress.add_one(self.place.layout.records());
        Ok(())
    }

    /// Completes the file after all frames are written. Errors: `FrameFile`, `Io`.
    pub(crate) fn finish(self) -> Result<FrameFile, DatasetError> {
        let place = self.place;
        let finished = self.file.sync().and_then(|()| fs::rename(&self.partial, &place.path));
        finished.map_err(|error| place.failed(error))?;
        place
            .open()?
            .ok_or_else(|| place.failed(io::Error::other("it has a wrong length")))
    }
}

impl Drop for FrameFileWriter<'_> {
    fn drop(&mut self) {
        // After `finish`, there is none. Otherwise it is of no use, and the next writer deletes it if this fails.
        let _ = fs::remove_file(&self.partial);
    }
}

/// How many frames are decoded, for the log.
struct DecodingProgress {
    done: usize,
    started: Instant,
    logged: Instant,
}

impl DecodingProgress {
    fn start() -> Self {
        let now = Instant::now();
        Self {
            done: 0,
            started: now,
            logged: now,
        }
    }

    fn add_one(&mut self, total: usize) {
        self.done += 1;
        if self.logged.elapsed() < LOG_EVERY {
            return;
        }
        self.logged = Instant::now();
        let left = self.started.elapsed().as_secs_f64() * (total - self.done) as f64 / self.done as f64;
        tracing::info!(
            percent = 100 * self.done / total.max(1),
            left_s = left.round(),
            "decoding the frames of the data set"
        );
    }
}

/// A complete file of decoded frames.
#[derive(Debug)]
pub(crate) struct FrameFile {
    path: PathBuf,
    file: PositionedFile,
    layout: FileLayout,
}

impl FrameFile {
    /// The pixels of a frame, row by row. Panics if there is no such frame. Errors: `Io`, `Corrupt`.
    pub(crate) fn read(&self, image: FrameImage, frame: usize) -> Result<Vec<u8>, DatasetError> {
        let frames = self.layout.frames;
        assert!(frame < frames, "frame {frame} of {frames} frames is a bug");
        let mut record = vec![0; self.layout.record_bytes()];
        self.file
            .read_at(&mut record, self.layout.position(image, frame))
            .map_err(DatasetError::io("read", &self.path))?;
        let checksum = record.split_off(self.layout.frame_pixels);
        if checksum == crc32fast::hash(&record).to_le_bytes() {
            return Ok(record);
        }
        let reason = format!("frame {frame} has another checksum; delete this file, and it is written again");
        Err(DatasetError::corrupt(&self.path, &reason))
    }

    pub(crate) fn has_masks(&self) -> bool {
        self.layout.has_masks
    }
}

/// The name contains the content hash, so equal names mean equal frames.
impl PartialEq for FrameFile {
    fn eq(&self, other: &Self) -> bool {
        (&self.path, self.layout) == (&other.path, other.layout)
    }
}
