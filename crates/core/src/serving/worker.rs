//! The inference thread: the only thread that computes with the models, with helpers for a batch of many rollouts.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Instant;

use rayon::ThreadPool;
use tracing::{error, info};

use super::catalog::Catalog;
use super::error::ServingError;
use super::input::PredictionInput;
use super::prediction::Timing;
use super::queue::{ModelLoad, Queue, QueuedTask, WorkItem};
use super::task::Task;
use super::{compute, local, meter};
use crate::frame::Frame;
use crate::registry::Model;
use crate::types::{Action, RobotState};

pub(super) fn spawn(queue: Arc<Queue>, catalog: Arc<Catalog>) -> Result<JoinHandle<()>, ServingError> {
    std::thread::Builder::new()
        .name("inference".to_owned())
        .spawn(move || {
            // A pool of its own, so that predictions do not wait for training threads: this thread, and one for each
            // other core, which share the work of a batch.
            let pool = rayon::ThreadPoolBuilder::new()
                .thread_name(|index| format!("inference-{index}"))
                .use_current_thread()
                .build();
            match pool {
                Ok(pool) => supervise(&pool, &queue, &catalog),
                Err(error) => error!(%error, "the predictor's thread pool could not be built"),
            }
            queue.close();
        })
        .map_err(ServingError::Thread)
}

/// Computes until the queue is closed. A panic fails the work that caused it, and the loop starts again.
fn supervise(pool: &ThreadPool, queue: &Queue, catalog: &Catalog) {
    // After a panic, no state of the computation is used again: a task carries all that it needs.
    let guarded = |work: &(dyn Fn() + Sync)| {
        let result = catch_unwind(AssertUnwindSafe(|| pool.install(work)));
        if result.is_err() {
            catalog.record_panic();
            meter::record_panic();
            error!("the inference thread panicked and was restarted");
        }
        result.is_ok()
    };
    for model in catalog.all() {
        guarded(&|| {
            if let Err(error) = warm_up(&model) {
                error!(model.id = %model.manifest.name, %error, "model failed its first prediction");
            }
        });
    }
    catalog.set_ready();
    while !guarded(&|| run(queue, catalog)) {}
}

fn run(queue: &Queue, catalog: &Catalog) {
    loop {
        match queue.next_work() {
            WorkItem::ModelLoad(load) => load_model(*load, catalog),
            WorkItem::Batch(batch) => {
                answer(batch);
                catalog.reset_panics();
            }
            WorkItem::Stop => return,
        }
    }
}

fn load_model(ModelLoad { model, reply }: ModelLoad, catalog: &Catalog) {
    let result = warm_up(&model);
    if result.is_ok() {
        catalog.insert(model);
    }
    // The caller may be gone; the model is active all the same.
    let _ = reply.send(result);
}

/// Predicts once from black frames, to warm up memory and caches.
fn warm_up(model: &Model) -> Result<(), ServingError> {
    let started = Instant::now();
    local::predict(model, &[&blank_input(model)])?;
    let warm_up_us = micros_since(started);
    info!(model.id = %model.manifest.name, warm_up_us, "first prediction made");
    Ok(())
}

/// Black frames, with actions and a state of zeros.
pub(super) fn blank_input(model: &Model) -> PredictionInput {
    let spec = model.spec();
    let frame = Frame::new(spec.frame_width_px, spec.frame_height_px, vec![0; spec.pixels()]);
    let frame = frame.expect("a model with frames that are too large is a bug");
    PredictionInput {
        frames: vec![frame; spec.context],
        actions: Action::try_from(vec![0.0; spec.actions.len()]).into_iter().collect(),
        state: RobotState::try_from(vec![0.0; spec.states.len()]).ok(),
        past_states: Vec::new(),
        camera: None,
        plan: None,
        steps: None,
    }
}

fn answer(batch: Vec<QueuedTask>) {
    let Some(model) = batch.first().map(|first| Arc::clone(&first.model)) else {
        return;
    };
    let started = Instant::now();
    let tasks: Vec<&Task> = batch.iter().map(|waiting| &waiting.task).collect();
    match compute::run(&model, &tasks) {
        Ok(predictions) => {
            let compute_us = micros_since(started);
            let accepted: Vec<Instant> = batch.iter().map(|waiting| waiting.accepted).collect();
            for (waiting, mut prediction) in batch.into_iter().zip(predictions) {
                prediction.timing = Timing {
                    queue_us: micros(started.saturating_duration_since(waiting.accepted)),
                    compute_us,
                };
                // The receiver is gone if the client has disconnected.
                let _ = waiting.reply.send(Ok(prediction));
            }
            // After the answers, so that no client waits for the metrics.
            meter::record_batch(&model.manifest.name, &accepted, started, compute_us);
        }
        // One bad task must not fail the others of its batch.
        Err(_) if batch.len() > 1 => batch.into_iter().for_each(|waiting| answer(vec![waiting])),
        Err(error) => {
            meter::record_refusal("error");
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
