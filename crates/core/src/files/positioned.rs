//! A file that several threads read and write at stated positions at the same time.

use std::fs::File;
use std::io;
#[cfg(unix)]
use std::os::unix::fs::FileExt as _;

/// An open file without a position of its own.
#[derive(Debug)]
pub struct PositionedFile {
    file: File,
    /// Where the system has no access at a position, the file's position is set before each access.
    #[cfg(not(unix))]
    access: std::sync::Mutex<()>,
}

impl PositionedFile {
    /// Wraps the file.
    pub fn new(file: File) -> Self {
        Self {
            file,
            #[cfg(not(unix))]
            access: std::sync::Mutex::default(),
        }
    }

    /// Fills the buffer from this position on. Errors: those of the system, `UnexpectedEof` if the file ends before.
    pub fn read_at(&self, buffer: &mut [u8], position: u64) -> io::Result<()> {
        #[cfg(unix)]
        return self.file.read_exact_at(buffer, position);
        #[cfg(not(unix))]
        return self.at(position, |mut file| io::Read::read_exact(&mut file, buffer));
    }

    /// Writes all bytes from this position on. Errors: those of the system.
    pub fn write_at(&self, bytes: &[u8], position: u64) -> io::Result<()> {
        #[cfg(unix)]
        return self.file.write_all_at(bytes, position);
        #[cfg(not(unix))]
        return self.at(position, |mut file| io::Write::write_all(&mut file, bytes));
    }

    /// Waits until everything written is on the disk. Errors: those of the system.
    pub fn sync(&self) -> io::Result<()> {
        self.file.sync_all()
    }

    #[cfg(not(unix))]
    fn at(&self, position: u64, access: impl FnOnce(&File) -> io::Result<()>) -> io::Result<()> {
        // Another thread's panic leaves only the position undefined, and that is set anew.
        let _guard = self.access.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        io::Seek::seek(&mut &self.file, io::SeekFrom::Start(position))?;
        access(&self.file)
    }
}
