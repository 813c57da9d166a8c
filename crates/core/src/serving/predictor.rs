//! The handle to the inference thread.

use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use tokio::sync::oneshot;

use super::catalog::Catalog;
use super::error::ServingError;
use super::input::PredictionInput;
use super::prediction::Prediction;
use super::queue::{ModelLoad, Queue, QueuedTask};
use super::ranges::range_warnings;
use super::task::Task;
use super::worker;
use crate::registry::{Manifest, Model};

/// A task with many rollouts gets one part in this many of a batch at a time, so that other requests wait less.
const PARTS_IN_A_BATCH: usize = 4;

/// The predictor's limits.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PredictorConfig {
    /// How many requests can wait, at least 1.
    pub queue_capacity: usize,
    /// How many rollouts are predicted together at most, at least 1.
    pub batch_limit: usize,
    /// Time limit of a request, from its arrival to its answer.
    pub deadline: Duration,
}

impl Default for PredictorConfig {
    fn default() -> Self {
        Self {
            queue_capacity: 256,
            batch_limit: 64,
            deadline: Duration::from_secs(10),
        }
    }
}

/// The handle to the thread that owns the models. Clones share the thread; it ends when the last clone is dropped.
#[derive(Clone)]
pub struct Predictor {
    shared: Arc<PredictorInner>,
}

struct PredictorInner {
    queue: Arc<Queue>,
    catalog: Arc<Catalog>,
    deadline: Duration,
    part_limit: usize,
    worker: Mutex<Option<JoinHandle<()>>>,
}

impl Drop for PredictorInner {
    fn drop(&mut self) {
        self.queue.close();
    }
}

impl Predictor {
    /// Starts the thread. It first predicts once with every model, so that the first request does not pay for the warm-up;
    /// requests wait in the queue until then. Errors: `Thread`.
    pub fn start(models: Vec<Model>, config: PredictorConfig) -> Result<Self, ServingError> {
        let queue = Arc::new(Queue::new(config.queue_capacity, config.batch_limit));
        let catalog = Arc::new(Catalog::new(models));
        let worker = worker::spawn(Arc::clone(&queue), Arc::clone(&catalog))?;
        Ok(Self {
            shared: Arc::new(PredictorInner {
                queue,
                catalog,
                deadline: config.deadline,
                part_limit: (config.batch_limit / PARTS_IN_A_BATCH).max(1),
                worker: Mutex::new(Some(worker)),
            }),
        })
    }

    /// Whether every model has made its first prediction and the last computations did not panic.
    #[must_use]
    pub fn is_ready(&self) -> bool {
        self.shared.catalog.is_ready()
    }

    /// The loaded models' manifests, by name.
    #[must_use]
    pub fn models(&self) -> Vec<Arc<Manifest>> {
        let models = self.shared.catalog.all().into_iter();
        models.map(|model| Arc::clone(&model.manifest)).collect()
    }

    /// The manifest of one model. Errors: `UnknownModel`.
    pub fn model(&self, name: &str) -> Result<Arc<Manifest>, ServingError> {
        Ok(Arc::clone(&self.active(name)?.manifest))
    }

    /// The active version of a model. It stays usable for its holder after another version becomes active.
    /// Errors: `UnknownModel`.
    pub fn active(&self, name: &str) -> Result<Arc<Model>, ServingError> {
        self.shared.catalog.find(name)
    }

    /// Predicts the frames that follow the context: one rollout. Dropping the returned future cancels the request.
    /// Errors: `UnknownModel`, `Input`, `QueueFull`, `Deadline`, `Stopped`, and the errors of the computation.
    pub async fn predict(&self, model: &str, input: PredictionInput) -> Result<Prediction, ServingError> {
        let model = self.active(model)?;
        let task = input.into_task(&model.manifest)?;
        self.compute(&model, task, None).await
    }

    /// Computes a task. If it is a step of a session, a batch holds at most one step of that session. Many rollouts are
    /// computed in several parts, so that other requests run between them. Dropping the returned future cancels the task.
    /// Errors: `QueueFull`, `Deadline`, `Stopped`, and the errors of the computation.
    #[doc(hidden)]
    pub async fn compute(
        &self,
        model: &Arc<Model>,
        mut task: Task,
        session: Option<u64>,
    ) -> Result<Prediction, ServingError> {
        let deadline = Instant::now() + self.shared.deadline;
        let mut warnings = std::mem::take(&mut task.warnings);
        warnings.extend(range_warnings(&model.manifest, &task.conditioning_inputs));
        let part_limit = task.rollouts_of_part(self.shared.part_limit, model.spec());
        let first = task.next_part(part_limit);
        let mut whole = self.compute_part(model, first, session, deadline).await?;
        // The first part has encoded the frames; the others predict from their features.
        task.past_features.extend(whole.features.iter().cloned());
        while !task.conditioning_inputs.is_empty() {
            let part = task.next_part(part_limit);
            whole.append(self.compute_part(model, part, session, deadline).await?);
        }
        whole.warnings = warnings;
        Ok(whole)
    }

    async fn compute_part(
        &self,
        model: &Arc<Model>,
        task: Task,
        session: Option<u64>,
        deadline: Instant,
    ) -> Result<Prediction, ServingError> {
        let (reply, answer) = oneshot::channel();
        self.shared.queue.push(QueuedTask {
            model: Arc::clone(model),
            task,
            session,
            accepted: Instant::now(),
            deadline,
            reply,
        })?;
        match tokio::time::timeout_at(deadline.into(), answer).await {
            Ok(Ok(answer)) => answer,
            Ok(Err(_)) if self.shared.queue.is_closed() => Err(ServingError::Stopped),
            // The queue drops a task after its deadline, the thread one whose computation panicked.
            Ok(Err(_)) if Instant::now() < deadline => Err(ServingError::Panicked),
            _ => Err(ServingError::Deadline {
                limit_ms: self.shared.deadline.as_millis(),
            }),
        }
    }

    /// Adds a model, or replaces the one of the same name, after it has made its first prediction. Blocks until then.
    /// Errors: `Stopped`, or the error of that prediction; the old model then stays active.
    pub fn load(&self, model: Model) -> Result<(), ServingError> {
        let (reply, answer) = std::sync::mpsc::sync_channel(1);
        self.shared.queue.load(ModelLoad { model, reply })?;
        answer.recv().map_err(|_| ServingError::Stopped)?
    }

    /// Refuses new requests, answers the waiting ones, and returns when the thread has ended. Blocks.
    pub fn stop(&self) {
        self.shared.queue.close();
        let worker = self.shared.worker.lock().unwrap_or_else(PoisonError::into_inner).take();
        if let Some(worker) = worker {
            // A panic of the thread has already been logged.
            let _ = worker.join();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::nn::{ModelSpec, Network, Parameters};
    use crate::registry::Manifest;
    use crate::serving::test_model;
    use crate::types::Seed;

    /// A model without context: its computation divides by zero.
    fn panicking_model() -> Model {
        let model = test_model();
        let parameters = Parameters::initialize(model.spec(), Seed(1)).unwrap();
        let spec = ModelSpec {
            context: 0,
            ..model.spec().clone()
        };
        Model {
            network: Network::detached(model.spec().clone(), &parameters)
                .unwrap()
                .with_spec(spec.clone()),
            manifest: Arc::new(Manifest {
                spec,
                ..Manifest::clone(&model.manifest)
            }),
        }
    }

    fn task(model: &Model) -> Task {
        let input = worker::blank_input(model);
        Task {
            conditioning_inputs: vec![input.conditioning(&model.manifest).unwrap()],
            frames: input.frames,
            ..Task::default()
        }
    }

    #[test]
    fn a_part_has_fewer_rollouts_where_they_are_longer() {
        let model = test_model();
        let of_part = |steps| {
            let mut task = task(&model);
            task.conditioning_inputs[0].steps = steps;
            task.rollouts_of_part(16, model.spec())
        };
        // The horizon has two steps.
        assert_eq!(
            [None, Some(1), Some(2), Some(3), Some(8), Some(100)].map(of_part),
            [16, 16, 16, 8, 4, 1]
        );
    }

    #[tokio::test]
    async fn a_panic_fails_its_batch_and_the_thread_restarts() {
        let config = PredictorConfig {
            deadline: Duration::from_mins(1),
            ..PredictorConfig::default()
        };
        let predictor = Predictor::start(vec![test_model()], config).unwrap();
        let (good, bad) = (predictor.active("test").unwrap(), Arc::new(panicking_model()));
        for _ in 0..3 {
            let failed = predictor.compute(&bad, task(&bad), None).await;
            assert!(matches!(failed, Err(ServingError::Panicked)), "{failed:?}");
        }
        while predictor.is_ready() {
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
        let computed = predictor.compute(&good, task(&good), None).await.unwrap();
        assert_eq!(computed.rollouts.len(), 1);
        while !predictor.is_ready() {
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
    }
}
