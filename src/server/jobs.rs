//! Collection and training in the background.

use axum::extract::State;
use axum::response::Response;
use serde::Serialize;

use super::error::{ApiError, Problem, accepted};
use super::extract::{Json, Path};
use super::{App, blocking};
use crate::jobs::{Job, JobSpec};

/// The jobs there are.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub(super) struct JobList {
    /// The newest first.
    jobs: Vec<Job>,
}

/// Queues a collection or a training; one runs at a time. A finished training's model serves at once.
#[utoipa::path(
    post, path = "/v1/jobs", tag = "jobs", request_body = JobSpec,
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
pub(super) async fn create(State(app): State<App>, Json(spec): Json<JobSpec>) -> Result<Response, ApiError> {
    let jobs = app.jobs().clone();
    let job = blocking(move || jobs.submit(spec)).await??;
    Ok(accepted(&format!("/v1/jobs/{}", job.id), job))
}

/// Lists the jobs, the newest first.
#[utoipa::path(get, path = "/v1/jobs", tag = "jobs", responses((status = 200, body = JobList)))]
pub(super) async fn list(State(app): State<App>) -> axum::Json<JobList> {
    axum::Json(JobList { jobs: app.jobs().all() })
}

/// Says how far a job is.
#[utoipa::path(
    get, path = "/v1/jobs/{id}", tag = "jobs",
    params(("id" = String, Path, description = "The job's id")),
    responses((status = 200, body = Job), (status = 404, description = "No such job", body = Problem))
)]
pub(super) async fn get(State(app): State<App>, Path(id): Path<String>) -> Result<axum::Json<Job>, ApiError> {
    Ok(axum::Json(app.jobs().get(&id)?))
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
    let job = app.jobs().cancel(&id)?;
    Ok(accepted(&format!("/v1/jobs/{}", job.id), job))
}
