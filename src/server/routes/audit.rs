//! The audit trail.

use axum::extract::State;
use serde::{Deserialize, Serialize};
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use crate::server::http::extract::Query;
use crate::server::http::page;
use crate::server::http::problem::{ApiError, Problem};
use crate::server::state::App;
use foreframe_jobs::store::audit::AuditRow;

pub(in crate::server) fn routes() -> OpenApiRouter<App> {
    OpenApiRouter::new().routes(routes!(list))
}

/// A page of the audit trail.
#[derive(Debug, Serialize, utoipa::ToSchema)]
struct AuditList {
    /// The newest first.
    entries: Vec<AuditEntry>,
    /// The value of `before` for the next page; absent on the last page.
    #[serde(skip_serializing_if = "Option::is_none")]
    next: Option<i64>,
}

/// A change of state.
#[derive(Debug, Serialize, utoipa::ToSchema)]
struct AuditEntry {
    /// Its number, from 1. The oldest are deleted.
    number: i64,
    /// When, in seconds since 1970.
    unix_s: f64,
    /// The id of an API key, `anonymous` (authentication is off) or `command line`.
    who: String,
    /// The name of that key.
    #[serde(skip_serializing_if = "Option::is_none")]
    name: Option<String>,
    /// `job.create`, `job.cancel`, `job.resume`, `version.publish`, `version.activate`, `version.delete`, `dataset.delete`,
    /// `key.create` or `key.revoke`. The entry of `dataset.delete` is written before the files are deleted; if that fails,
    /// `dataset.delete.failed` follows.
    action: String,
    /// The job, the version (`NAME@VERSION`), the data set or the key.
    target: String,
}

impl From<AuditRow> for AuditEntry {
    fn from(row: AuditRow) -> Self {
        Self {
            number: row.number,
            unix_s: row.time_s,
            who: row.who,
            name: row.name,
            action: row.action,
            target: row.target,
        }
    }
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
        (status = 422, description = "A number is out of range", body = Problem),
        (status = 503, description = "The database cannot be read now", body = Problem),
    )
)]
async fn list(State(app): State<App>, Query(query): Query<AuditQuery>) -> Result<axum::Json<AuditList>, ApiError> {
    let limit = page::checked_limit(query.limit)?;
    let rows = app
        .store()
        .audit(query.before, limit as i64 + 1)
        .await
        .map_err(|error| ApiError::of_own_data(&error))?;
    let has_more = rows.len() > limit;
    let entries: Vec<AuditEntry> = rows.into_iter().take(limit).map(AuditEntry::from).collect();
    let next = entries.last().filter(|_| has_more).map(|entry| entry.number);
    Ok(axum::Json(AuditList { entries, next }))
}
