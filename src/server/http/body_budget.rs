//! How many bytes of request bodies, and of the messages of streams, the server holds at the same time. Each has its own
//! limit; this one is for all together, so that many unfinished bodies do not take all memory.

use std::error::Error;
use std::io;
use std::iter::successors;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use axum::body::{Body, Bytes, HttpBody as _};
use axum::extract::{Request, State};
use axum::middleware::Next;
use axum::response::Response;
use futures_util::StreamExt as _;

use super::access::{is_upload, route};
use crate::server::config::ServerConfig;

/// The bytes that are left; clones share them.
#[derive(Clone)]
pub(in crate::server) struct BodyBudget {
    used: Arc<AtomicUsize>,
    limit: usize,
}

/// The bodies in flight exceed the budget.
#[derive(Debug, thiserror::Error)]
pub(in crate::server) enum BodyBudgetError {
    /// All together.
    #[error("the requests and messages that are being read exceed {limit} bytes; try again in 1 s")]
    Full {
        /// The budget.
        limit: usize,
    },
    /// One alone.
    #[error("the body or message is longer than {limit} bytes (setting max_total_body_bytes)")]
    TooLong {
        /// The budget.
        limit: usize,
    },
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
}

/// What one request or stream has taken; given back on drop.
pub(super) struct BodyShare {
    budget: BodyBudget,
    taken: AtomicUsize,
}

impl BodyShare {
    /// Errors: `Full`, `TooLong`.
    pub(super) fn take(&self, bytes: usize) -> Result<(), BodyBudgetError> {
        let BodyBudget { used, limit } = &self.budget;
        let (limit, own) = (*limit, self.taken.load(Ordering::Acquire).saturating_add(bytes));
        if own > limit {
            return Err(BodyBudgetError::TooLong { limit });
        }
        let sum = |used: usize| used.checked_add(bytes).filter(|sum| *sum <= limit);
        let taken = used.fetch_update(Ordering::AcqRel, Ordering::Acquire, sum);
        taken.map_err(|_| BodyBudgetError::Full { limit })?;
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

/// Counts the body of the request, from the arrival of its bytes until the request is answered; not that of an upload, which is not
/// held.
pub(in crate::server) async fn count(State(budget): State<BodyBudget>, request: Request, next: Next) -> Response {
    if request.body().is_end_stream() || is_upload(route(&request)) {
        return next.run(request).await;
    }
    let share = Arc::new(budget.share());
    // The bytes outlive the body: the handler works with them.
    let held = Arc::clone(&share);
    let counted = move |bytes: Result<Bytes, axum::Error>| {
        let bytes = bytes?;
        share.take(bytes.len()).map_err(axum::Error::new)?;
        Ok::<_, axum::Error>(bytes)
    };
    let response = next
        .run(request.map(|body| Body::from_stream(body.into_data_stream().map(counted))))
        .await;
    drop(held);
    response
}

/// The exceeded budget among the causes of an error.
pub(in crate::server) fn cause<'a>(error: &'a (dyn Error + 'static)) -> Option<&'a BodyBudgetError> {
    let mut causes = successors(Some(error), |&error| {
        // An I/O error's source is that of the error within it.
        let within = error.downcast_ref::<io::Error>().and_then(io::Error::get_ref);
        within.map_or_else(|| error.source(), |within| Some(within as &(dyn Error + 'static)))
    });
    causes.find_map(|error| error.downcast_ref())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_alone_exceeds_the_budget_is_too_long_however_full_it_is() {
        let budget = BodyBudget::new(&ServerConfig {
            max_total_body_bytes: 100,
            ..ServerConfig::default()
        });
        let (first, second) = (budget.share(), budget.share());
        first.take(60).unwrap();
        assert!(matches!(first.take(41), Err(BodyBudgetError::TooLong { limit: 100 })));
        assert!(matches!(second.take(41), Err(BodyBudgetError::Full { limit: 100 })));
        assert!(matches!(second.take(101), Err(BodyBudgetError::TooLong { .. })));
    }

    #[test]
    fn the_budget_is_whole_again_after_the_request() {
        let budget = BodyBudget::new(&ServerConfig {
            max_total_body_bytes: 100,
            ..ServerConfig::default()
        });
        let (first, second) = (budget.share(), budget.share());
        first.take(60).unwrap();
        let error = axum::Error::new(second.take(50).unwrap_err());
        assert!(cause(&error).is_some());
        second.take(40).unwrap();
        drop(first);
        second.take(60).unwrap();
        drop(second);
        assert_eq!(budget.used.load(Ordering::Acquire), 0);
    }
}
