//! The audit trail.

use serde::{Deserialize, Serialize};
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use crate::server::http::extract::Query;
use crate::server::http::page;
use crate::server::http::problem::ApiError;
use crate::server::state::App;
use foreframe_jobs::store::audit::AuditRow;

pub(in crate::server) fn routes() -> OpenApiRouter<App> {
    OpenApiRouter::new().routes(routes!(list))
}

/// A page of the audit trail.
#[derive(Debug, Serialize, utoipa::ToSchema)]
struct AuditList {
    /// The newest first.
    entries: Vec<AuditRow>,
    /// The value of `before` for the next page; absent on the last page.
    #[serde(skip_serializing_if = "Option::is_none")]
    next: Option<i64>,
}

/// Which changes to list.
#[derive(Debug, Deserialize, utoipa::IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
struct AuditQuery {
    /// Only changes before the one with this number.
    before: Option<i64>,
    /// The maximum number of changes, 1 to 1000. Default: 100.
    #[param(minimum = 1, maximum = 1000)]
    limit: Option<usize>,
}

/// Who changed what and when, the newest first. Needs the scope `admin`.
#[utoipa::path(
    get, path = "/v1/audit", tag = "about", operation_id = "audit", params(AuditQuery),
    responses(
        (status = 200, body = AuditList),
        (status = 422, description = "A number is out of range"),
        (status = 503, description = "The database cannot be read now"),
    )
)]
async fn list(app: App, Query(query): Query<AuditQuery>) -> Result<axum::Json<AuditList>, ApiError> {
    let limit = page::checked_limit(query.limit, page::DEFAULT_LIMIT)?;
    let rows = app.store().audit(query.before, limit as i64 + 1).await;
    let rows = rows.map_err(|error| ApiError::of_own_data(&error))?;
    let (entries, next) = page::cut(rows, limit, |entry| entry.number);
    Ok(axum::Json(AuditList { entries, next }))
}
