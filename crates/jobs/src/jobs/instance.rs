//! The id of a runner. It is stored in a file, so that the runner has the same id after a restart. The runner locks the
//! file while it lives; the lock ends with the process, so no two processes have the same id at the same time.

use std::fs::{File, TryLockError};
use std::io::{Read as _, Write as _};
use std::path::Path;

use super::JobError;
use foreframe_core::files::open_lock;

/// The maximum number of runners in one data directory.
const MAX_RUNNERS: usize = 64;

/// A runner's identity.
pub(super) struct Instance {
    /// Random, and stable over restarts.
    pub(super) id: String,
    _lock: File,
}

impl Instance {
    /// Locks the first free id of the data directory. Errors: `Instance`.
    pub(super) fn claim(data_dir: &Path) -> Result<Self, JobError> {
        let dir = data_dir.join("runners");
        std::fs::create_dir_all(&dir).map_err(JobError::Instance)?;
        for slot in 0..MAX_RUNNERS {
            let path = dir.join(format!("{slot}.lock"));
            let file = open_lock(&path).map_err(JobError::Instance)?;
            match file.try_lock() {
                Ok(()) => return Self::read(file).map_err(JobError::Instance),
                Err(TryLockError::WouldBlock) => {}
                Err(TryLockError::Error(error)) => return Err(JobError::Instance(error)),
            }
        }
        let reason = format!("{MAX_RUNNERS} processes already run jobs in {}", data_dir.display());
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
    fn a_runner_id_is_reused_after_its_holder_is_gone() {
        let dir = tempfile::tempdir().unwrap();
        let first = Instance::claim(dir.path()).unwrap();
        let second = Instance::claim(dir.path()).unwrap();
        assert_ne!(first.id, second.id);
        let id = first.id.clone();
        drop(first);
        assert_eq!(Instance::claim(dir.path()).unwrap().id, id);
    }
}
