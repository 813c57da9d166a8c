//! Work outside a request's own task: what would block the async runtime, and what must not stop half-way.

use std::io;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Mutex, PoisonError, mpsc};

use tokio::sync::{Semaphore, oneshot};

use super::http::problem::ApiError;
use foreframe_jobs::jobs::priority;

/// Work that could not be done.
#[derive(Debug, thiserror::Error)]
pub(super) enum TaskError {
    #[error("a task of the server failed: {0}")]
    Join(#[from] tokio::task::JoinError),
    #[error("a task of the server panicked; the reason is in the log")]
    Panicked,
    #[error("could not start a thread: {0}")]
    Thread(io::Error),
}

impl From<TaskError> for ApiError {
    fn from(error: TaskError) -> Self {
        Self::Internal(error.to_string())
    }
}

/// A bounded number of threads for work that would block the async runtime. Clones share the threads.
#[derive(Clone)]
pub(super) struct BlockingWork {
    places: Arc<Semaphore>,
    threads: Arc<WorkerThreads>,
}

type Work = Box<dyn FnOnce() + Send>;

/// Threads that start with the first work and end with the last clone of their owner.
struct WorkerThreads {
    name: &'static str,
    count: usize,
    has_low_priority: bool,
    work: Mutex<Option<mpsc::Sender<Work>>>,
}

impl WorkerThreads {
    /// Errors: `Thread` if the system starts no thread.
    fn run(&self, work: Work) -> Result<(), TaskError> {
        let mut sender = self.work.lock().unwrap_or_else(PoisonError::into_inner);
        let sender = match &mut *sender {
            Some(sender) => sender,
            absent => absent.insert(self.start().map_err(TaskError::Thread)?),
        };
        // The threads wait for work as long as there is a sender.
        sender.send(work).map_err(|_| TaskError::Panicked)
    }

    fn start(&self) -> io::Result<mpsc::Sender<Work>> {
        let (sender, receiver) = mpsc::channel::<Work>();
        let receiver = Arc::new(Mutex::new(receiver));
        for _ in 0..self.count {
            let (receiver, has_low_priority) = (Arc::clone(&receiver), self.has_low_priority);
            std::thread::Builder::new().name(self.name.to_owned()).spawn(move || {
                if has_low_priority {
                    priority::lower();
                }
                loop {
                    let next = receiver.lock().unwrap_or_else(PoisonError::into_inner).recv();
                    let Ok(work) = next else { return };
                    // The hook for panics has logged it, and the one who waits gets an error.
                    let _ = catch_unwind(AssertUnwindSafe(work));
                }
            })?;
        }
        Ok(sender)
    }
}

impl BlockingWork {
    pub(super) fn new(name: &'static str, threads: usize) -> Self {
        Self::with(name, threads, false)
    }

    /// With threads that, on Linux, run at lower priority.
    pub(super) fn with_low_priority(name: &'static str, threads: usize) -> Self {
        Self::with(name, threads, true)
    }

    fn with(name: &'static str, count: usize, has_low_priority: bool) -> Self {
        Self {
            places: Arc::new(Semaphore::new(count)),
            threads: Arc::new(WorkerThreads {
                name,
                count,
                has_low_priority,
                work: Mutex::default(),
            }),
        }
    }

    /// Waits for a free thread and runs the work on it. Work that has begun ends even if the future is dropped.
    /// Errors: `Panicked`, `Thread`.
    pub(super) async fn run<T: Send + 'static>(
        &self,
        work: impl FnOnce() -> T + Send + 'static,
    ) -> Result<T, TaskError> {
        // Never closed, so there is always a permit in the end.
        let place = Arc::clone(&self.places).acquire_owned().await;
        let span = tracing::Span::current();
        let (done, result) = oneshot::channel();
        self.threads.run(Box::new(move || {
            let _place = place;
            // Nobody waits any more if the client has gone.
            let _ = done.send(span.in_scope(work));
        }))?;
        result.await.map_err(|_| TaskError::Panicked)
    }
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc;

    use futures_util::FutureExt as _;

    use super::*;

    #[tokio::test]
    async fn work_beyond_the_bound_waits_for_a_thread() {
        let blocking = BlockingWork::new("test", 1);
        let (release, released) = mpsc::channel::<()>();
        let mut first = Box::pin(blocking.run(move || released.recv().is_ok()));
        assert!(first.as_mut().now_or_never().is_none());
        let mut second = Box::pin(blocking.run(|| 2));
        assert!(second.as_mut().now_or_never().is_none());
        release.send(()).unwrap();
        assert!(first.await.unwrap());
        assert_eq!(second.await.unwrap(), 2);
    }

    #[tokio::test]
    async fn a_panic_becomes_an_internal_error() {
        let error = BlockingWork::new("test", 1).run(|| panic!("test")).await.unwrap_err();
        assert!(matches!(ApiError::from(error), ApiError::Internal(_)));
    }
}
