//! How many requests for predictions are worked on at a time: as many as may wait and be computed. One more is refused
//! before its images are decoded and, if possible, before its body is parsed: what is spent on those that are refused is
//! taken from those that are not.

use std::sync::Arc;

use axum::RequestExt as _;
use axum::extract::Request;
use futures_util::StreamExt as _;
use metrics::counter;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use super::ServerConfig;
use super::error::ApiError;
use crate::telemetry::names;

/// The places of requests for predictions.
pub(super) struct Admission {
    places: Arc<Semaphore>,
    capacity: usize,
}

impl Admission {
    pub(super) fn new(config: &ServerConfig) -> Self {
        Self {
            places: Arc::new(Semaphore::new(config.max_queued_predictions + config.max_batch)),
            capacity: config.max_queued_predictions,
        }
    }

    /// A place, to be held until the answer is made. Errors: `Unavailable` if all are taken.
    pub(super) fn enter(&self) -> Result<OwnedSemaphorePermit, ApiError> {
        Arc::clone(&self.places).try_acquire_owned().map_err(|_| self.full())
    }

    /// The request, unless it is known before its body that there is no place. It takes none: whoever sends slowly keeps
    /// nobody out. Errors: `Unavailable`.
    pub(super) async fn pass(&self, request: Request) -> Result<Request, ApiError> {
        if self.places.available_permits() > 0 {
            return Ok(request);
        }
        skim(request).await;
        Err(self.full())
    }

    fn full(&self) -> ApiError {
        counter!(names::PREDICTIONS_REFUSED, "reason" => "full").increment(1);
        ApiError::unavailable(format!("{} predictions are waiting already; try again in 1 s", self.capacity))
    }
}

/// Reads what is not wanted, so that the connection can be kept.
async fn skim(request: Request) {
    let mut chunks = request.into_limited_body().into_data_stream();
    while let Some(Ok(_)) = chunks.next().await {}
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn one_more_than_may_wait_and_be_computed_is_refused_until_one_has_left() {
        let admission = Admission::new(&ServerConfig {
            max_queued_predictions: 1,
            max_batch: 2,
            ..ServerConfig::default()
        });
        let mut places: Vec<_> = (0..3).map(|_| admission.enter().unwrap()).collect();
        assert!(matches!(admission.enter(), Err(ApiError::Unavailable { .. })));
        assert!(admission.pass(Request::default()).await.is_err());
        places.pop();
        assert!(admission.pass(Request::default()).await.is_ok() && admission.enter().is_ok());
    }
}
