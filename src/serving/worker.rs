//! The one thread that owns the models.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Instant;

use tracing::{error, info};

use super::catalog::Catalog;
use super::queue::{Load, Queue, Waiting, Work};
use super::{Prediction, PredictionInput, ServingError, compute, meter};
use crate::frame::Frame;
use crate::nn::ModelSpec;
use crate::registry::LoadedModel;
use crate::types::{Action, RobotState};

type Models = BTreeMap<String, LoadedModel>;

pub(super) fn spawn(
    models: Vec<LoadedModel>,
    queue: Arc<Queue>,
    catalog: Arc<Catalog>,
) -> Result<JoinHandle<()>, ServingError> {
    std::thread::Builder::new()
        .name("inference".to_owned())
        .spawn(move || {
            // A pool of this thread alone, so that no prediction waits for the threads that train.
            let pool = rayon::ThreadPoolBuilder::new()
                .num_threads(1)
                .use_current_thread()
                .build();
            match pool {
                Ok(pool) => pool.install(|| run(models, &queue, &catalog)),
                Err(error) => error!(%error, "the predictor's thread pool could not be built"),
            }
            queue.close();
        })
        .map_err(ServingError::Thread)
}

fn run(models: Vec<LoadedModel>, queue: &Queue, catalog: &Catalog) {
    let mut owned = Models::new();
    for model in models {
        if let Err(error) = warm_up(&model) {
            error!(model.id = %model.manifest.name, %error, "model failed its first prediction");
        }
        owned.insert(model.manifest.name.clone(), model);
    }
    catalog.set_ready();
    loop {
        match queue.take() {
            Work::Load(load) => take_in(*load, &mut owned, catalog),
            Work::Batch(batch) => answer(&owned, batch),
            Work::Stop => return,
        }
    }
}

fn take_in(Load { model, reply }: Load, owned: &mut Models, catalog: &Catalog) {
    let result = warm_up(&model);
    if result.is_ok() {
        catalog.insert(model.manifest.clone());
        owned.insert(model.manifest.name.clone(), model);
    }
    // Whoever asked may have gone; the model serves all the same.
    let _ = reply.send(result);
}

/// Predicts once from black frames, so that memory and kernels are warm.
fn warm_up(model: &LoadedModel) -> Result<(), ServingError> {
    let started = Instant::now();
    compute::predict(model, &[&blank_input(model.model.spec())?])?;
    let warm_up_us = micros_since(started);
    info!(model.id = %model.manifest.name, warm_up_us, "first prediction made");
    Ok(())
}

fn blank_input(spec: &ModelSpec) -> Result<PredictionInput, ServingError> {
    let pixels = vec![0; spec.frame_width_px as usize * spec.frame_height_px as usize];
    let frame =
        Frame::new(spec.frame_width_px, spec.frame_height_px, pixels).map_err(|source| ServingError::Frame {
            model: String::new(),
            source,
        })?;
    Ok(PredictionInput {
        frames: vec![frame; spec.context],
        actions: Action::try_from(vec![0.0; spec.actions.len()]).into_iter().collect(),
        state: RobotState::try_from(vec![0.0; spec.states.len()]).ok(),
        future_actions: None,
    })
}

fn answer(owned: &Models, batch: Vec<Waiting>) {
    let Some(model) = batch.first().and_then(|first| owned.get(&first.model)) else {
        return; // The dropped replies say that the predictor stopped; models are never taken out.
    };
    let started = Instant::now();
    let inputs: Vec<&PredictionInput> = batch.iter().map(|waiting| &waiting.input).collect();
    match compute::predict(model, &inputs) {
        Ok(predicted) => {
            let compute_us = micros_since(started);
            meter::computed(
                &model.manifest.name,
                batch.iter().map(|waiting| waiting.accepted),
                started,
            );
            for (waiting, frames) in batch.into_iter().zip(predicted) {
                let queue_us = micros(started.saturating_duration_since(waiting.accepted));
                let prediction = Prediction {
                    model: model.manifest.name.clone(),
                    version: model.manifest.version,
                    frames,
                    queue_us,
                    compute_us,
                };
                let _ = waiting.reply.send(Ok(prediction));
            }
        }
        // One bad input must not fail its neighbours.
        Err(_) if batch.len() > 1 => batch.into_iter().for_each(|waiting| answer(owned, vec![waiting])),
        Err(error) => {
            meter::refused("error");
            if let Some(waiting) = batch.into_iter().next() {
                let _ = waiting.reply.send(Err(error));
            }
        }
    }
}

fn micros_since(started: Instant) -> u64 {
    micros(started.elapsed())
}

fn micros(duration: std::time::Duration) -> u64 {
    u64::try_from(duration.as_micros()).unwrap_or(u64::MAX)
}
