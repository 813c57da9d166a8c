//! How many requests for predictions are processed at the same time: as many as may wait and be computed. One more is
//! refused before its images are decoded and, if possible, before its body is parsed, so that refused requests take
//! little time from accepted ones.

use std::sync::Arc;

use axum::RequestExt as _;
use axum::extract::Request;
use futures_util::StreamExt as _;
use metrics::counter;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use super::problem::ApiError;
use crate::server::config::ServerConfig;
use foreframe_core::metric_names;

/// The places of requests for predictions; clones share them.
#[derive(Clone)]
pub(in crate::server) struct Admission {
    places: Arc<Semaphore>,
    capacity: usize,
}

impl Admission {
    pub(in crate::server) fn new(config: &ServerConfig) -> Self {
        Self {
            places: Arc::new(Semaphore::new(config.max_queued_predictions + config.max_batch)),
            capacity: config.max_queued_predictions,
        }
    }

    /// A place, to be held until the response is ready. Errors: `Unavailable` if all are taken.
    pub(in crate::server) fn enter(&self) -> Result<OwnedSemaphorePermit, ApiError> {
        Arc::clone(&self.places).try_acquire_owned().map_err(|_| self.full())
    }

    /// The request, unless there is no place. It takes no place: otherwise clients that send slowly would block others.
    /// Errors: `Unavailable`.
    pub(in crate::server) async fn check(&self, request: Request) -> Result<Request, ApiError> {
        if self.places.available_permits() > 0 {
            return Ok(request);
        }
        discard_body(request).await;
        Err(self.full())
    }

    fn full(&self) -> ApiError {
        counter!(metric_names::PREDICTIONS_REFUSED, "reason" => "full").increment(1);
        ApiError::unavailable(format!(
            "{} predictions are waiting already; try again in 1 s",
            self.capacity
        ))
    }
}

/// Reads the body to its end, so that the connection stays usable.
async fn discard_body(request: Request) {
    let mut chunks = request.into_limited_body().into_data_stream();
    while let Some(Ok(_)) = chunks.next().await {}
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_request_beyond_queue_and_batch_is_refused() {
        let admission = Admission::new(&ServerConfig {
            max_queued_predictions: 1,
            max_batch: 2,
            ..ServerConfig::default()
        });
        let mut places: Vec<_> = (0..3).map(|_| admission.enter().unwrap()).collect();
        assert!(matches!(admission.enter(), Err(ApiError::Unavailable { .. })));
        assert!(admission.check(Request::default()).await.is_err());
        places.pop();
        assert!(admission.check(Request::default()).await.is_ok() && admission.enter().is_ok());
    }
}
