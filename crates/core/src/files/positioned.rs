//! A file that several threads read and write at stated positions at the same time.

use std::fs::File;
use std::io;

/// An open file without a position of its own.
#[derive(Debug)]
pub struct PositionedFile {
    #[cfg(unix)]
    file: File,
    /// Its position is set before each access.
    #[cfg(not(unix))]
    file: std::sync::Mutex<File>,
}

#[cfg(unix)]
impl PositionedFile {
    /// Wraps the file.
    pub fn new(file: File) -> Self {
        Self { file }
    }

    /// Fills the buffer from this position on. Errors: those of the system, `UnexpectedEof` if the file ends before.
    pub fn read_at(&self, buffer: &mut [u8], position: u64) -> io::Result<()> {
        std::os::unix::fs::FileExt::read_exact_at(&self.file, buffer, position)
    }

    /// Writes all bytes from this position on. Errors: those of the system.
    pub fn write_at(&self, bytes: &[u8], position: u64) -> io::Result<()> {
        std::os::unix::fs::FileExt::write_all_at(&self.file, bytes, position)
    }

    /// Waits until everything written is on the disk. Errors: those of the system.
    pub fn sync(&self) -> io::Result<()> {
        self.file.sync_all()
    }
}

#[cfg(not(unix))]
impl PositionedFile {
    /// Wraps the file.
    pub fn new(file: File) -> Self {
        let file = std::sync::Mutex::new(file);
        Self { file }
    }

    /// Fills the buffer from this position on. Errors: those of the system, `UnexpectedEof` if the file ends before.
    pub fn read_at(&self, buffer: &mut [u8], position: u64) -> io::Result<()> {
        io::Read::read_exact(&mut *self.seek(position)?, buffer)
    }

    /// Writes all bytes from this position on. Errors: those of the system.
    pub fn write_at(&self, bytes: &[u8], position: u64) -> io::Result<()> {
        io::Write::write_all(&mut *self.seek(position)?, bytes)
    }

    /// Waits until everything written is on the disk. Errors: those of the system.
    pub fn sync(&self) -> io::Result<()> {
        self.lock().sync_all()
    }

    fn seek(&self, position: u64) -> io::Result<std::sync::MutexGuard<'_, File>> {
        let mut file = self.lock();
        io::Seek::seek(&mut *file, io::SeekFrom::Start(position))?;
        Ok(file)
    }

    /// Another thread's panic leaves only the position undefined, and that is set anew.
    fn lock(&self) -> std::sync::MutexGuard<'_, File> {
        self.file.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
    }
}
