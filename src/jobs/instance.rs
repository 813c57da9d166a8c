//! Who a runner is: an id that it finds again at its next start, in a file that it keeps locked while it lives. The lock
//! goes with the process however that ends, so whoever holds it knows that nobody else works under that id.

use std::fs::{File, OpenOptions, TryLockError};
use std::io::{Read as _, Write as _};
use std::path::Path;

use super::JobError;

/// Runners in one data directory at most.
const MAX_RUNNERS: usize = 64;

/// A runner's identity.
pub(super) struct Instance {
    /// Random when it was made, and the same ever after.
    pub(super) id: String,
    _lock: File,
}

impl Instance {
    /// The first identity of the data directory that nobody uses. Errors: `Instance`.
    pub(super) fn claim(data_dir: &Path) -> Result<Self, JobError> {
        let dir = data_dir.join("runners");
        std::fs::create_dir_all(&dir).map_err(JobError::Instance)?;
        for slot in 0..MAX_RUNNERS {
            let path = dir.join(format!("{slot}.lock"));
            let mut options = OpenOptions::new();
            let file = options.create(true).truncate(false).read(true).write(true).open(path);
            let file = file.map_err(JobError::Instance)?;
            match file.try_lock() {
                Ok(()) => return Self::read(file).map_err(JobError::Instance),
                Err(TryLockError::WouldBlock) => {}
                Err(TryLockError::Error(error)) => return Err(JobError::Instance(error)),
            }
        }
        let reason = format!("{MAX_RUNNERS} processes work in {} already", data_dir.display());
        Err(JobError::Instance(std::io::Error::other(reason)))
    }

    fn read(mut file: File) -> std::io::Result<Self> {
        let mut id = String::new();
        file.read_to_string(&mut id)?;
        if id.len() != 16 {
            id = format!("{:016x}", getrandom::u64().map_err(std::io::Error::other)?);
            file.set_len(0)?;
            file.write_all(id.as_bytes())?;
            file.sync_all()?;
        }
        Ok(Self { id, _lock: file })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_identity_is_found_again_when_its_holder_is_gone_and_never_shared() {
        let dir = tempfile::tempdir().unwrap();
        let first = Instance::claim(dir.path()).unwrap();
        let second = Instance::claim(dir.path()).unwrap();
        assert_ne!(first.id, second.id);
        let id = first.id.clone();
        drop(first);
        assert_eq!(Instance::claim(dir.path()).unwrap().id, id);
    }
}
