//! Requests that change state for good are completed, also if the client closes its connection before the answer.

use axum::extract::{MatchedPath, Request, State};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use tracing::Instrument as _;

use super::access::is_audited;
use super::problem::ApiError;
use super::task_limit::TaskLimit;

/// Runs a request that changes state in a task of its own. Otherwise the server would drop the request with its connection, perhaps
/// between the change and what belongs to it.
pub(in crate::server) async fn complete(State(tasks): State<TaskLimit>, request: Request, next: Next) -> Response {
    let route = request.extensions().get::<MatchedPath>();
    if !is_audited(request.method(), route.map_or("", MatchedPath::as_str)) {
        return next.run(request).await;
    }
    let place = match tasks.enter() {
        Ok(place) => place,
        Err(full) => return full.into_response(),
    };
    let work = async move {
        let response = next.run(request).await;
        drop(place);
        response
    };
    match tokio::spawn(work.in_current_span()).await {
        Ok(response) => response,
        Err(error) => ApiError::Internal(error.to_string()).into_response(),
    }
}
