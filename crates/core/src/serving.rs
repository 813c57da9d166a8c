//! Predictions for many clients. One thread owns the models and computes in batches. [`Predictor`] is the handle to it,
//! [`batch`] chooses which waiting tasks are computed together, [`predict`] is the computation on the caller's own thread,
//! and [`session`] is the state that a stream of frames keeps between frames.

mod catalog;
mod compute;
mod conditioning;
mod error;
mod input;
mod local;
mod meter;
mod past_errors;
mod prediction;
mod predictor;
mod queue;
mod ranges;
mod task;
#[cfg(test)]
mod test_models;
mod worker;

pub mod batch;
pub mod session;

pub use conditioning::{ConditioningInput, FieldNames, OBSERVATION_FIELDS, RawConditioning, STEP_FIELDS};
pub use error::{InputError, ServingError};
pub use input::PredictionInput;
pub use local::{Session, compute_task, predict};
pub use prediction::{Prediction, Rollout, Timing};
pub use predictor::{Predictor, PredictorConfig};
pub use session::{SessionSnapshot, SessionState};
pub use task::{Features, Task, check_size, unused_inputs};
#[cfg(test)]
pub(crate) use test_models::{test_depth_model, test_flow_model, test_model, test_speed_model};
