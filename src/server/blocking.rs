//! Work outside a request's own task: what would block the async runtime, and what must not stop half-way.

use std::sync::Arc;

use tokio::sync::Semaphore;
use tracing::Instrument as _;

use super::http::problem::ApiError;

/// Work that panicked.
#[derive(Debug, thiserror::Error)]
#[error("a task of the server failed: {0}")]
pub(super) struct TaskError(#[from] tokio::task::JoinError);

impl From<TaskError> for ApiError {
    fn from(error: TaskError) -> Self {
        Self::Internal(error.to_string())
    }
}

/// A bounded number of threads for work that would block the async runtime: image codecs, simulation, files. Clones
/// share the bound.
#[derive(Clone)]
pub(super) struct BlockingWork {
    places: Arc<Semaphore>,
}

impl BlockingWork {
    pub(super) fn new(threads: usize) -> Self {
        Self {
            places: Arc::new(Semaphore::new(threads)),
        }
    }

    /// Waits for a free thread and runs the work on it. Work that has begun ends even if the future is dropped.
    /// Errors: the work panicked.
    pub(super) async fn run<T: Send + 'static>(
        &self,
        work: impl FnOnce() -> T + Send + 'static,
    ) -> Result<T, TaskError> {
        // Never closed, so there is always a permit in the end.
        let place = Arc::clone(&self.places).acquire_owned().await;
        let span = tracing::Span::current();
        let done = tokio::task::spawn_blocking(move || {
            let _place = place;
            span.in_scope(work)
        });
        Ok(done.await?)
    }
}

/// Finishes the work even if the client disconnects. Errors: the work panicked.
pub(super) async fn run_to_completion<T: Send + 'static>(
    work: impl Future<Output = T> + Send + 'static,
) -> Result<T, TaskError> {
    Ok(tokio::spawn(work.in_current_span()).await?)
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc;

    use futures_util::FutureExt as _;

    use super::*;

    #[tokio::test]
    async fn work_beyond_the_bound_waits_for_a_thread() {
        let blocking = BlockingWork::new(1);
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
        let error = BlockingWork::new(1).run(|| panic!("test")).await.unwrap_err();
        assert!(matches!(ApiError::from(error), ApiError::Internal(_)));
    }
}
