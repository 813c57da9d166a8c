//! Images in files of their own.

use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use super::error::ImportError;
use super::files::read_file;
use super::recording::{ImageSource, Record};
use foreframe_core::files::is_transient;
use foreframe_core::frame::{Frame, codec};

/// Image files, by image number.
pub(super) struct ImageFiles(pub(super) Vec<PathBuf>);

impl ImageSource for ImageFiles {
    fn file(&self, wanted: &Record) -> Option<&Path> {
        Some(&self.0[wanted.image])
    }

    fn read(&self, wanted: &Record, _cancelled: &AtomicBool) -> Result<Frame, ImportError> {
        let Record { image, place, .. } = wanted;
        let path = &self.0[*image];
        codec::decode(&read_image(path, place)?).map_err(ImportError::image(place, path))
    }
}

/// The bytes of an image file. Errors: `Record` if it is missing or cannot be read, `Io` where trying again may help.
pub(super) fn read_image(path: &Path, place: &str) -> Result<Vec<u8>, ImportError> {
    read_file(path).map_err(|error| match error {
        ImportError::Io { source, .. } if source.kind() == std::io::ErrorKind::NotFound => {
            ImportError::record(place, format!("the image {} is missing", path.display()))
        }
        ImportError::Io { source, .. } if !is_transient(&source) => {
            ImportError::record(place, format!("the image {} cannot be read: {source}", path.display()))
        }
        other => other,
    })
}
