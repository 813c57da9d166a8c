//! Foreframe predicts the next camera frames of a robot from its frames, actions and state.
//!
//! A robot's own program needs no server: `foreframe = { version = "0.1", default-features = false }` gives it models
//! ([`load`], [`Model`]), the prediction of a window ([`predict`]), the [`Session`] of one camera, the [`Predictor`] for many
//! clients, and [`images`]. Feature `sim` adds the simulated room, `train` data sets, training and evaluation, `server` (the
//! default) the server and the program.
//!
//! Predict the frames that follow five from a camera:
//!
//! ```
//! use std::path::Path;
//!
//! use foreframe::images::decode;
//! use foreframe::{Action, PredictionInput, RobotState, load, predict};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let model = load(Path::new("models/moving"))?;
//! let mut frames = Vec::new();
//! for i in 0..model.spec().context {
//!     frames.push(decode(&std::fs::read(format!("examples/frames/frame-{i:03}.png"))?)?);
//! }
//! // This model is conditioned on the robot's state at the last frame and on its next actions. `GET /v1/models/moving`
//! // and `foreframe inspect moving` list their components and units.
//! let input = PredictionInput {
//!     frames,
//!     state: Some(RobotState::try_from(vec![2.7, 0.13, 0.64, 0.77, 0.0, -0.8])?),
//!     plan: Some(vec![Action::try_from(vec![0.0, -0.8])?; model.spec().horizon]),
//!     ..PredictionInput::default()
//! };
//! let predictions = predict(&model, &[&input])?;
//! assert_eq!(predictions[0].frames.len(), model.spec().horizon);
//! # Ok(())
//! # }
//! ```
//!
//! What stands here is the interface that versions keep; `.ci/public-api.txt` lists it. The crates below, `foreframe-core`,
//! `foreframe-sim`, `foreframe-data`, `foreframe-train` and `foreframe-jobs`, one a layer, change as the program needs it.
#![deny(unsafe_code)]

pub use foreframe_core::error_kind::{ErrorKind, HasErrorKind};
pub use foreframe_core::frame::{Frame, FrameError};
pub use foreframe_core::nn::{
    Architecture, ArchitectureKind, ChannelScale, Conditioning, DenseSpec, FlowLayers, FlowSpec, ModelSpec, NnError,
    PredictorOutput, Reconstruction, SpriteSpec, TensorError,
};
pub use foreframe_core::registry::calibration::{
    Calibration, ContextStatistics, ExpectedError, NoveltyScale, StepErrors, ValueRange,
};
pub use foreframe_core::registry::{DatasetShare, DatasetStamp, Manifest, Model, ProgramStamp, RegistryError, load};
pub use foreframe_core::serving::session::{SessionSnapshot, SnapshotError};
pub use foreframe_core::serving::{
    InputError, Prediction, PredictionInput, Predictor, PredictorConfig, Rollout, ServingError, Session, Timing,
    predict,
};
pub use foreframe_core::types::{Action, Channel, ModelName, RobotState, Seed, ValueError};

/// Image files, resizing, and the measures of a prediction's error.
pub mod images {
    pub use foreframe_core::frame::codec::{decode, encode_png};
    pub use foreframe_core::frame::preprocess::Preprocess;
    pub use foreframe_core::frame::quality::{mse, psnr_db, ssim};
    pub use foreframe_core::frame::resize::{Resize, ResizeError, resize};
    pub use foreframe_core::frame::warp::CameraModel;
}

/// The simulated room: robots, physics and a camera.
#[cfg(feature = "sim")]
pub mod sim {
    pub use foreframe_sim::pid::Gains;
    pub use foreframe_sim::{
        CameraConfig, Environment, Look, Observation, PidGains, PlanarPose, RoomSet, Route, Scenario, SimError,
        StepResult, TrialParameters, TrialRoom, World, WorldConfig, action_channels, state_channels,
    };
}

/// Data sets: simulated, imported, opened, inspected and exported.
#[cfg(feature = "train")]
pub mod dataset {
    pub use foreframe_data::dataset::export::{to_lerobot_images, to_lerobot_videos, to_mcap, to_mp4};
    pub use foreframe_data::dataset::import::{
        ImportConfig, ImportError, ImportOptions, ImportProgress, Imported, SkippedItem, import,
    };
    pub use foreframe_data::dataset::{
        CollectConfig, CollectProgress, Dataset, DatasetError, DatasetInfo, DatasetPart, Episode, EpisodeData, Split,
        Splits, Window, WindowShape, collect,
    };
    pub use foreframe_data::inspection::{
        ActionDelay, ChannelRole, ChannelSummary, ExposureJump, FramePlace, FrameTiming, FrozenSpan, Histogram,
        ImageSummary, Inspection, LagCorrelation, MotionSignal, TimeGap, inspect, page,
    };
}

/// Training on a data set.
#[cfg(feature = "train")]
pub mod training {
    pub use foreframe_core::registry::{StoredWeights, load_weights};
    pub use foreframe_train::settings::{SettingsError, SettingsLayer};
    pub use foreframe_train::training::optimizer::OptimizerError;
    pub use foreframe_train::training::{
        Observer, TrainConfig, TrainError, Training, TrainingEvent, TrainingOutcome, TrainingStage, run,
    };
}

/// The scores of a model beside simple baselines.
#[cfg(feature = "train")]
pub mod evaluation {
    pub use foreframe_train::evaluation::actions::{ActionRow, ActionTable, Variant};
    pub use foreframe_train::evaluation::bootstrap::Interval;
    pub use foreframe_train::evaluation::method::Method;
    pub use foreframe_train::evaluation::metrics::{BenchmarkScores, MethodScores, StepCurve};
    pub use foreframe_train::evaluation::plans::{PlanIdentification, PlanOutcome};
    pub use foreframe_train::evaluation::report::{
        ModelSummary, ReportStamp, SampleWindow, SetOutcome, SetReport, SetScores,
    };
    pub use foreframe_train::evaluation::skill::Skill;
    pub use foreframe_train::evaluation::uncertainty::{NoveltyScores, UncertaintyScores};
    pub use foreframe_train::evaluation::{
        EvaluateConfig, EvaluationError, EvaluationProgress, EvaluationReport, EvaluationStage, ScoredSplit, calibrate,
        run,
    };
}

// The program and its tests: no promise to anyone else.
#[cfg(feature = "server")]
mod program;

#[cfg(feature = "server")]
#[doc(hidden)]
pub mod telemetry;

#[cfg(feature = "server")]
#[doc(hidden)]
pub mod server;

#[cfg(feature = "server")]
#[doc(hidden)]
pub mod config;

#[cfg(feature = "server")]
mod bridge;

#[cfg(feature = "server")]
#[doc(hidden)]
pub mod cli;
