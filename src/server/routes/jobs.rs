//! Collection, import, training and evaluation in the background.

use axum::body::Bytes;
use axum::extract::DefaultBodyLimit;
use axum::http::{HeaderMap, StatusCode, header};
use axum::response::IntoResponse;
use serde::{Deserialize, Serialize};
use utoipa_axum::router::{OpenApiRouter, UtoipaMethodRouterExt as _};
use utoipa_axum::routes;

use crate::server::http::extract::{Json, Path, Query};
use crate::server::http::page;
use crate::server::http::problem::ApiError;
use crate::server::state::App;
use foreframe_jobs::jobs::memory::TrainingEstimate;
use foreframe_jobs::jobs::pipeline::{estimate_training, report_key, run_key};
use foreframe_jobs::jobs::{Job, JobError, JobFilter, JobSpec, JobState};
use foreframe_jobs::store::{Author, JobId, LogRow, LossRow};
use foreframe_train::training::SAMPLE_FILE;

/// `max_job_bytes`: the maximum size of the request body of a new job.
pub(in crate::server) fn routes(max_job_bytes: usize) -> OpenApiRouter<App> {
    OpenApiRouter::new()
        .routes(routes!(create).layer(DefaultBodyLimit::max(max_job_bytes)))
        .routes(routes!(estimate).layer(DefaultBodyLimit::max(max_job_bytes)))
        .routes(routes!(list))
        .routes(routes!(get))
        .routes(routes!(cancel))
        .routes(routes!(resume))
        .routes(routes!(logs))
        .routes(routes!(metrics))
        .routes(routes!(file))
        .routes(routes!(sample))
}

/// Jobs on a page by default.
const DEFAULT_LIMIT: usize = 50;

/// When to try again if a key's share of the queue is full: jobs take minutes.
const SHARE_RETRY_AFTER_S: u64 = 60;

/// A page of jobs.
#[derive(Debug, Serialize, utoipa::ToSchema)]
struct JobList {
    /// The newest first.
    jobs: Vec<Job>,
    /// The value of `before` for the next page; absent on the last page.
    next: Option<String>,
}

/// Which jobs to list.
#[derive(Debug, Deserialize, utoipa::IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
struct ListQuery {
    /// `collect`, `import`, `train`, `adapt` or `evaluate`.
    #[param(pattern = "^(collect|import|train|adapt|evaluate)$")]
    kind: Option<String>,
    /// `queued`, `running`, `succeeded`, `failed` or `cancelled`.
    state: Option<JobState>,
    /// Only jobs that are older than the one with this id.
    #[param(pattern = "^job-[0-9]{1,18}$")]
    before: Option<String>,
    /// Only the parts of the job with this id. Without it, the list has no parts.
    #[param(pattern = "^job-[0-9]{1,18}$")]
    part_of: Option<String>,
    /// The maximum number of jobs, 1 to 1000. Default: 50.
    #[param(minimum = 1, maximum = 1000)]
    limit: Option<usize>,
}

/// Lines of a job's log.
#[derive(Debug, Serialize, utoipa::ToSchema)]
struct Log {
    /// The oldest first.
    lines: Vec<LogRow>,
}

/// Which lines of a log to list.
#[derive(Debug, Deserialize, utoipa::IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
struct LogQuery {
    /// Only lines after the one with this number.
    after: Option<i64>,
    /// The maximum number of lines, 1 to 1000. Default: 1000.
    #[param(minimum = 1, maximum = 1000)]
    limit: Option<usize>,
}

/// The loss curves of a training.
#[derive(Debug, Serialize, utoipa::ToSchema)]
struct LossCurves {
    /// In the order of the training.
    points: Vec<LossRow>,
}

/// Queues a collection, an import, a training, an adaptation or an evaluation. Each process runs one job at a time. A finished
/// training publishes the next version of its model. The first version of a name becomes active at once, later ones when they are
/// activated.
#[utoipa::path(
    post, path = "/v1/jobs",
    params(("Idempotency-Key" = Option<String>, Header, pattern = "^[!-~]{1,128}$",
        description = "The client's own key for this request: a second request with the same key makes no second job")),
    responses(
        (status = 202, description = "Queued; the header Location names the job", body = Job),
        (status = 400, description = "Not JSON"),
        (status = 409, description = "Its result exists already, or another job makes it"),
        (status = 413, description = "The body exceeds its limit"),
        (status = 415, description = "Content-Type is not JSON"),
        (status = 422, description = "Not a valid job; the answer names the field"),
        (status = 429, description = "The key's rate limit, or its share of the job queue, is reached"),
        (status = 503, description = "Too many jobs wait"),
    )
)]
async fn create(
    app: App,
    author: Author,
    headers: HeaderMap,
    Json(spec): Json<JobSpec>,
) -> Result<impl IntoResponse, ApiError> {
    let key = headers
        .get("idempotency-key")
        .map(|key| key.to_str().map(str::to_owned));
    let key = key.transpose().map_err(|_| {
        ApiError::Unprocessable("the header Idempotency-Key must be visible ASCII characters".to_owned())
    })?;
    Ok(accepted(app.jobs().submit(author.key_id(), spec, key).await?))
}

/// Estimates what a training will need, without starting it.
#[utoipa::path(
    post, path = "/v1/jobs/estimate",
    responses(
        (status = 200, body = TrainingEstimate),
        (status = 422, description = "Not a valid training; the answer names the field"),
    )
)]
async fn estimate(app: App, Json(spec): Json<JobSpec>) -> Result<axum::Json<TrainingEstimate>, ApiError> {
    let JobSpec::Train(spec) = spec else {
        let detail = "kind: only a job of the kind train can be estimated".to_owned();
        return Err(ApiError::Unprocessable(detail));
    };
    let memory = app.config().job_resources().memory;
    let estimate = estimate_training(&spec, memory, app.versions(), app.store().objects()).await?;
    Ok(axum::Json(estimate))
}

/// Lists jobs, the newest first.
#[utoipa::path(
    get, path = "/v1/jobs", params(ListQuery),
    responses((status = 200, body = JobList), (status = 422, description = "No such kind or state"))
)]
async fn list(app: App, Query(query): Query<ListQuery>) -> Result<axum::Json<JobList>, ApiError> {
    let limit = page::checked_limit(query.limit, DEFAULT_LIMIT)?;
    let filter = JobFilter {
        kind: query.kind,
        state: query.state,
        before: query.before,
        part_of: query.part_of,
        limit: limit + 1,
    };
    let (jobs, next) = page::cut(app.jobs().list(filter).await?, limit, |job| job.id.to_string());
    Ok(axum::Json(JobList { jobs, next }))
}

/// Describes a job and its progress.
#[utoipa::path(get, path = "/v1/jobs/{id}", responses((status = 200, body = Job)))]
async fn get(app: App, Path(id): Path<String>) -> Result<axum::Json<Job>, ApiError> {
    Ok(axum::Json(app.jobs().get(job_id(&id)?).await?))
}

/// Cancels a job with its parts. A job that waits ends at once; a job that runs ends at its next checkpoint.
#[utoipa::path(
    post, path = "/v1/jobs/{id}/cancel",
    responses((status = 202, description = "It will stop", body = Job), (status = 409, description = "It has ended"))
)]
async fn cancel(app: App, author: Author, Path(id): Path<String>) -> Result<impl IntoResponse, ApiError> {
    Ok(accepted(app.jobs().cancel(job_id(&id)?, &author).await?))
}

/// Resumes a job that failed or was cancelled, from its checkpoint, with those of its parts that failed or were cancelled. The result is the same as without the stop.
#[utoipa::path(
    post, path = "/v1/jobs/{id}/resume",
    responses(
        (status = 202, description = "Queued again", body = Job),
        (status = 409, description = "It has not ended, or has succeeded"),
        (status = 422, description = "The file that it imports was deleted"),
        (status = 503, description = "Too many jobs wait"),
    )
)]
async fn resume(app: App, author: Author, Path(id): Path<String>) -> Result<impl IntoResponse, ApiError> {
    Ok(accepted(app.jobs().resume(job_id(&id)?, &author).await?))
}

/// The log of a job.
#[utoipa::path(
    get, path = "/v1/jobs/{id}/logs", params(("id" = String, Path), LogQuery),
    responses((status = 200, body = Log))
)]
async fn logs(app: App, Path(id): Path<String>, Query(query): Query<LogQuery>) -> Result<axum::Json<Log>, ApiError> {
    let limit = page::checked_limit(query.limit, page::MAX_LIMIT)?;
    let lines = app.jobs().log(job_id(&id)?, query.after.unwrap_or(0), limit).await?;
    Ok(axum::Json(Log { lines }))
}

/// The loss curves of a training.
#[utoipa::path(get, path = "/v1/jobs/{id}/metrics", responses((status = 200, body = LossCurves)))]
async fn metrics(app: App, Path(id): Path<String>) -> Result<axum::Json<LossCurves>, ApiError> {
    let points = app.jobs().losses(job_id(&id)?).await?;
    Ok(axum::Json(LossCurves { points }))
}

/// A file of an evaluation: its report or a figure. The job's `result.files` lists them.
#[utoipa::path(
    get, path = "/v1/jobs/{id}/files/{file}",
    responses(
        (status = 200, description = "The file", body = Vec<u8>, content_type = "application/octet-stream"),
        (status = 404, description = "No such job or file"),
    )
)]
async fn file(app: App, Path((id, file)): Path<(String, String)>) -> Result<impl IntoResponse, ApiError> {
    let id = job_id(&id)?;
    let job = app.jobs().get(id).await?;
    let files = job.result.as_ref().and_then(|result| result["files"].as_array());
    // Only a name from the job's own list becomes part of a path.
    if !files.is_some_and(|files| files.iter().any(|known| *known == file)) {
        return Err(ApiError::NotFound(format!("job {id} has no file of that name")));
    }
    let bytes = report_file(&app, id, &file).await?;
    Ok(([(header::CONTENT_TYPE, media_type(&file))], bytes))
}

/// A sample prediction of a training: the true frames of a validation window above those that were predicted at its latest
/// validation.
#[utoipa::path(
    get, path = "/v1/jobs/{id}/sample.png",
    responses(
        (status = 200, description = "The picture", body = Vec<u8>, content_type = "image/png"),
        (status = 404, description = "No such job, or no prediction yet"),
    )
)]
async fn sample(app: App, Path(id): Path<String>) -> Result<impl IntoResponse, ApiError> {
    let id = job_id(&id)?;
    app.jobs().get(id).await?;
    let picture = app
        .store()
        .objects()
        .read(&format!("{}/{SAMPLE_FILE}", run_key(id)))
        .await;
    let picture = picture.map_err(JobError::Store)?;
    let none = || ApiError::NotFound(format!("job {id} has predicted nothing yet"));
    Ok(([(header::CONTENT_TYPE, "image/png")], picture.ok_or_else(none)?))
}

/// The bytes of a file of a report. Copies it to the data directory first if it is only in the object store.
async fn report_file(app: &App, id: JobId, file: &str) -> Result<Bytes, ApiError> {
    let key = format!("report/{id}/{file}");
    if let Some(bytes) = app.render_cache.cached(&key) {
        return Ok(bytes);
    }
    let objects = app.store().objects();
    let path = objects.data_dir().join(report_key(id)).join(file);
    let local = path.clone();
    if !app.render_cache.threads().run(move || local.is_file()).await? {
        let pulled = objects.pull(&report_key(id), file).await;
        pulled.map_err(JobError::Store)?;
    }
    let gone = format!("the file of job {id} no longer exists");
    let read = move || std::fs::read(path).map_err(|_| ApiError::NotFound(gone));
    app.render_cache.get_or_make(key, read).await
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

/// The id in the path. Errors: 404 if it is no id.
pub(super) fn job_id(text: &str) -> Result<JobId, ApiError> {
    Ok(text.parse().map_err(JobError::from)?)
}

/// The response to an accepted job: the job, and where to find it.
fn accepted(job: Job) -> impl IntoResponse {
    let location = format!("/v1/jobs/{}", job.id);
    (StatusCode::ACCEPTED, [(header::LOCATION, location)], axum::Json(job))
}

impl From<JobError> for ApiError {
    fn from(error: JobError) -> Self {
        match error {
            JobError::ShareFull { .. } => Self::TooMany {
                detail: error.to_string(),
                retry_after_s: SHARE_RETRY_AFTER_S,
            },
            _ => Self::of(&error),
        }
    }
}
