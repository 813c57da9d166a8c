//! How many requests are processed at the same time. Streams and event streams have limits of their own.

use std::sync::Arc;

use axum::extract::{Request, State};
use axum::middleware::Next;
use axum::response::{IntoResponse as _, Response};
use tokio::sync::Semaphore;

use super::problem::ApiError;
use crate::server::config::ServerConfig;

/// The places of requests; clones share them.
#[derive(Clone)]
pub(in crate::server) struct RequestLimit {
    places: Arc<Semaphore>,
    limit: usize,
}

impl RequestLimit {
    pub(in crate::server) fn new(config: &ServerConfig) -> Self {
        Self {
            places: Arc::new(Semaphore::new(config.max_requests)),
            limit: config.max_requests,
        }
    }
}

/// Refuses a request beyond the limit. The others hold their place until they are answered.
pub(in crate::server) async fn check(State(limit): State<RequestLimit>, request: Request, next: Next) -> Response {
    let Ok(_place) = limit.places.try_acquire() else {
        let limit = limit.limit;
        return ApiError::unavailable(format!(
            "{limit} requests are being processed already; try again in 1 s"
        ))
        .into_response();
    };
    next.run(request).await
}
