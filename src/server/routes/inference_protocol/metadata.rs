//! What the server and its models are: metadata, readiness, configuration, statistics.

use std::sync::Arc;

use axum::Json;
use axum::extract::FromRequestParts;
use axum::http::request::Parts;
use serde::Deserialize;
use serde_json::{Value, json};

use super::tensor::{Datatype, Field};
use crate::server::http::extract::Path;
use crate::server::http::problem::ApiError;
use crate::server::inference_statistics::DurationSum;
use crate::server::routes::health;
use crate::server::state::App;
use foreframe_core::nn::ModelSpec;
use foreframe_core::registry::{Manifest, Model};

/// The platform of all models.
const PLATFORM: &str = "foreframe";

pub(super) async fn server() -> Json<Value> {
    Json(json!({
        "name": PLATFORM,
        "version": env!("CARGO_PKG_VERSION"),
        "extensions": ["binary_tensor_data", "model_configuration", "model_repository", "statistics"],
    }))
}

pub(super) async fn live() {}

pub(super) async fn ready(app: App) -> Result<(), ApiError> {
    health::check_predicts(&app)
}

pub(super) async fn index(app: App) -> Json<Value> {
    let entry = |manifest: &Arc<Manifest>| json!({"name": manifest.name, "version": manifest.version.to_string(), "state": "READY", "reason": ""});
    Json(app.predictor().models().iter().map(entry).collect())
}

/// The model in the path. Errors: `NotFound` if it is unknown, or another version is active.
pub(super) struct NamedModel(pub(super) Arc<Model>);

#[derive(Deserialize)]
struct ModelPath {
    model: String,
    version: Option<String>,
}

impl FromRequestParts<App> for NamedModel {
    type Rejection = ApiError;

    async fn from_request_parts(parts: &mut Parts, app: &App) -> Result<Self, ApiError> {
        let Path(path) = Path::<ModelPath>::from_request_parts(parts, app).await?;
        let model = app.predictor().active(&path.model)?;
        let active = model.manifest.version.to_string();
        match path.version {
            Some(version) if version != active => Err(ApiError::NotFound(format!(
                "version \"{}\" of model \"{}\" is not active; version {active} is",
                version.escape_default(),
                path.model
            ))),
            _ => Ok(Self(model)),
        }
    }
}

pub(super) async fn model_ready(_: NamedModel) {}

pub(super) async fn model(NamedModel(model): NamedModel) -> Json<Value> {
    let manifest = &model.manifest;
    let described = |field: Field| json!({"name": field.name, "datatype": field.datatype.name(), "shape": field.shape});
    Json(json!({
        "name": manifest.name,
        "versions": [manifest.version.to_string()],
        "platform": PLATFORM,
        "inputs": inputs(&manifest.spec).into_iter().map(described).collect::<Value>(),
        "outputs": outputs(manifest).into_iter().map(described).collect::<Value>(),
    }))
}

pub(super) async fn config(NamedModel(model): NamedModel) -> Json<Value> {
    let manifest = &model.manifest;
    let output = |field: &Field| json!({"name": field.name, "data_type": format!("TYPE_{}", field.datatype.name()), "dims": field.shape});
    let input = |field: &Field| {
        let mut described = output(field);
        described["optional"] = json!(field.is_optional);
        described
    };
    Json(json!({
        "name": manifest.name,
        "platform": PLATFORM,
        "backend": PLATFORM,
        "version_policy": {"specific": {"versions": [manifest.version]}},
        "max_batch_size": 0,
        "input": inputs(&manifest.spec).iter().map(input).collect::<Value>(),
        "output": outputs(manifest).iter().map(output).collect::<Value>(),
    }))
}

pub(super) async fn statistics(app: App, NamedModel(model): NamedModel) -> Json<Value> {
    Json(json!({"model_stats": [counts(&app, &model.manifest)]}))
}

pub(super) async fn all_statistics(app: App) -> Json<Value> {
    let manifests = app.predictor().models();
    let all: Value = manifests.iter().map(|manifest| counts(&app, manifest)).collect();
    Json(json!({"model_stats": all}))
}

fn counts(app: &App, manifest: &Manifest) -> Value {
    let found = app.inference_statistics.of(manifest.name.as_str(), manifest.version);
    let sum = |sum: DurationSum| json!({"count": sum.count, "ns": sum.ns});
    json!({
        "name": manifest.name,
        "version": manifest.version.to_string(),
        "last_inference": found.last_ms,
        "inference_count": found.success.count,
        "execution_count": found.success.count,
        "inference_stats": {
            "success": sum(found.success),
            "fail": sum(found.fail),
            "queue": sum(found.queue),
            "compute_infer": sum(found.compute),
        },
        "batch_stats": [],
    })
}

/// The inputs of a model; −1 is any length.
pub(super) fn inputs(spec: &ModelSpec) -> Vec<Field> {
    let (width, height) = (i64::from(spec.frame_width_px), i64::from(spec.frame_height_px));
    let frames = Field::new("frames", Datatype::Uint8, vec![spec.context as i64, height, width]);
    let mut fields = vec![frames];
    if let Some(states) = spec.state_inputs() {
        let state = Field::new("state", Datatype::Fp32, vec![states as i64]);
        fields.push(if spec.sees_speeds() { state.optional() } else { state });
    }
    if let Some(actions) = spec.action_inputs() {
        let actions = actions as i64;
        fields.push(Field::new("actions", Datatype::Fp32, vec![-1, actions]).optional());
        fields.push(Field::new("plan", Datatype::Fp32, vec![-1, actions]).optional());
        fields.push(Field::new("plans", Datatype::Fp32, vec![-1, -1, actions]).optional());
    }
    fields
}

/// The outputs of a model; with `plans`, each has the number of plans in front.
pub(super) fn outputs(manifest: &Manifest) -> Vec<Field> {
    let spec = &manifest.spec;
    let (width, height) = (i64::from(spec.frame_width_px), i64::from(spec.frame_height_px));
    let mut fields = vec![Field::new("predicted", Datatype::Uint8, vec![-1, height, width])];
    if manifest.calibration.is_some() {
        fields.push(Field::new("expected_mse", Datatype::Fp32, vec![-1]));
        fields.push(Field::new("mse_band_90", Datatype::Fp32, vec![-1, 2]));
        fields.push(Field::new("novelty", Datatype::Fp32, vec![1]));
    }
    fields
}
