//! Other programs that do a part of the work, such as `ffmpeg`. A program ends with the work that started it: when the work is
//! cancelled, when it fails, and when this process is killed.

use std::io::{BufRead, Cursor, Read};
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::thread::JoinHandle;
use std::time::Duration;

/// Bytes of output that are passed on together.
const PIECE_BYTES: usize = 64 << 10;
/// Pieces that wait at most. A program that writes faster waits.
const WAITING_PIECES: usize = 16;
/// How often the work asks whether it was cancelled.
const POLL_EVERY: Duration = Duration::from_millis(20);
/// The longest line of output, in bytes.
const MAX_LINE_BYTES: usize = 64 << 10;
/// How much of a program's error output is kept, in bytes.
const MAX_REASON_BYTES: u64 = 4096;

/// Why a program could not be started or did not do its work.
#[derive(Debug, thiserror::Error)]
pub(super) enum ProgramError {
    /// It is not installed.
    #[error("it is not installed")]
    Missing,
    /// The system could not start it.
    #[error("it could not be started: {0}")]
    Start(#[source] std::io::Error),
    /// It ended with an error; the first line that it wrote about it.
    #[error("{0}")]
    Failed(String),
    /// The work was cancelled, and the program with it.
    #[error("it was stopped")]
    Cancelled,
}

/// Starts a program in a process group of its own, so that Ctrl-C in a terminal reaches only this process, which then stops the
/// program. On Linux, the system kills the program when the thread that started it ends. Errors: `Missing`, `Start`.
pub(super) fn spawn(command: &mut Command) -> Result<Child, ProgramError> {
    #[cfg(unix)]
    std::os::unix::process::CommandExt::process_group(command, 0);
    #[cfg(target_os = "linux")]
    end_with_this_process(command);
    command.spawn().map_err(|error| match error.kind() {
        std::io::ErrorKind::NotFound => ProgramError::Missing,
        _ => ProgramError::Start(error),
    })
}

#[cfg(target_os = "linux")]
fn end_with_this_process(command: &mut Command) {
    use rustix::process::{Pid, Signal, getpid, getppid, set_parent_process_death_signal};
    use std::os::unix::process::CommandExt as _;
    let parent: Pid = getpid();
    let ask = move || {
        set_parent_process_death_signal(Some(Signal::KILL))?;
        // The parent may have ended before the call.
        if getppid() == Some(parent) {
            Ok(())
        } else {
            Err(std::io::ErrorKind::Interrupted.into())
        }
    };
    #[expect(unsafe_code, reason = "no safe call sets the signal in the new process")]
    // SAFETY: between fork and exec, only two system calls are made; nothing is allocated or locked.
    unsafe {
        command.pre_exec(ask);
    }
}

/// A running program whose output is read. Dropping it kills the program.
pub(super) struct ProgramOutput {
    child: Child,
    pieces: Receiver<Vec<u8>>,
    piece: Cursor<Vec<u8>>,
    reason: Option<JoinHandle<String>>,
}

impl ProgramOutput {
    /// Starts the program. Errors: `Missing`, `Start`.
    pub(super) fn start(command: &mut Command) -> Result<Self, ProgramError> {
        command
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped());
        let mut child = spawn(command)?;
        let (sender, pieces) = sync_channel(WAITING_PIECES);
        let (output, errors) = (child.stdout.take(), child.stderr.take());
        std::thread::spawn(move || output.map(|output| pass_on(output, &sender)));
        let reason = std::thread::spawn(move || errors.map(first_line).unwrap_or_default());
        Ok(Self {
            child,
            pieces,
            piece: Cursor::default(),
            reason: Some(reason),
        })
    }

    /// Output that was not read yet; empty at its end. Errors: `Cancelled`.
    fn waiting(&mut self, cancelled: &AtomicBool) -> Result<&mut Cursor<Vec<u8>>, ProgramError> {
        while self.piece.position() == self.piece.get_ref().len() as u64 {
            if cancelled.load(Ordering::Acquire) {
                return Err(ProgramError::Cancelled);
            }
            match self.pieces.recv_timeout(POLL_EVERY) {
                Ok(piece) => self.piece = Cursor::new(piece),
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => break,
            }
        }
        Ok(&mut self.piece)
    }

    /// Reads until the buffer is full or the output ends. Returns how many bytes were read. Errors: `Cancelled`.
    pub(super) fn read(&mut self, buffer: &mut [u8], cancelled: &AtomicBool) -> Result<usize, ProgramError> {
        let mut filled = 0;
        while filled < buffer.len() {
            match self.waiting(cancelled)?.read(&mut buffer[filled..]) {
                Ok(count) if count > 0 => filled += count,
                _ => break,
            }
        }
        Ok(filled)
    }

    /// Reads the next line, without its end; `None` at the end of the output. Errors: `Cancelled`, `Failed` if the line is too long.
    pub(super) fn line(&mut self, cancelled: &AtomicBool) -> Result<Option<String>, ProgramError> {
        let mut line = Vec::new();
        while !line.ends_with(b"\n") {
            match self.waiting(cancelled)?.read_until(b'\n', &mut line) {
                Ok(_) if line.len() > MAX_LINE_BYTES => {
                    return Err(ProgramError::Failed("its output has a line without end".to_owned()));
                }
                Ok(count) if count > 0 => {}
                _ => break,
            }
        }
        let text = String::from_utf8_lossy(&line);
        Ok((!line.is_empty()).then(|| text.trim_end().to_owned()))
    }

    /// Waits for the program's end, after its output has ended. Returns the first line of its error output; empty without any.
    /// Errors: `Failed`, `Cancelled`.
    pub(super) fn finish(mut self, cancelled: &AtomicBool) -> Result<String, ProgramError> {
        let status = loop {
            match self.child.try_wait() {
                Ok(Some(status)) => break status,
                Ok(None) if cancelled.load(Ordering::Acquire) => return Err(ProgramError::Cancelled),
                Ok(None) => std::thread::sleep(POLL_EVERY / 4),
                Err(error) => return Err(ProgramError::Failed(error.to_string())),
            }
        };
        let reason = self.reason.take().and_then(|reason| reason.join().ok());
        match reason.unwrap_or_default() {
            reason if status.success() => Ok(reason),
            reason if reason.is_empty() => Err(ProgramError::Failed(status.to_string())),
            reason => Err(ProgramError::Failed(reason)),
        }
    }
}

impl Drop for ProgramOutput {
    fn drop(&mut self) {
        // It has ended already, unless the work was cancelled or failed.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Passes output on until it ends or nobody reads it.
fn pass_on(mut output: impl Read, sender: &SyncSender<Vec<u8>>) {
    loop {
        let mut piece = vec![0; PIECE_BYTES];
        match output.read(&mut piece) {
            Ok(0) => return,
            Ok(count) => piece.truncate(count),
            Err(error) if error.kind() == std::io::ErrorKind::Interrupted => continue,
            Err(_) => return,
        }
        if sender.send(piece).is_err() {
            return;
        }
    }
}

/// The first line of a program's error output. Reads all of it, so that the program never waits for this.
fn first_line(mut errors: impl Read) -> String {
    let mut first = Vec::new();
    // What cannot be read is left out of the message.
    let _ = errors.by_ref().take(MAX_REASON_BYTES).read_to_end(&mut first);
    let _ = std::io::copy(&mut errors, &mut std::io::sink());
    let text = String::from_utf8_lossy(&first);
    text.lines().next().unwrap_or_default().to_owned()
}

#[cfg(test)]
#[cfg(unix)]
mod tests {
    use super::*;

    static GO_ON: AtomicBool = AtomicBool::new(false);

    fn shell(script: &str) -> ProgramOutput {
        ProgramOutput::start(Command::new("sh").args(["-c", script])).unwrap()
    }

    #[test]
    fn lines_and_bytes_are_read_across_pieces() {
        let mut output = shell("seq 1 30000; printf abc");
        for number in 1..=30_000 {
            assert_eq!(output.line(&GO_ON).unwrap(), Some(number.to_string()));
        }
        let mut buffer = [0; 8];
        assert_eq!(output.read(&mut buffer, &GO_ON).unwrap(), 3);
        assert_eq!(&buffer[..3], b"abc");
        assert_eq!(output.line(&GO_ON).unwrap(), None);
        output.finish(&GO_ON).unwrap();
    }

    #[test]
    fn a_failed_program_says_why() {
        let mut output = shell("echo no such frame >&2; seq 1 100000 >&2; exit 3");
        assert_eq!(output.line(&GO_ON).unwrap(), None);
        assert_eq!(output.finish(&GO_ON).unwrap_err().to_string(), "no such frame");
        let missing = ProgramOutput::start(&mut Command::new("/no/such/program"));
        assert!(matches!(missing, Err(ProgramError::Missing)));
    }

    #[test]
    fn a_line_without_end_is_refused() {
        let error = shell("yes | tr -d '\\n'").line(&GO_ON).unwrap_err().to_string();
        assert_eq!(error, "its output has a line without end");
    }

    #[test]
    fn a_cancelled_read_returns_at_once() {
        let cancelled = AtomicBool::new(true);
        let mut output = shell("sleep 1000");
        assert!(matches!(output.line(&cancelled), Err(ProgramError::Cancelled)));
        assert!(matches!(output.finish(&cancelled), Err(ProgramError::Cancelled)));
    }
}
