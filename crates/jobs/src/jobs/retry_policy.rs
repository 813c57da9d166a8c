//! Waits for a store that is away: a database that is being restarted, an object store that answers with errors, a file
//! system that is full or read-only.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use tokio::runtime::Handle;
use tracing::warn;

use super::executor::JobFailure;
use super::report::JobReporter;
use foreframe_core::error_kind::{ErrorKind, HasErrorKind};
use foreframe_core::error_text;

/// How long a job waits for a store before it fails. It can be resumed.
const LIMIT: Duration = Duration::from_hours(1);
/// The first pause between two tries. Each later one is twice as long.
const FIRST_PAUSE: Duration = Duration::from_secs(1);
const LONGEST_PAUSE: Duration = Duration::from_secs(30);
/// How often the job is asked during a pause whether it was cancelled.
const POLL: Duration = Duration::from_millis(50);

/// How long a job waits for another process, whose lease has expired, to unlock the directory.
const BUSY_TIMEOUT: Duration = Duration::from_mins(1);
/// How often it tries.
const BUSY_POLL: Duration = Duration::from_millis(200);

/// How a running job asks the stores.
pub(super) struct RetryPolicy<'a> {
    pub(super) runtime: &'a Handle,
    pub(super) report: &'a JobReporter,
    pub(super) cancelled: &'a AtomicBool,
}

impl RetryPolicy<'_> {
    /// Does the work again and again while the store is away. Errors: `Failed` after an hour or for any other reason, `Cancelled`.
    pub(super) fn run<T, E: HasErrorKind>(&self, mut work: impl AsyncFnMut() -> Result<T, E>) -> Result<T, JobFailure> {
        self.repeat(|| self.runtime.block_on(work()))
    }

    /// The same for work that blocks in a directory that another process can have locked: waits for that, too.
    pub(super) fn repeat_once_free<T, E: HasErrorKind>(
        &self,
        mut work: impl FnMut() -> Result<T, E>,
    ) -> Result<T, JobFailure> {
        let is_busy = |error: &E| error.kind() == ErrorKind::Busy;
        self.repeat(|| retry_while_busy(&mut work, is_busy, self.cancelled))
    }

    /// The same for work that blocks. While it waits, the job's progress says for what.
    pub(super) fn repeat<T, E: HasErrorKind>(&self, work: impl FnMut() -> Result<T, E>) -> Result<T, JobFailure> {
        let mut away_since = None;
        let done = self.repeat_while_away(work, &mut away_since);
        if away_since.is_some() {
            self.report.waiting(None);
        }
        done
    }

    /// `away_since`: since when the store is away.
    fn repeat_while_away<T, E: HasErrorKind>(
        &self,
        mut work: impl FnMut() -> Result<T, E>,
        away_since: &mut Option<Instant>,
    ) -> Result<T, JobFailure> {
        let mut pause = FIRST_PAUSE;
        loop {
            let began = Instant::now();
            let error = match work() {
                Ok(done) => return Ok(done),
                Err(error) => error,
            };
            let reason = error_text::with_causes(&error);
            // Work that took so long has found the store in between.
            away_since.take_if(|_| began.elapsed() >= LIMIT);
            if error.kind() != ErrorKind::Away || away_since.is_some_and(|since| since.elapsed() >= LIMIT) {
                return Err(JobFailure::Failed(reason));
            }
            if away_since.is_none() {
                warn!(reason, "a job waits for the store");
                let waiting = format!("waiting for the store: {reason}");
                self.report.line(waiting.clone());
                self.report.waiting(Some(waiting));
                (*away_since, pause) = (Some(Instant::now()), FIRST_PAUSE);
            }
            let paused = Instant::now();
            while paused.elapsed() < pause {
                if self.cancelled.load(Ordering::Acquire) {
                    return Err(JobFailure::Cancelled);
                }
                std::thread::sleep(POLL);
            }
            pause = LONGEST_PAUSE.min(2 * pause);
        }
    }
}

/// Repeats the work while another process has locked the directory, at most for `BUSY_TIMEOUT` or until cancelled.
fn retry_while_busy<T, E>(
    mut work: impl FnMut() -> Result<T, E>,
    is_busy: impl Fn(&E) -> bool,
    cancelled: &AtomicBool,
) -> Result<T, E> {
    let began = Instant::now();
    loop {
        let done = work();
        let may_wait = began.elapsed() < BUSY_TIMEOUT && !cancelled.load(Ordering::Acquire);
        match done {
            Err(error) if is_busy(&error) && may_wait => std::thread::sleep(BUSY_POLL),
            done => return done,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::jobs::report::ReportTarget;
    use crate::store::{JobId, Lease, StoreError};

    fn away() -> StoreError {
        StoreError::Io {
            action: "write",
            path: "x".into(),
            source: std::io::ErrorKind::StorageFull.into(),
        }
    }

    /// Does work that finds the store away `times` times.
    fn tried(times: u32, other: Option<StoreError>, cancelled: bool) -> (Result<u32, JobFailure>, u32) {
        let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
        let lease = Lease {
            job: JobId::new(1),
            token: 1,
        };
        let retry = RetryPolicy {
            runtime: runtime.handle(),
            report: &JobReporter::new(lease, ReportTarget::Stdout(|_, _| Ok(()))),
            cancelled: &AtomicBool::new(cancelled),
        };
        let (mut tries, mut other) = (0, other);
        let done = retry.run(async || {
            tries += 1;
            match other.take() {
                Some(error) => Err(error),
                None if tries <= times => Err(away()),
                None => Ok(7),
            }
        });
        (done, tries)
    }

    #[test]
    fn a_job_waits_while_the_store_is_away_unless_cancelled() {
        assert_eq!(tried(1, None, false), (Ok(7), 2));
        assert_eq!(tried(9, None, true), (Err(JobFailure::Cancelled), 1));
    }

    #[test]
    fn a_job_does_not_wait_after_other_errors() {
        let (done, tries) = tried(0, Some(StoreError::NoTls), false);
        assert!(matches!(done, Err(JobFailure::Failed(_))) && tries == 1);
    }

    /// Retries work that is busy `busy` times. Returns its result and the number of tries.
    fn tried_busy(busy: u32, cancelled: bool) -> (Result<(), bool>, u32) {
        let mut tries = 0;
        let work = || {
            tries += 1;
            if tries > busy { Ok(()) } else { Err(true) }
        };
        let done = retry_while_busy(work, |is_busy| *is_busy, &AtomicBool::new(cancelled));
        (done, tries)
    }

    #[test]
    fn work_starts_once_the_directory_is_free_unless_cancelled() {
        assert_eq!(tried_busy(2, false), (Ok(()), 3));
        assert_eq!(tried_busy(2, true), (Err(true), 1));
    }

    #[test]
    fn other_errors_are_told_at_once() {
        let mut tries = 0;
        let work = || -> Result<(), bool> {
            tries += 1;
            Err(false)
        };
        assert_eq!(
            retry_while_busy(work, |is_busy| *is_busy, &AtomicBool::new(false)),
            Err(false)
        );
        assert_eq!(tries, 1);
    }
}
