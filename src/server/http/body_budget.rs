//! How many bytes of request bodies, and of the messages of streams, the server holds at the same time. Each has its own
//! limit; this one is for all together, so that many unfinished bodies do not take all memory.

use std::error::Error;
use std::io;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::task::{Context, Poll};

use axum::body::{Body, Bytes, HttpBody};
use axum::extract::{Request, State};
use axum::middleware::Next;
use axum::response::Response;
use hyper::body::{Frame, SizeHint};

use super::problem::ApiError;
use crate::server::config::ServerConfig;

/// The bytes that are left; clones share them.
#[derive(Clone)]
pub(in crate::server) struct BodyBudget {
    used: Arc<AtomicUsize>,
    limit: usize,
}

/// The bodies in flight exceed the budget.
#[derive(Debug, thiserror::Error)]
#[error("the requests and messages that are being read exceed {limit} bytes; try again in 1 s")]
pub(in crate::server) struct BodyBudgetError {
    limit: usize,
}

impl BodyBudget {
    pub(in crate::server) fn new(config: &ServerConfig) -> Self {
        Self {
            used: Arc::default(),
            limit: config.max_total_body_bytes,
        }
    }

    /// A share of it without any bytes.
    pub(super) fn share(&self) -> BodyShare {
        BodyShare {
            budget: self.clone(),
            taken: AtomicUsize::new(0),
        }
    }

    fn take(&self, bytes: usize) -> Result<(), BodyBudgetError> {
        let limit = self.limit;
        let sum = |used: usize| used.checked_add(bytes).filter(|&sum| sum <= limit);
        let taken = self.used.fetch_update(Ordering::AcqRel, Ordering::Acquire, sum);
        taken.map(drop).map_err(|_| BodyBudgetError { limit })
    }
}

/// What one request or stream has taken; given back on drop.
pub(super) struct BodyShare {
    budget: BodyBudget,
    taken: AtomicUsize,
}

impl BodyShare {
    pub(super) fn take(&self, bytes: usize) -> Result<(), BodyBudgetError> {
        self.budget.take(bytes)?;
        self.taken.fetch_add(bytes, Ordering::AcqRel);
        Ok(())
    }
}

impl Drop for BodyShare {
    fn drop(&mut self) {
        let taken = self.taken.load(Ordering::Acquire);
        self.budget.used.fetch_sub(taken, Ordering::AcqRel);
    }
}

/// A body whose bytes count from their arrival until the request is answered.
struct CountedBody {
    body: Body,
    share: Arc<BodyShare>,
}

impl HttpBody for CountedBody {
    type Data = Bytes;
    type Error = axum::Error;

    fn poll_frame(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, axum::Error>>> {
        let polled = Pin::new(&mut self.body).poll_frame(cx);
        if let Poll::Ready(Some(Ok(frame))) = &polled
            && let Some(bytes) = frame.data_ref()
            && let Err(error) = self.share.take(bytes.len())
        {
            return Poll::Ready(Some(Err(axum::Error::new(error))));
        }
        polled
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}

/// Counts the body of the request until it is answered.
pub(in crate::server) async fn count(State(budget): State<BodyBudget>, request: Request, next: Next) -> Response {
    if request.body().is_end_stream() {
        return next.run(request).await;
    }
    let share = Arc::new(budget.share());
    // The bytes outlive the body: the handler works with them.
    let held = Arc::clone(&share);
    let response = next
        .run(request.map(|body| Body::new(CountedBody { body, share })))
        .await;
    drop(held);
    response
}

/// The answer to a request whose body could not be read, if the budget is the cause.
pub(super) fn exceeded(error: &(dyn Error + 'static)) -> Option<ApiError> {
    cause(error).map(|exceeded| ApiError::unavailable(exceeded.to_string()))
}

/// The exceeded budget among the causes of an error.
pub(in crate::server) fn cause<'a>(error: &'a (dyn Error + 'static)) -> Option<&'a BodyBudgetError> {
    let mut cause = Some(error);
    while let Some(error) = cause {
        if let Some(exceeded) = error.downcast_ref::<BodyBudgetError>() {
            return Some(exceeded);
        }
        // An I/O error's source is that of the error within it.
        let within = error.downcast_ref::<io::Error>().and_then(io::Error::get_ref);
        cause = within
            .map(|error| error as &(dyn Error + 'static))
            .or_else(|| error.source());
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_budget_is_whole_again_after_the_request() {
        let budget = BodyBudget::new(&ServerConfig {
            max_total_body_bytes: 100,
            ..ServerConfig::default()
        });
        let (first, second) = (budget.share(), budget.share());
        first.take(60).unwrap();
        let error = axum::Error::new(second.take(50).unwrap_err());
        assert!(matches!(exceeded(&error), Some(ApiError::Unavailable { .. })));
        second.take(40).unwrap();
        drop(first);
        second.take(60).unwrap();
        drop(second);
        assert_eq!(budget.used.load(Ordering::Acquire), 0);
    }
}
