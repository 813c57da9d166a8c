//! Foreframe predicts the next camera frames of a robot from its frames, actions and state.
//!
//! A robot's own program needs no server: `foreframe = { version = "0.1", default-features = false }` gives it the models,
//! the state of a session, the [`Predictor`] for many clients, and frames. Feature `sim` adds the simulated room, `train`
//! data sets, training and evaluation, `server` (the default) the server and the program.
//!
//! Predict the frames that follow five from a camera:
//!
//! ```
//! use std::path::Path;
//!
//! use foreframe::frame::codec;
//! use foreframe::{Action, PredictionInput, RobotState, load, predict};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let model = load(Path::new("models/moving"))?;
//! let mut frames = Vec::new();
//! for i in 0..model.network.spec().context {
//!     frames.push(codec::decode(&std::fs::read(format!("examples/frames/frame-{i:03}.png"))?)?);
//! }
//! // This model is conditioned on the robot's state at the last frame and on its next actions. `GET /v1/models/moving`
//! // and `foreframe inspect moving` list their components and units.
//! let input = PredictionInput {
//!     frames,
//!     state: Some(RobotState::try_from(vec![2.7, 0.13, 0.64, 0.77, 0.0, -0.8])?),
//!     future_actions: Some(vec![Action::try_from(vec![0.0, -0.8])?; model.network.spec().horizon]),
//!     ..PredictionInput::default()
//! };
//! let predictions = predict(&model, &[&input])?;
//! assert_eq!(predictions[0].frames.len(), model.network.spec().horizon);
//! # Ok(())
//! # }
//! ```
//!
//! The modules in reading order; each uses only those above it. The first ones are in crates of their own, one a layer:
//! `foreframe-core`, `foreframe-sim`, `foreframe-data`, `foreframe-train` and `foreframe-jobs`.
#![deny(unsafe_code)]

pub use foreframe_core::{error_kind, error_text, files, frame, metric_names, nn, registry, serving, types};

#[cfg(feature = "sim")]
pub use foreframe_sim as sim;

#[cfg(feature = "train")]
pub use foreframe_data::{dataset, inspection};
#[cfg(feature = "train")]
pub use foreframe_train::{evaluation, settings, training};

#[cfg(feature = "server")]
pub use foreframe_jobs::{jobs, store, versions};

#[cfg(feature = "server")]
mod program;

#[cfg(feature = "server")]
pub mod telemetry;

#[cfg(feature = "server")]
pub mod server;

#[cfg(feature = "server")]
pub mod config;

#[cfg(feature = "server")]
pub mod cli;

pub use frame::{Frame, FrameError};
pub use nn::{Model, ModelSpec, NnError};
pub use registry::{LoadedModel, Manifest, RegistryError, load};
pub use serving::session::{SessionSnapshot, SessionState, SnapshotError};
pub use serving::{
    ConditioningInput, InputError, Prediction, PredictionInput, Predictor, PredictorConfig, Rollout, ServingError,
    predict,
};
pub use types::{Action, RobotState, Seed};
