//! Work outside a request's own task: what would block the async runtime, and what must not stop half-way.

use std::sync::Arc;

use tokio::runtime::{Builder, Handle, Runtime};
use tokio::sync::Semaphore;

use super::http::problem::ApiError;
use foreframe_jobs::jobs::priority;

/// Work that panicked.
#[derive(Debug, thiserror::Error)]
#[error("a task of the server panicked; the reason is in the log")]
pub(super) struct TaskError;

impl From<TaskError> for ApiError {
    fn from(error: TaskError) -> Self {
        Self::Internal(error.to_string())
    }
}

/// A bounded number of threads for work that would block the async runtime. They start when they are needed. Clones share them.
#[derive(Clone)]
pub(super) struct BlockingWork {
    places: Arc<Semaphore>,
    threads: Handle,
    _owner: Arc<ThreadsOwner>,
}

/// The runtime that has the threads; it runs nothing else.
struct ThreadsOwner(Option<Runtime>);

impl Drop for ThreadsOwner {
    fn drop(&mut self) {
        // This may be an async thread, which must not wait for work that runs.
        if let Some(runtime) = self.0.take() {
            runtime.shutdown_background();
        }
    }
}

impl BlockingWork {
    /// `has_low_priority`: on Linux, the threads run at lower priority.
    #[expect(
        clippy::expect_used,
        reason = "only input, output and timers of a runtime can fail to start"
    )]
    pub(super) fn new(name: &str, threads: usize, has_low_priority: bool) -> Self {
        let runtime = Builder::new_current_thread()
            .thread_name(name)
            .max_blocking_threads(threads)
            .on_thread_start(move || {
                if has_low_priority {
                    priority::lower();
                }
            })
            .build()
            .expect("a runtime of threads alone that does not start is a bug");
        Self {
            places: Arc::new(Semaphore::new(threads)),
            threads: runtime.handle().clone(),
            _owner: Arc::new(ThreadsOwner(Some(runtime))),
        }
    }

    /// Waits for a free thread and runs the work on it. Work that has begun ends even if the future is dropped; work that waits is
    /// dropped with it. Errors: the work panicked.
    pub(super) async fn run<T: Send + 'static>(
        &self,
        work: impl FnOnce() -> T + Send + 'static,
    ) -> Result<T, TaskError> {
        // Never closed, so there is always a permit in the end.
        let place = Arc::clone(&self.places).acquire_owned().await;
        let span = tracing::Span::current();
        let work = move || {
            let _place = place;
            span.in_scope(work)
        };
        self.threads.spawn_blocking(work).await.map_err(|_| TaskError)
    }
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc;

    use futures_util::FutureExt as _;

    use super::*;

    #[tokio::test]
    async fn work_beyond_the_bound_waits_for_a_thread() {
        let blocking = BlockingWork::new("test", 1, false);
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
        let error = BlockingWork::new("test", 1, false)
            .run(|| panic!("test"))
            .await
            .unwrap_err();
        assert!(matches!(ApiError::from(error), ApiError::Internal(_)));
    }
}
