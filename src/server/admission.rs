//! How many requests for predictions are worked on at a time: as many as may wait and be computed. One more is refused
//! before its images are decoded and, if possible, before its body is parsed: what is spent on those that are refused is
//! taken from those that are not.

use std::sync::Arc;

use axum::RequestExt as _;
use axum::extract::{Request, State};
use axum::middleware::Next;
use axum::response::{IntoResponse as _, Response};
use futures_util::StreamExt as _;
use metrics::counter;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use super::error::ApiError;
use super::{App, ServerConfig};
use crate::telemetry::names;

/// Lets a request pass unless it is known before its body that there is no place. It takes none: whoever sends slowly
/// keeps nobody out.
pub(super) async fn check(State(app): State<App>, request: Request, next: Next) -> Response {
    match app.admission().refusal() {
        None => next.run(request).await,
        Some(refusal) => {
            skim(request).await;
            refusal.into_response()
        }
    }
}

/// Reads what is not wanted, so that the connection can be kept.
async fn skim(request: Request) {
    let mut chunks = request.into_limited_body().into_data_stream();
    while let Some(Ok(_)) = chunks.next().await {}
}

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

    /// Why there is no place, if all are taken.
    fn refusal(&self) -> Option<ApiError> {
        (self.places.available_permits() == 0).then(|| self.full())
    }

    fn full(&self) -> ApiError {
        counter!(names::PREDICTIONS_REFUSED, "reason" => "full").increment(1);
        ApiError::unavailable(format!("{} predictions wait already; try again in 1 s", self.capacity))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_more_than_may_wait_and_be_computed_is_refused_until_one_has_left() {
        let admission = Admission::new(&ServerConfig {
            max_queued_predictions: 1,
            max_batch: 2,
            ..ServerConfig::default()
        });
        let mut places: Vec<_> = (0..3).map(|_| admission.enter().unwrap()).collect();
        assert!(matches!(admission.enter(), Err(ApiError::Unavailable { .. })));
        assert_eq!(admission.refusal(), admission.enter().err());
        places.pop();
        assert!(admission.refusal().is_none() && admission.enter().is_ok());
    }
}
