//! What models there are.

use axum::extract::State;
use axum::http::StatusCode;
use serde::Serialize;

use super::error::{ApiError, Problem};
use super::extract::{Path, Query};
use super::page::Page;
use super::{App, to_its_end};
use crate::nn::ModelSpec;
use crate::registry::Manifest;

/// The loaded models.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub(super) struct ModelList {
    /// In the order of their names.
    models: Vec<ModelDescription>,
    /// What to give as `after` for those that follow; absent at the end.
    #[serde(skip_serializing_if = "Option::is_none")]
    next: Option<String>,
}

/// What a model takes and gives, how good it is and where it comes from.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub(super) struct ModelDescription {
    /// Its name.
    name: String,
    /// The versions there are.
    versions: Vec<u32>,
    /// The version that answers.
    active_version: u32,
    /// Frame size, context, horizon, conditioning, units and order of action and state.
    spec: ModelSpec,
    /// Measured on data it was not trained on.
    #[schema(value_type = Object)]
    metrics: serde_json::Value,
    /// Where it comes from.
    lineage: Lineage,
}

/// Where a model comes from.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub(super) struct Lineage {
    /// Name of the data set it was trained on.
    dataset: String,
    /// Hash of that data set's content.
    dataset_hash: String,
    /// The scenario that was simulated for it, if one was.
    scenario: Option<String>,
    /// The seed of the training.
    seed: u64,
    /// The command that made it.
    command: String,
    /// Hash of the weights.
    weights_sha256: String,
    /// Trained values.
    parameters: u64,
    /// Multiplications and additions to predict a frame.
    multiply_adds_per_frame: u64,
    /// The program's version that made it.
    program_version: String,
    /// The program's commit that made it, where known.
    git_commit: Option<String>,
}

impl ModelDescription {
    /// Of the version that answers, among all there are.
    fn new(manifest: &Manifest, mut versions: Vec<u32>, metrics: serde_json::Value) -> Self {
        // One that was handed over when the server started may lie in neither directory.
        if let Err(place) = versions.binary_search(&manifest.version) {
            versions.insert(place, manifest.version);
        }
        Self {
            name: manifest.name.clone(),
            versions,
            active_version: manifest.version,
            spec: manifest.spec.clone(),
            metrics,
            lineage: Lineage {
                dataset: manifest.dataset.name.clone(),
                dataset_hash: manifest.dataset.content_hash.clone(),
                scenario: manifest.dataset.scenario.clone(),
                seed: manifest.seed.0,
                command: manifest.command.clone(),
                weights_sha256: manifest.weights_sha256.clone(),
                parameters: manifest.parameters,
                multiply_adds_per_frame: manifest.multiply_adds_per_frame,
                program_version: manifest.program.version.clone(),
                git_commit: manifest.program.git_commit.clone(),
            },
        }
    }
}

/// Lists the loaded models.
#[utoipa::path(
    get, path = "/v1/models", tag = "models", params(Page),
    responses((status = 200, body = ModelList), (status = 422, description = "A limit out of range", body = Problem))
)]
pub(super) async fn list(State(app): State<App>, Query(page): Query<Page>) -> Result<axum::Json<ModelList>, ApiError> {
    let (manifests, next) = page.of(app.predictor().models(), |manifest| &manifest.name)?;
    let mut versions = app.versions().all().await?;
    let mut models = Vec::with_capacity(manifests.len());
    for manifest in &manifests {
        let versions = versions.remove(&manifest.name).unwrap_or_default();
        let metrics = app.versions().metrics(manifest).await?;
        models.push(ModelDescription::new(manifest, versions, metrics));
    }
    Ok(axum::Json(ModelList { models, next }))
}

/// Describes one model.
#[utoipa::path(
    get, path = "/v1/models/{model}", tag = "models",
    params(("model" = String, Path, description = "The model's name")),
    responses(
        (status = 200, body = ModelDescription),
        (status = 404, description = "No such model; the answer names those there are", body = Problem),
    )
)]
pub(super) async fn get(
    State(app): State<App>,
    Path(model): Path<String>,
) -> Result<axum::Json<ModelDescription>, ApiError> {
    let manifest = app.predictor().model(&model)?;
    let versions = app.versions().of(&model).await?;
    let metrics = app.versions().metrics(&manifest).await?;
    Ok(axum::Json(ModelDescription::new(&manifest, versions, metrics)))
}

/// Has a version answer from now on, on every server of the store and after a restart. Streams that run keep theirs.
#[utoipa::path(
    post, path = "/v1/models/{model}/versions/{version}/activate", tag = "models",
    params(
        ("model" = String, Path, description = "The model's name"),
        ("version" = u32, Path, description = "The version"),
    ),
    responses(
        (status = 200, description = "It answers", body = ModelDescription),
        (status = 404, description = "No such version; the answer names those there are", body = Problem),
        (status = 422, description = "Its files are damaged or do not fit; the version before goes on", body = Problem),
    )
)]
pub(super) async fn activate(
    State(app): State<App>,
    Path((model, version)): Path<(String, u32)>,
) -> Result<axum::Json<ModelDescription>, ApiError> {
    let (switched, name) = (app.clone(), model.clone());
    to_its_end(async move { switched.versions().activate(switched.predictor(), &name, version).await }).await??;
    get(State(app), Path(model)).await
}

/// Deletes a version that a job published.
#[utoipa::path(
    delete, path = "/v1/models/{model}/versions/{version}", tag = "models",
    params(
        ("model" = String, Path, description = "The model's name"),
        ("version" = u32, Path, description = "The version"),
    ),
    responses(
        (status = 204, description = "Deleted"),
        (status = 404, description = "No such version; the answer names those there are", body = Problem),
        (status = 409, description = "It is active, or was shipped", body = Problem),
    )
)]
pub(super) async fn delete(
    State(app): State<App>,
    Path((model, version)): Path<(String, u32)>,
) -> Result<StatusCode, ApiError> {
    to_its_end(async move { app.versions().delete(app.predictor(), &model, version).await }).await??;
    Ok(StatusCode::NO_CONTENT)
}
