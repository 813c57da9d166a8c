//! Predictions for many clients. One thread owns the models and computes in batches. [`Predictor`] is the handle to it,
//! [`batch`] chooses which waiting tasks are computed together, [`predict`] is the computation, and [`session`] is the
//! state that a stream of frames keeps between frames.

mod catalog;
mod compute;
mod input;
mod local;
mod meter;
mod queue;
mod ranges;
mod task;
mod worker;

pub mod batch;
pub mod session;

use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use tokio::sync::oneshot;

use crate::frame::FrameError;
use crate::nn::NnError;
use crate::registry::{LoadedModel, Manifest};

use catalog::Catalog;
pub use compute::{Features, Rollout, predict};
pub use input::check_size;
pub use input::{InputError, PredictionInput};
use queue::{ModelLoad, Queue, QueuedTask};
use ranges::range_warnings;
pub use session::{SessionMemory, SessionState};
pub use task::{ConditioningInput, Task};
pub use task::{RawConditioning, STEP_FIELDS};

/// A task with many rollouts gets one part in this many of a batch at a time, so that other requests wait less.
const PARTS_IN_A_BATCH: usize = 4;

/// Why a prediction failed.
#[derive(Debug, thiserror::Error)]
pub enum ServingError {
    /// No model of that name is loaded.
    #[error("there is no model \"{name}\"; there are: {}", .available.join(", "))]
    UnknownModel {
        /// The requested name.
        name: String,
        /// The names of the loaded models.
        available: Vec<String>,
    },
    /// The input does not fit the model.
    #[error(transparent)]
    Input(#[from] InputError),
    /// The queue is full.
    #[error("{capacity} predictions are waiting already; try again in {retry_after_s} s")]
    QueueFull {
        /// How many predictions can wait.
        capacity: usize,
        /// When to try again, in seconds.
        retry_after_s: u64,
    },
    /// The request waited longer than its limit.
    #[error("no prediction within {limit_ms} ms; the server is overloaded")]
    Deadline {
        /// The time limit of a request, in milliseconds.
        limit_ms: u128,
    },
    /// The predictor is stopping, or its thread has ended.
    #[error("the predictor has stopped")]
    Stopped,
    /// The computation panicked. The thread was restarted.
    #[error("the computation of the prediction panicked; the server's log says where")]
    Panicked,
    /// The model's computation failed.
    #[error("model \"{model}\" could not be computed")]
    Model {
        /// The model's name.
        model: String,
        /// What failed.
        #[source]
        source: Arc<NnError>,
    },
    /// The model's output is not an image.
    #[error("the output of model \"{model}\" is not an image")]
    Frame {
        /// The model's name.
        model: String,
        /// What was wrong with it.
        #[source]
        source: FrameError,
    },
    /// The prediction's tensors could not be built.
    #[error("the input's tensors could not be built")]
    Tensor(#[source] Arc<candle_core::Error>),
    /// The thread that owns the models could not be started.
    #[error("could not start the predictor's thread")]
    Thread(#[source] std::io::Error),
}

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

/// Predicted frames and how long they took.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct Prediction {
    /// The model's name.
    pub model: String,
    /// The model's version.
    pub version: u32,
    /// The predicted frames, with what is known of their errors.
    pub rollout: Rollout,
    /// Actions and states out of the range of the training.
    pub warnings: Vec<String>,
    /// Microseconds in the queue.
    pub queue_us: u64,
    /// Microseconds of computation, of the whole batch.
    pub compute_us: u64,
}

/// The output of a [`Task`] and how long it took.
#[derive(Clone, Debug, Default, PartialEq)]
#[non_exhaustive]
pub struct TaskOutput {
    /// The features of the task's frames, in order.
    pub features: Vec<Features>,
    /// The predicted frames, one rollout for each conditioning input of the task, in order.
    pub predictions: Vec<Rollout>,
    /// Actions and states out of the range of the training.
    pub warnings: Vec<String>,
    /// Microseconds in the queue.
    pub queue_us: u64,
    /// Microseconds of computation, of whole batches.
    pub compute_us: u64,
}

impl TaskOutput {
    /// Adds the output of the next part.
    fn append(&mut self, mut part: Self) {
        self.features.append(&mut part.features);
        self.predictions.append(&mut part.predictions);
        self.queue_us += part.queue_us;
        self.compute_us += part.compute_us;
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
    pub fn start(models: Vec<LoadedModel>, config: PredictorConfig) -> Result<Self, ServingError> {
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
    pub fn active(&self, name: &str) -> Result<Arc<LoadedModel>, ServingError> {
        self.shared.catalog.find(name)
    }

    /// Predicts the frames that follow the context. Dropping the returned future cancels the request.
    /// Errors: `UnknownModel`, `Input`, `QueueFull`, `Deadline`, `Stopped`, and the errors of the computation.
    pub async fn predict(&self, model: &str, input: PredictionInput) -> Result<Prediction, ServingError> {
        self.predict_by(&self.active(model)?, input).await
    }

    /// As [`Predictor::predict`], with this version of a model.
    pub async fn predict_by(
        &self,
        model: &Arc<LoadedModel>,
        input: PredictionInput,
    ) -> Result<Prediction, ServingError> {
        let manifest = &model.manifest;
        let task = input.into_task(&manifest.name, &manifest.spec)?;
        let computed = self.compute(model, task, None).await?;
        Ok(Prediction {
            model: manifest.name.clone(),
            version: manifest.version,
            rollout: computed.predictions.into_iter().next().unwrap_or_default(),
            warnings: computed.warnings,
            queue_us: computed.queue_us,
            compute_us: computed.compute_us,
        })
    }

    /// Computes a task. If it is a step of a session, a batch holds at most one step of that session. Many rollouts are
    /// computed in several parts, so that other requests run between them. Dropping the returned future cancels the task.
    /// Errors: `QueueFull`, `Deadline`, `Stopped`, and the errors of the computation.
    pub async fn compute(
        &self,
        model: &Arc<LoadedModel>,
        mut task: Task,
        session: Option<u64>,
    ) -> Result<TaskOutput, ServingError> {
        let deadline = Instant::now() + self.shared.deadline;
        let mut whole = TaskOutput {
            warnings: range_warnings(&model.manifest, &task.conditioning_inputs),
            ..TaskOutput::default()
        };
        loop {
            let part = task.next_part(self.shared.part_limit);
            let computed = self.compute_part(model, part, session, deadline).await?;
            task.past_features.extend(computed.features.iter().cloned());
            whole.append(computed);
            if task.conditioning_inputs.is_empty() {
                return Ok(whole);
            }
        }
    }

    async fn compute_part(
        &self,
        model: &Arc<LoadedModel>,
        task: Task,
        session: Option<u64>,
        deadline: Instant,
    ) -> Result<TaskOutput, ServingError> {
        let (reply, answer) = oneshot::channel();
        self.shared.queue.push(QueuedTask {
            model: Arc::clone(model),
            task,
            session,
            accepted: Instant::now(),
            deadline,
            limit: self.shared.deadline,
            reply,
        })?;
        match tokio::time::timeout_at(deadline.into(), answer).await {
            Ok(Ok(answer)) => answer,
            Ok(Err(_)) if self.shared.queue.is_closed() => Err(ServingError::Stopped),
            Ok(Err(_)) => Err(ServingError::Panicked),
            Err(_) => Err(ServingError::Deadline {
                limit_ms: self.shared.deadline.as_millis(),
            }),
        }
    }

    /// Adds a model, or replaces the one of the same name, after it has made its first prediction. Blocks until then.
    /// Errors: `Stopped`, or the error of that prediction; the old model then stays active.
    pub fn load(&self, model: LoadedModel) -> Result<(), ServingError> {
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

/// A small model with random weights.
#[cfg(test)]
pub fn test_model() -> LoadedModel {
    use crate::nn::{Architecture, ChannelScale, Conditioning, DenseSpec, ModelSpec};
    let channel = |name: &str| ChannelScale {
        name: name.to_owned(),
        unit: String::new(),
        mean: 0.0,
        std: 1.0,
    };
    let spec = ModelSpec {
        frame_width_px: 6,
        frame_height_px: 4,
        context: 3,
        horizon: 2,
        architecture: Architecture::Dense(DenseSpec {
            features: 5,
            hidden: 4,
            ..DenseSpec::default()
        }),
        conditioning: Conditioning::StateAction,
        actions: vec![channel("a")],
        states: vec![channel("s")],
        ..ModelSpec::default()
    };
    loaded(spec)
}

/// As [`test_model`], with the flow network, on frames of 8×4 px.
#[cfg(test)]
pub fn test_flow_model() -> LoadedModel {
    use crate::nn::{Architecture, FlowLayers, FlowSpec, ModelSpec};
    loaded(ModelSpec {
        architecture: Architecture::Flow(FlowSpec {
            layers: FlowLayers {
                channels: 8,
                stem_channels: 6,
                enlarged_channels: 3,
                fine_channels: 5,
                scene_hidden: 8,
                ..FlowLayers::default()
            },
            camera: None,
        }),
        frame_width_px: 8,
        ..test_model().model.spec().clone()
    })
}

/// A model of that specification with fresh weights.
#[cfg(test)]
fn loaded(spec: crate::nn::ModelSpec) -> LoadedModel {
    use crate::nn::{Model, Parameters};
    let parameters = Parameters::initialize(&spec, crate::types::Seed(1)).unwrap();
    let manifest = serde_json::json!({
        "name": "test", "version": 1, "spec": spec, "weights_sha256": "00",
        "dataset": {"name": "none", "content_hash": "", "scenario": null, "windows": 1, "split_seed": 0},
        "seed": 1, "command": "", "training": {}, "metrics": {}, "parameters": 1, "multiply_adds_per_frame": 1,
        "program": {"version": "0", "git_commit": null},
    });
    LoadedModel {
        manifest: Arc::new(serde_json::from_value(manifest).unwrap()),
        model: Model::detached(spec, &parameters).unwrap(),
    }
}
