//! Collection, training and evaluation in the background.

use axum::extract::State;
use axum::http::{HeaderMap, header};
use axum::response::{IntoResponse, Response};
use serde::{Deserialize, Serialize};

use super::error::{ApiError, Problem, accepted};
use super::extract::{Json, Path, Query};
use super::{App, blocking};
use crate::jobs::pipeline::report_key;
use crate::jobs::{Job, JobFilter, JobSpec, JobState};
use crate::store::{LogRow, LossRow};

/// Jobs on a page unless asked otherwise.
const PAGE: usize = 50;
/// Jobs on a page, or lines of a log in an answer, at most.
const MAX_PAGE: usize = 1000;

/// Some of the jobs there are.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub(super) struct JobList {
    /// The newest first.
    jobs: Vec<Job>,
    /// The value of `before` that gives the next page; none on the last.
    next: Option<String>,
}

/// Which jobs to list.
#[derive(Debug, Deserialize, utoipa::IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub(super) struct ListQuery {
    /// `collect`, `train` or `evaluate`.
    kind: Option<String>,
    /// `queued`, `running`, `succeeded`, `failed` or `cancelled`.
    state: Option<JobState>,
    /// Only jobs asked for before the one of this id.
    before: Option<String>,
    /// Jobs on the page at most, 1 to 1000; 50 unless given.
    limit: Option<usize>,
}

/// Lines of a job's log.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub(super) struct Log {
    /// The oldest first.
    lines: Vec<LogLine>,
}

/// A line of a job's log.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub(super) struct LogLine {
    /// Counts the lines of a job, from 1; the oldest are forgotten.
    pub(super) seq: i64,
    /// When, in seconds since 1970.
    unix_s: f64,
    /// What happened.
    line: String,
}

impl From<LogRow> for LogLine {
    fn from(row: LogRow) -> Self {
        Self {
            seq: row.seq,
            unix_s: row.time_s,
            line: row.line,
        }
    }
}

/// Which lines of a log to give.
#[derive(Debug, Deserialize, utoipa::IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub(super) struct LogQuery {
    /// Only lines after the one of this number.
    after: Option<i64>,
    /// Lines at most, 1 to 1000; 1000 unless given.
    limit: Option<usize>,
}

/// The loss curves of a training.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub(super) struct LossCurves {
    /// In the order of the training.
    points: Vec<CurvePoint>,
}

/// A point of the loss curves.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub(super) struct CurvePoint {
    /// `pretrain` or `fit`.
    stage: String,
    /// Updates made in that stage.
    step: i64,
    /// On the training windows of that step.
    train: Option<f64>,
    /// On the validation windows, where they were predicted.
    validation: Option<f64>,
}

impl From<LossRow> for CurvePoint {
    fn from(row: LossRow) -> Self {
        Self {
            stage: row.stage,
            step: row.step,
            train: row.train,
            validation: row.validation,
        }
    }
}

/// Queues a collection, a training or an evaluation; one runs at a time in each process. A finished training publishes the
/// next version of its model; the first of a name serves at once, others when they are activated.
#[utoipa::path(
    post, path = "/v1/jobs", tag = "jobs", request_body = JobSpec,
    params(("Idempotency-Key" = Option<String>, Header,
        description = "The caller's name for this job: asked again with the same, no second job is made")),
    responses(
        (status = 202, description = "Taken; the header Location says where to watch it", body = Job),
        (status = 400, description = "Not JSON", body = Problem),
        (status = 409, description = "What it would make exists or is being made", body = Problem),
        (status = 413, description = "A body over the limit", body = Problem),
        (status = 415, description = "Not declared as JSON", body = Problem),
        (status = 422, description = "Not a job that can be done; names the field", body = Problem),
        (status = 503, description = "Too many jobs wait", body = Problem),
    )
)]
pub(super) async fn create(
    State(app): State<App>,
    headers: HeaderMap,
    Json(spec): Json<JobSpec>,
) -> Result<Response, ApiError> {
    let key = headers
        .get("idempotency-key")
        .map(|key| key.to_str().map(str::to_owned));
    let key = key
        .transpose()
        .map_err(|_| ApiError::Unprocessable("Idempotency-Key: a key is visible ASCII characters".to_owned()))?;
    Ok(told(app.jobs().submit(spec, key).await?))
}

/// Lists jobs, the newest first.
#[utoipa::path(
    get, path = "/v1/jobs", tag = "jobs", params(ListQuery),
    responses(
        (status = 200, body = JobList),
        (status = 422, description = "No such kind or state", body = Problem),
    )
)]
pub(super) async fn list(
    State(app): State<App>,
    Query(query): Query<ListQuery>,
) -> Result<axum::Json<JobList>, ApiError> {
    let limit = page(query.limit, PAGE)?;
    let filter = JobFilter {
        kind: query.kind,
        state: query.state,
        before: query.before,
        limit: limit + 1,
    };
    let mut jobs = app.jobs().list(filter).await?;
    let has_more = jobs.len() > limit;
    jobs.truncate(limit);
    let next = jobs.last().filter(|_| has_more).map(|job| job.id.clone());
    Ok(axum::Json(JobList { jobs, next }))
}

/// Says how far a job is.
#[utoipa::path(
    get, path = "/v1/jobs/{id}", tag = "jobs",
    params(("id" = String, Path, description = "The job's id")),
    responses((status = 200, body = Job), (status = 404, description = "No such job", body = Problem))
)]
pub(super) async fn get(State(app): State<App>, Path(id): Path<String>) -> Result<axum::Json<Job>, ApiError> {
    Ok(axum::Json(app.jobs().get(&id).await?))
}

/// Asks a job to stop: one that waits ends at once, one that runs at its next checkpoint.
#[utoipa::path(
    post, path = "/v1/jobs/{id}/cancel", tag = "jobs",
    params(("id" = String, Path, description = "The job's id")),
    responses(
        (status = 202, description = "Asked to stop", body = Job),
        (status = 404, description = "No such job", body = Problem),
        (status = 409, description = "It has ended", body = Problem),
    )
)]
pub(super) async fn cancel(State(app): State<App>, Path(id): Path<String>) -> Result<Response, ApiError> {
    Ok(told(app.jobs().cancel(&id).await?))
}

/// Has a job that failed or was cancelled go on from its checkpoint, to the same result as if it had never stopped.
#[utoipa::path(
    post, path = "/v1/jobs/{id}/resume", tag = "jobs",
    params(("id" = String, Path, description = "The job's id")),
    responses(
        (status = 202, description = "Waits again", body = Job),
        (status = 404, description = "No such job", body = Problem),
        (status = 409, description = "It has not ended, or has succeeded", body = Problem),
        (status = 503, description = "Too many jobs wait", body = Problem),
    )
)]
pub(super) async fn resume(State(app): State<App>, Path(id): Path<String>) -> Result<Response, ApiError> {
    Ok(told(app.jobs().resume(&id).await?))
}

/// What happened to a job, line by line.
#[utoipa::path(
    get, path = "/v1/jobs/{id}/logs", tag = "jobs",
    params(("id" = String, Path, description = "The job's id"), LogQuery),
    responses((status = 200, body = Log), (status = 404, description = "No such job", body = Problem))
)]
pub(super) async fn logs(
    State(app): State<App>,
    Path(id): Path<String>,
    Query(query): Query<LogQuery>,
) -> Result<axum::Json<Log>, ApiError> {
    let limit = page(query.limit, MAX_PAGE)?;
    let lines = app.jobs().log(&id, query.after.unwrap_or(0), limit).await?;
    Ok(axum::Json(Log {
        lines: lines.into_iter().map(LogLine::from).collect(),
    }))
}

/// The loss curves of a training.
#[utoipa::path(
    get, path = "/v1/jobs/{id}/metrics", tag = "jobs",
    params(("id" = String, Path, description = "The job's id")),
    responses((status = 200, body = LossCurves), (status = 404, description = "No such job", body = Problem))
)]
pub(super) async fn metrics(
    State(app): State<App>,
    Path(id): Path<String>,
) -> Result<axum::Json<LossCurves>, ApiError> {
    let points = app.jobs().losses(&id).await?;
    Ok(axum::Json(LossCurves {
        points: points.into_iter().map(CurvePoint::from).collect(),
    }))
}

/// A file that an evaluation left: its report or a figure. The job's `result.files` names them.
#[utoipa::path(
    get, path = "/v1/jobs/{id}/files/{file}", tag = "jobs",
    params(
        ("id" = String, Path, description = "The job's id"),
        ("file" = String, Path, description = "The file's name"),
    ),
    responses(
        (status = 200, description = "The file", body = Vec<u8>, content_type = "application/octet-stream"),
        (status = 404, description = "No such job or file", body = Problem),
    )
)]
pub(super) async fn file(
    State(app): State<App>,
    Path((id, file)): Path<(String, String)>,
) -> Result<impl IntoResponse, ApiError> {
    let job = app.jobs().get(&id).await?;
    let files = job.result.as_ref().and_then(|result| result["files"].as_array());
    // Only a name that the job itself gave becomes part of a path.
    if !files.is_some_and(|files| files.iter().any(|known| *known == file)) {
        return Err(ApiError::NotFound(format!("job {id} left no file of that name")));
    }
    let bytes = report_file(&app, &id, &file).await?;
    Ok(([(header::CONTENT_TYPE, media_type(&file))], bytes))
}

/// The bytes of a file of a report, fetched into the data directory if need be.
async fn report_file(app: &App, id: &str, file: &str) -> Result<Vec<u8>, ApiError> {
    let objects = app.store().objects();
    let path = objects.data_dir().join(report_key(id)).join(file);
    if !path.is_file() {
        let pulled = objects.pull(&report_key(id), file).await;
        pulled.map_err(|error| ApiError::Internal(error.to_string()))?;
    }
    let bytes = blocking(move || std::fs::read(path)).await?;
    bytes.map_err(|_| ApiError::NotFound(format!("the file of job {id} is gone")))
}

fn media_type(file: &str) -> &'static str {
    match file.rsplit('.').next() {
        Some("json") => "application/json",
        Some("md") => "text/markdown; charset=utf-8",
        Some("png") => "image/png",
        Some("gif") => "image/gif",
        Some("svg") => "image/svg+xml",
        _ => "application/octet-stream",
    }
}

fn told(job: Job) -> Response {
    accepted(&format!("/v1/jobs/{}", job.id), job)
}

fn page(limit: Option<usize>, default: usize) -> Result<usize, ApiError> {
    let limit = limit.unwrap_or(default);
    if (1..=MAX_PAGE).contains(&limit) {
        return Ok(limit);
    }
    Err(ApiError::Unprocessable(format!(
        "limit: {limit} is out of range; it must be 1 to {MAX_PAGE}"
    )))
}
