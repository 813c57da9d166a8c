//! The decoded frames of a data set in one file, for data sets that memory does not hold.
//!
//! The file is in the directory `.cache` of the data set. Its name contains the size of the frames and the content hash, so
//! that it is never used for other data. It holds all frames in order, then all masks; each is a record of the pixels, row by
//! row, and their CRC-32. Reading a frame costs one read of the system, whose own cache keeps what memory allows. The file is
//! only a copy: it can be deleted at any time, and is written again when it is needed.

use std::fs::{self, File, TryLockError};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};

use crate::dataset::{DatasetError, DatasetInfo};
use foreframe_core::files::{PositionedFile, is_partial, open_lock, partial_path};

/// The directory in a data set's directory. Backups leave out hidden directories.
const DIRECTORY: &str = ".cache";
/// The file that is locked while frames are decoded.
const LOCK: &str = "lock";
const CHECKSUM_BYTES: usize = 4;
/// Digits of the content hash in the file's name.
const HASH_DIGITS: usize = 16;
/// How many times the log states how far the decoding is.
const LOGGED_PARTS: usize = 10;

/// The place of a data set's file of decoded frames, and the records that it holds.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct FrameFilePlace {
    /// It contains the content hash, so equal paths mean equal frames.
    path: PathBuf,
    /// Number of frames.
    frames: usize,
    /// Number of records: frames and masks.
    images: usize,
    /// Pixels of a record.
    image_bytes: usize,
}

impl FrameFilePlace {
    pub(crate) fn of(directory: &Path, info: &DatasetInfo) -> Self {
        let hash = info.content_hash.get(..HASH_DIGITS).unwrap_or(&info.content_hash);
        let name = format!("frames-{}x{}-{hash}", info.frame_width_px, info.frame_height_px);
        Self {
            path: directory.join(DIRECTORY).join(name),
            frames: info.frame_count,
            images: info.image_count(),
            image_bytes: info.frame_pixels(),
        }
    }

    /// Where a record begins.
    fn position(&self, image: usize) -> u64 {
        image as u64 * (self.image_bytes + CHECKSUM_BYTES) as u64
    }

    fn total_bytes(&self) -> u64 {
        self.position(self.images)
    }

    fn directory(&self) -> &Path {
        self.path.parent().unwrap_or(Path::new("."))
    }

    /// The file, if it is complete. Errors: `Io`.
    pub(crate) fn open(&self) -> Result<Option<FrameFile>, DatasetError> {
        let opened = File::open(&self.path).and_then(|file| Ok((file.metadata()?.len(), file)));
        match opened {
            Ok((length, file)) if length == self.total_bytes() => Ok(Some(FrameFile {
                place: self.clone(),
                file: PositionedFile::new(file),
            })),
            Ok((length, _)) => {
                let expected = self.total_bytes();
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
        let directory = self.directory();
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
        let entries = fs::read_dir(self.directory()).map_err(|error| self.failed(error))?;
        for entry in entries.flatten() {
            let name = entry.file_name();
            if name.as_encoded_bytes().starts_with(b"frames-") || is_partial(&entry.path()) {
                // A file that cannot be deleted costs only disk space.
                let _ = fs::remove_file(entry.path());
            }
        }
        let partial = partial_path(&self.path).map_err(|error| self.failed(error))?;
        let file = File::options().read(true).write(true).create_new(true).open(&partial);
        tracing::info!(
            images = self.images, mb = self.total_bytes() >> 20, path = %self.path.display(),
            "decoding the frames of the data set into a file, once"
        );
        Ok(FrameFileWriter {
            place: self,
            file: PositionedFile::new(file.map_err(|error| self.failed(error))?),
            partial,
            done: AtomicUsize::new(0),
        })
    }

    fn failed(&self, source: io::Error) -> DatasetError {
        DatasetError::FrameFile {
            path: self.path.clone(),
            size_mib: self.total_bytes().div_ceil(1 << 20),
            source,
        }
    }
}

/// A file of decoded frames that is being written.
pub(crate) struct FrameFileWriter<'a> {
    place: &'a FrameFilePlace,
    file: PositionedFile,
    partial: PathBuf,
    /// How many images are written.
    done: AtomicUsize,
}

impl FrameFileWriter<'_> {
    /// Writes an image; threads may write different images at the same time. Errors: `FrameFile`.
    pub(crate) fn write(&self, image: usize, pixels: &[u8]) -> Result<(), DatasetError> {
        let record = [pixels, &crc32fast::hash(pixels).to_le_bytes()].concat();
        let written = self.file.write_at(&record, self.place.position(image));
        written.map_err(|error| self.place.failed(error))?;
        let done = self.done.fetch_add(1, Ordering::Relaxed) + 1;
        if done.is_multiple_of(self.place.images.div_ceil(LOGGED_PARTS)) {
            let percent = 100 * done / self.place.images;
            tracing::info!(percent, "decoding the frames of the data set");
        }
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

/// A complete file of decoded frames.
#[derive(Debug)]
pub(crate) struct FrameFile {
    place: FrameFilePlace,
    file: PositionedFile,
}

impl FrameFile {
    /// The pixels of an image, row by row. Errors: `Io` (also if there is no such image), `Corrupt`.
    pub(crate) fn read(&self, image: usize) -> Result<Vec<u8>, DatasetError> {
        let place = &self.place;
        let mut record = vec![0; place.image_bytes + CHECKSUM_BYTES];
        self.file
            .read_at(&mut record, place.position(image))
            .map_err(DatasetError::io("read", &place.path))?;
        let checksum = record.split_off(place.image_bytes);
        if checksum == crc32fast::hash(&record).to_le_bytes() {
            return Ok(record);
        }
        // The masks follow the frames.
        let damaged = match image.checked_sub(place.frames) {
            None => format!("frame {image}"),
            Some(frame) => format!("the mask of frame {frame}"),
        };
        let reason = format!("{damaged} has another checksum; delete this file, and it is written again");
        Err(DatasetError::corrupt(&place.path, &reason))
    }
}

impl PartialEq for FrameFile {
    fn eq(&self, other: &Self) -> bool {
        self.place == other.place
    }
}
