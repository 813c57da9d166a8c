//! How many requests are processed at the same time. Those that change state for good are completed, also if the client closes
//! its connection before the answer.

use axum::extract::{Request, State};
use axum::middleware::Next;
use axum::response::Response;
use tracing::Instrument as _;

use super::access::{is_audited, route};
use super::problem::ApiError;
use super::task_limit::TaskLimit;

/// Refuses a request beyond the limit. The others hold their place until they are answered. A request that changes state runs in a
/// task of its own: otherwise the server would drop it with its connection, perhaps between the change and what belongs to it.
pub(in crate::server) async fn answer(
    State(requests): State<TaskLimit>,
    request: Request,
    next: Next,
) -> Result<Response, ApiError> {
    let place = requests.enter()?;
    let is_audited = is_audited(request.method(), route(&request));
    let work = async move {
        let response = next.run(request).await;
        drop(place);
        response
    };
    if !is_audited {
        return Ok(work.await);
    }
    let answered = tokio::spawn(work.in_current_span()).await;
    answered.map_err(|error| ApiError::Internal(error.to_string()))
}
