//! The models and their versions.

use axum::http::StatusCode;
use serde::Serialize;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::bounds::ChannelBounds;
use crate::server::http::extract::{Path, Query};
use crate::server::http::page::Page;
use crate::server::http::problem::ApiError;
use crate::server::state::App;
use foreframe_core::nn::ModelSpec;
use foreframe_core::registry::Manifest;
use foreframe_core::registry::calibration::ValueRange;
use foreframe_core::types::ModelName;
use foreframe_jobs::store::Author;
use foreframe_jobs::versions::VersionError;

pub(in crate::server) fn routes() -> OpenApiRouter<App> {
    OpenApiRouter::new()
        .routes(routes!(list))
        .routes(routes!(get))
        .routes(routes!(delete))
        .routes(routes!(activate))
}

/// The loaded models.
#[derive(Debug, Serialize, utoipa::ToSchema)]
struct ModelList {
    /// In the order of their names.
    models: Vec<ModelDescription>,
    /// The value of `after` for the next page; absent on the last page.
    #[serde(skip_serializing_if = "Option::is_none")]
    next: Option<String>,
    /// What to do if there is no model; absent if there is one.
    #[serde(skip_serializing_if = "Option::is_none")]
    notice: Option<String>,
}

/// A model: its inputs and outputs, its scores and its origin.
#[derive(Debug, Serialize, utoipa::ToSchema)]
struct ModelDescription {
    /// Its name.
    name: String,
    /// Its versions.
    versions: Vec<u32>,
    /// The version that answers requests.
    active_version: u32,
    /// Frame size, context, horizon, conditioning, units and order of action and state.
    spec: ModelSpec,
    /// Lowest and highest value of each action component in training; absent if the model is not calibrated or takes no
    /// actions.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    action_bounds: Vec<ChannelBounds>,
    /// The same of each state component.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    state_bounds: Vec<ChannelBounds>,
    /// Scores on data that it was not trained on.
    #[schema(value_type = Object)]
    metrics: serde_json::Value,
    /// Its origin.
    lineage: Lineage,
}

/// The origin of a model.
#[derive(Debug, Serialize, utoipa::ToSchema)]
struct Lineage {
    /// Name of the data set it was trained on.
    dataset: String,
    /// Hash of the content of that data set.
    dataset_hash: String,
    /// The scenario of the simulation, if the data was simulated.
    scenario: Option<String>,
    /// The seed of the training.
    seed: u64,
    /// The command that made it.
    command: String,
    /// Hash of the weights.
    weights_sha256: String,
    /// Number of trained parameters.
    parameters: u64,
    /// Multiplications and additions for a predicted frame.
    multiply_adds_per_frame: u64,
    /// The version of the program that made it.
    program_version: String,
    /// The commit of the program that made it, if known.
    git_commit: Option<String>,
}

impl ModelDescription {
    /// Describes the active version; `versions` lists all version numbers.
    fn new(manifest: &Manifest, mut versions: Vec<u32>, metrics: serde_json::Value) -> Self {
        // A model that was given to the server at its start may be in no directory.
        if let Err(place) = versions.binary_search(&manifest.version) {
            versions.insert(place, manifest.version);
        }
        let calibration = manifest.calibration.as_ref();
        let bounds =
            |ranges: Option<&Vec<ValueRange>>| ranges.into_iter().flatten().map(|range| (*range).into()).collect();
        Self {
            name: manifest.name.to_string(),
            versions,
            active_version: manifest.version,
            spec: manifest.spec.clone(),
            action_bounds: bounds(calibration.map(|calibration| &calibration.actions)),
            state_bounds: bounds(calibration.map(|calibration| &calibration.states)),
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
    get, path = "/v1/models", params(Page),
    responses((status = 200, body = ModelList), (status = 422, description = "A limit out of range"))
)]
async fn list(app: App, Query(page): Query<Page>) -> Result<axum::Json<ModelList>, ApiError> {
    let (manifests, next) = page.of(app.predictor().models(), |manifest| manifest.name.as_str())?;
    let mut versions = app.versions().all().await?;
    let mut models = Vec::with_capacity(manifests.len());
    for manifest in &manifests {
        let versions = versions.remove(&manifest.name).unwrap_or_default();
        let metrics = app.versions().metrics(manifest).await?;
        models.push(ModelDescription::new(manifest, versions, metrics));
    }
    let notice = app.no_model_advice();
    Ok(axum::Json(ModelList { models, next, notice }))
}

/// Describes one model.
#[utoipa::path(
    get, path = "/v1/models/{model}",
    responses(
        (status = 200, body = ModelDescription),
        (status = 404, description = "No such model; the answer lists the models"),
    )
)]
async fn get(app: App, Path(model): Path<String>) -> Result<axum::Json<ModelDescription>, ApiError> {
    let manifest = app.predictor().model(&model)?;
    let versions = app.versions().of(&manifest.name).await?;
    let metrics = app.versions().metrics(&manifest).await?;
    Ok(axum::Json(ModelDescription::new(&manifest, versions, metrics)))
}

/// Makes a version the active one, on every server of the store and after a restart. Open streams keep their version.
#[utoipa::path(
    post, path = "/v1/models/{model}/versions/{version}/activate",
    responses(
        (status = 200, description = "It is active", body = ModelDescription),
        (status = 404, description = "No such version; the answer lists the versions"),
        (status = 422, description = "Its files are damaged or do not fit; the previous version stays active"),
    )
)]
async fn activate(
    app: App,
    author: Author,
    Path((model, version)): Path<(String, u32)>,
) -> Result<axum::Json<ModelDescription>, ApiError> {
    let versions = app.versions();
    let name = model_name(&model, version)?;
    versions.activate(app.predictor(), &name, version, &author).await?;
    get(app, Path(model)).await
}

/// Deletes a version that a job published.
#[utoipa::path(
    delete, path = "/v1/models/{model}/versions/{version}",
    responses(
        (status = 204, description = "Deleted"),
        (status = 404, description = "No such version; the answer lists the versions"),
        (status = 409, description = "It is active, was not published by a job, or a job that has not ended needs it"),
    )
)]
async fn delete(app: App, author: Author, Path((model, version)): Path<(String, u32)>) -> Result<StatusCode, ApiError> {
    let versions = app.versions();
    let name = model_name(&model, version)?;
    let _held = app.jobs().hold_submissions().await;
    let open = app.jobs().open().await?;
    if let Some(job) = open.into_iter().find(|job| job.needs_version(&name, version)) {
        return Err(VersionError::InUse {
            model: name,
            version,
            job: job.id,
        }
        .into());
    }
    versions.delete(app.predictor(), &name, version, &author).await?;
    Ok(StatusCode::NO_CONTENT)
}

/// The name in the path of a version. Errors: `Unknown` if it is no valid name.
fn model_name(text: &str, version: u32) -> Result<ModelName, VersionError> {
    text.parse().map_err(|_| VersionError::Unknown {
        model: text.to_owned(),
        version,
        available: Vec::new(),
    })
}

impl From<VersionError> for ApiError {
    fn from(error: VersionError) -> Self {
        match error {
            VersionError::Serving(serving) => serving.into(),
            VersionError::Registry(_) | VersionError::Store(_) => Self::of_own_data(&error),
            _ => Self::of(&error),
        }
    }
}
