//! A picture of what a model can do: a simulated trial, the prediction, and the true frames.

use std::sync::Arc;

use axum::body::Bytes;
use axum::http::header;
use axum::response::{IntoResponse as _, Response};
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::picture;
use crate::server::http::extract::Path;
use crate::server::http::problem::ApiError;
use crate::server::state::App;
use foreframe_core::frame::Frame;
use foreframe_core::nn::{Conditioning, ModelSpec};
use foreframe_core::registry::{Manifest, Model};
use foreframe_core::serving::PredictionInput;
use foreframe_core::types::{Action, RobotState, Seed};
use foreframe_sim::{Scenario, SimError, World, WorldConfig};
use foreframe_train::evaluation::figures::montage::prediction_sheet;

pub(in crate::server) fn routes() -> OpenApiRouter<App> {
    OpenApiRouter::new().routes(routes!(preview))
}

/// Frames before the context, so that the robots already move.
const LEAD_IN_FRAMES: usize = 10;
/// The trial in the picture: always the same, so that pictures of two models can be compared.
const SEED: Seed = Seed(2020);
const TRIAL: u64 = 1;

/// A contact sheet of a simulated trial: the context, the predicted frames and the true frames.
#[utoipa::path(
    get, path = "/v1/models/{model}/preview.png",
    responses(
        (status = 200, description = "The picture", body = Vec<u8>, content_type = "image/png"),
        (status = 422, description = "The simulator cannot make the frames that this model takes"),
        (status = 503, description = "Too many predictions wait"),
    )
)]
async fn preview(app: App, Path(model): Path<String>) -> Result<Response, ApiError> {
    let active = app.predictor().active(&model)?;
    let key = format!("model/{model}/{}", active.manifest.weights_sha256);
    // Many requests for the same picture compute one prediction.
    let _turn = app.render_cache.turn().await;
    let png = match app.render_cache.cached(&key) {
        Some(png) => png,
        None => make(&app, active, key).await?,
    };
    Ok(([(header::CONTENT_TYPE, "image/png")], png).into_response())
}

async fn make(app: &App, model: Arc<Model>, key: String) -> Result<Bytes, ApiError> {
    let manifest = Arc::clone(&model.manifest);
    let simulated = app.render_cache.threads().run(move || simulate(&manifest)).await?;
    let (input, truth) = simulated.map_err(|error| ApiError::Unprocessable(error.to_string()))?;
    let seen = input.frames.clone();
    let task = input.into_task(&model.manifest)?;
    let mut rollouts = app.predictor().compute(&model, task, None).await?.rollouts;
    let predicted = rollouts.pop().unwrap_or_default().frames;
    let draw = move || picture::png_file(prediction_sheet(&seen, &predicted, &truth));
    app.render_cache.get_or_make(key, draw).await
}

/// The model's input from the trial, and the true frames after it.
fn simulate(manifest: &Manifest) -> Result<(PredictionInput, Vec<Frame>), SimError> {
    let spec = &manifest.spec;
    let config = WorldConfig {
        frame_width_px: spec.frame_width_px,
        frame_height_px: spec.frame_height_px,
        frame_period_s: spec.frame_period_s,
        ..WorldConfig::default()
    };
    let mut world = World::new(scenario(manifest), &config, SEED, TRIAL)?;
    let (mut frames, mut actions, mut states) = (Vec::new(), Vec::<Action>::new(), Vec::<RobotState>::new());
    let ModelSpec { context, horizon, .. } = *spec;
    for _ in 0..LEAD_IN_FRAMES + context + horizon {
        let (observation, action) = (world.observe(), world.policy_action());
        world.step(&action)?;
        frames.push(observation.frame);
        states.push(observation.state);
        actions.push(action);
    }
    let now = LEAD_IN_FRAMES + context - 1;
    let input = PredictionInput {
        frames: frames[LEAD_IN_FRAMES..=now].to_vec(),
        actions: Vec::new(),
        state: Some(states[now].clone()),
        past_states: states[LEAD_IN_FRAMES..now].to_vec(),
        camera: Some(config.camera.model_with_height()),
        plan: Some(actions[now..now + horizon].to_vec()),
        steps: None,
    };
    Ok((input, frames.split_off(now + 1)))
}

/// The scenario that the model was trained on, or one that fits its conditioning.
fn scenario(manifest: &Manifest) -> Scenario {
    let trained_on = manifest.dataset.scenario.as_ref().and_then(|name| name.parse().ok());
    trained_on.unwrap_or(match manifest.spec.conditioning {
        Conditioning::None => Scenario::StaticObserver,
        _ => Scenario::MovingObserver,
    })
}
