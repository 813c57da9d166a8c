//! Predictions for many clients from one thread that owns the models: [`Predictor`] is the cheap handle, [`batch`] says
//! which waiting requests are computed together, [`predict`] is the computation itself.

mod catalog;
mod compute;
mod input;
mod queue;
mod worker;

pub mod batch;

use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use tokio::sync::oneshot;

use crate::frame::{Frame, FrameError};
use crate::nn::NnError;
use crate::registry::{LoadedModel, Manifest};

use catalog::Catalog;
pub use compute::predict;
pub(crate) use input::check_size;
pub use input::{InputError, PredictionInput};
use queue::{Load, Queue, Waiting};

/// Why no prediction came.
#[derive(Debug, thiserror::Error)]
pub enum ServingError {
    /// No model of that name is loaded.
    #[error("no model is named \"{name}\"; there are: {}", .known.join(", "))]
    UnknownModel {
        /// The name asked for.
        name: String,
        /// The names there are.
        known: Vec<String>,
    },
    /// The input does not fit the model.
    #[error(transparent)]
    Input(#[from] InputError),
    /// As many requests wait as may.
    #[error("{capacity} predictions wait already; try again in {retry_after_s} s")]
    QueueFull {
        /// How many may wait.
        capacity: usize,
        /// When to try again.
        retry_after_s: u64,
    },
    /// The request waited longer than it may.
    #[error("no prediction within {limit_ms} ms; the server is overloaded")]
    Deadline {
        /// How long a request may take.
        limit_ms: u128,
    },
    /// The predictor was told to stop, or its thread ended.
    #[error("the predictor has stopped")]
    Stopped,
    /// The model's computation failed.
    #[error("model \"{model}\" could not be computed")]
    Model {
        /// The model's name.
        model: String,
        /// What failed.
        #[source]
        source: Arc<NnError>,
    },
    /// The model predicted what is no image.
    #[error("model \"{model}\" predicted no image")]
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

/// The predictor's bounds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PredictorConfig {
    /// Requests that may wait, at least 1.
    pub queue_capacity: usize,
    /// Requests computed together at most, at least 1.
    pub batch_limit: usize,
    /// How long a request may take from its arrival to its answer.
    pub deadline: Duration,
}

impl Default for PredictorConfig {
    fn default() -> Self {
        Self {
            queue_capacity: 64,
            batch_limit: 16,
            deadline: Duration::from_secs(10),
        }
    }
}

/// Predicted frames and how long they took.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Prediction {
    /// The model's name.
    pub model: String,
    /// The model's version.
    pub version: u32,
    /// t+1, t+2, …: as many as the model's horizon.
    pub frames: Vec<Frame>,
    /// Microseconds in the queue.
    pub queue_us: u64,
    /// Microseconds of computation, of the whole batch.
    pub compute_us: u64,
}

/// The handle to the thread that owns the models; clones share it. The thread ends with the last of them.
#[derive(Clone)]
pub struct Predictor {
    shared: Arc<Shared>,
}

struct Shared {
    queue: Arc<Queue>,
    catalog: Arc<Catalog>,
    deadline: Duration,
    worker: Mutex<Option<JoinHandle<()>>>,
}

impl Drop for Shared {
    fn drop(&mut self) {
        self.queue.close();
    }
}

impl Predictor {
    /// Starts the thread, which first predicts once with every model so that no client waits for a cold one; meanwhile
    /// requests queue. Errors: `Thread`.
    pub fn start(models: Vec<LoadedModel>, config: PredictorConfig) -> Result<Self, ServingError> {
        let queue = Arc::new(Queue::new(config.queue_capacity, config.batch_limit));
        let catalog = Arc::new(Catalog::of(models.iter().map(|model| model.manifest.clone())));
        let worker = worker::spawn(models, Arc::clone(&queue), Arc::clone(&catalog))?;
        Ok(Self {
            shared: Arc::new(Shared {
                queue,
                catalog,
                deadline: config.deadline,
                worker: Mutex::new(Some(worker)),
            }),
        })
    }

    /// Whether every model has made its first prediction.
    #[must_use]
    pub fn is_ready(&self) -> bool {
        self.shared.catalog.is_ready()
    }

    /// The loaded models' manifests, by name.
    #[must_use]
    pub fn models(&self) -> Vec<Arc<Manifest>> {
        self.shared.catalog.all()
    }

    /// The manifest of one model. Errors: `UnknownModel`, which names those there are.
    pub fn model(&self, name: &str) -> Result<Arc<Manifest>, ServingError> {
        self.shared.catalog.find(name)
    }

    /// Predicts the frames that follow. Dropping the future withdraws the request. Errors: `UnknownModel`, `Input`,
    /// `QueueFull`, `Deadline`, `Stopped`, and what the computation itself fails with.
    pub async fn predict(&self, model: &str, input: PredictionInput) -> Result<Prediction, ServingError> {
        let manifest = self.model(model)?;
        input.check(&manifest.name, &manifest.spec)?;
        let accepted = Instant::now();
        let (reply, answer) = oneshot::channel();
        self.shared.queue.push(Waiting {
            model: manifest.name.clone(),
            input,
            accepted,
            deadline: accepted + self.shared.deadline,
            reply,
        })?;
        match tokio::time::timeout(self.shared.deadline, answer).await {
            Ok(Ok(answer)) => answer,
            Ok(Err(_)) => Err(ServingError::Stopped),
            Err(_) => Err(ServingError::Deadline {
                limit_ms: self.shared.deadline.as_millis(),
            }),
        }
    }

    /// Adds a model, or replaces the one of that name, once it has made its first prediction; blocks until then.
    /// Errors: `Stopped`, or what that prediction fails with, and then the old one goes on serving.
    pub fn load(&self, model: LoadedModel) -> Result<(), ServingError> {
        let (reply, answer) = std::sync::mpsc::sync_channel(1);
        self.shared.queue.load(Load { model, reply })?;
        answer.recv().map_err(|_| ServingError::Stopped)?
    }

    /// Takes no more requests, answers those that wait, and returns when the thread has ended; blocks.
    pub fn stop(&self) {
        self.shared.queue.close();
        let worker = self.shared.worker.lock().unwrap_or_else(PoisonError::into_inner).take();
        if let Some(worker) = worker {
            // A panic of the worker has already been printed; there is nothing left to stop.
            let _ = worker.join();
        }
    }
}
