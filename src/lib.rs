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
//! for i in 0..model.model.spec().context {
//!     frames.push(codec::decode(&std::fs::read(format!("examples/frames/frame-{i:03}.png"))?)?);
//! }
//! // This model is conditioned on the robot's state at the last frame and on its next actions. `GET /v1/models/moving`
//! // and `foreframe inspect moving` list their components and units.
//! let input = PredictionInput {
//!     frames,
//!     state: Some(RobotState::try_from(vec![2.7, 0.13, 0.64, 0.77, 0.0, -0.8])?),
//!     future_actions: Some(vec![Action::try_from(vec![0.0, -0.8])?; model.model.spec().horizon]),
//!     ..PredictionInput::default()
//! };
//! let predictions = predict(&model, &[&input])?;
//! assert_eq!(predictions[0].frames.len(), model.model.spec().horizon);
//! # Ok(())
//! # }
//! ```
//!
//! The modules in reading order; each uses only those above it:
#![deny(unsafe_code)]
// Some crate-private helpers serve only the modules of a feature. The default features use all of them, and are checked.
#![cfg_attr(not(feature = "server"), allow(dead_code, unused_imports))]

pub mod types;

mod vectorized;

pub mod files;

#[cfg(feature = "train")]
pub mod settings;

pub mod error_text;
pub mod telemetry;

pub mod frame;

pub mod nn;

#[cfg(feature = "sim")]
pub mod sim;

#[cfg(feature = "train")]
pub mod dataset;

#[cfg(feature = "train")]
pub mod inspection;

pub mod registry;

#[cfg(feature = "train")]
pub mod training;

#[cfg(feature = "train")]
pub mod evaluation;

pub mod serving;

#[cfg(feature = "server")]
pub mod store;

#[cfg(feature = "server")]
pub mod versions;

#[cfg(feature = "server")]
pub mod jobs;

#[cfg(feature = "server")]
pub mod server;

#[cfg(feature = "server")]
pub mod config;

#[cfg(feature = "server")]
pub mod cli;

pub use frame::{Frame, FrameError};
pub use nn::{Model, ModelSpec, NnError};
pub use registry::{LoadedModel, Manifest, RegistryError, load};
pub use serving::session::{MemoryError, SessionMemory, SessionState};
pub use serving::{
    ConditioningInput, InputError, Prediction, PredictionInput, Predictor, PredictorConfig, Rollout, ServingError,
    predict,
};
pub use types::{Action, RobotState, Seed};
