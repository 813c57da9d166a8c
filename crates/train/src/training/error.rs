//! Why a training could not start or stopped.

use std::path::PathBuf;

use super::observer::TrainingStage;
use super::optimizer::OptimizerError;
use crate::settings::SettingsError;
use foreframe_core::error_kind::{ErrorKind, HasErrorKind};
use foreframe_core::files::is_transient;
use foreframe_core::frame::FrameError;
use foreframe_core::nn::{Conditioning, NnError};
use foreframe_core::registry::RegistryError;
use foreframe_core::types::ModelName;
use foreframe_data::dataset::DatasetError;

/// Why a training could not start or stopped.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TrainError {
    /// No preset has this name.
    #[error("there is no preset {name:?}; there are: {}", known.join(", "))]
    UnknownPreset {
        /// The name that was given.
        name: String,
        /// The names of the presets.
        known: Vec<&'static str>,
    },
    /// A setting is unknown or out of range.
    #[error("{0}")]
    Config(String),
    /// The directory contains something else.
    #[error("{dir} exists and holds no training run; use a new directory", dir = .0.display())]
    NotARun(PathBuf),
    /// Another training is writing to the directory.
    #[error("another training is running in {}; wait until it ends or use another directory", .0.display())]
    Busy(PathBuf),
    /// The directory holds a run with another configuration or data set.
    #[error(
        "{} holds a run with another {what}; use the {what} of that run to resume it, or use a new directory",
        run_dir.display()
    )]
    OtherRun {
        /// The run's directory.
        run_dir: PathBuf,
        /// `configuration` or `data set`.
        what: &'static str,
    },
    /// The directory holds a run on the same frames and numbers, which were described otherwise.
    #[error(
        "{} holds a run on the data set {dataset:?} as it was before: its camera, channels, units, frame size or frame period has \
         changed; use a new directory, or import the data set as it was to resume the run",
        run_dir.display()
    )]
    OtherDescription {
        /// The run's directory.
        run_dir: PathBuf,
        /// The data set.
        dataset: String,
    },
    /// The model of a finished run is damaged.
    #[error(
        "the training in {} is complete, but its model is damaged: {source}; delete {}, and the same command makes the model again \
         from the run's checkpoint",
        run_dir.display(),
        model_dir.display()
    )]
    DamagedModel {
        /// The run's directory.
        run_dir: PathBuf,
        /// The model's directory.
        model_dir: PathBuf,
        /// What is wrong with it.
        source: RegistryError,
    },
    /// The training split or the validation split has no window.
    #[error(
        "the data set \"{dataset}\" has {train} training windows and {validation} validation windows of {frames} frames; training needs \
         at least 1 of each: collect 40 trials or more, or record longer without interruption"
    )]
    NoWindows {
        /// The data set's name.
        dataset: String,
        /// Windows of the training split.
        train: usize,
        /// Windows of the validation split.
        validation: usize,
        /// Frames of a window.
        frames: usize,
    },
    /// The model takes actions, but the data set has none that change.
    #[error(
        "data set \"{dataset}\" has {}; a model with conditioning \"{conditioning}\" learns nothing from them: use a preset \
         or a model for a standing camera, or model.conditioning=none{}",
        if *has_actions { "actions that never change (its camera stands still)" } else { "no actions" },
        if *has_actions { ", or allow it with data.constant_actions=true" } else { "" }
    )]
    ConstantActions {
        /// The data set's name.
        dataset: String,
        /// Whether it has actions at all.
        has_actions: bool,
        /// What the model takes.
        conditioning: Conditioning,
    },
    /// The loss or a gradient became NaN or infinite, or the loss became very large.
    #[error(
        "training diverged in {stage} at step {step}: {what}; the last checkpoint is from step {checkpoint_step}; \
         use a lower learning rate"
    )]
    Diverged {
        /// The stage.
        stage: TrainingStage,
        /// The update that failed.
        step: usize,
        /// The value of the loss or the gradient.
        what: String,
        /// The step of the last checkpoint.
        checkpoint_step: usize,
    },
    /// The weights to start from belong to another network.
    #[error(
        "the training cannot start from the model {model:?}: {source}; it needs the same frame size, layers and numbers of channels"
    )]
    OtherNetwork {
        /// The model.
        model: ModelName,
        /// The first difference.
        source: NnError,
    },
    /// The model to start from takes other units, or the same channels in another order.
    #[error(
        "the training cannot start from the model {model:?}: it takes the {kind} [{found}], and the data set has [{expected}]; \
         the units and the order of the channels must be the same"
    )]
    OtherUnits {
        /// The model.
        model: ModelName,
        /// `action` or `state`.
        kind: &'static str,
        /// What the model takes, with units.
        found: String,
        /// What the data set has, with units.
        expected: String,
    },
    /// A file of the run could not be read or written.
    #[error("could not {action} {}: {source}", path.display())]
    Io {
        /// `read` or `write`.
        action: &'static str,
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// The checkpoint is damaged.
    #[error("cannot resume from the checkpoint {}: {reason}; delete it to start again", path.display())]
    Checkpoint {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// The data set cannot be used.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    /// A frame is invalid.
    #[error(transparent)]
    Frame(#[from] FrameError),
    /// The network refused its input.
    #[error(transparent)]
    Network(#[from] NnError),
    /// An update failed.
    #[error(transparent)]
    Optimizer(#[from] OptimizerError),
    /// The model could not be published.
    #[error(transparent)]
    Registry(#[from] RegistryError),
}

impl HasErrorKind for TrainError {
    fn kind(&self) -> ErrorKind {
        if is_transient(self) {
            return ErrorKind::Away;
        }
        match self {
            Self::Dataset(error) => error.kind(),
            Self::Registry(error) => error.kind(),
            Self::Network(error) => error.kind(),
            Self::UnknownPreset { .. }
            | Self::Config(_)
            | Self::ConstantActions { .. }
            | Self::OtherUnits { .. }
            | Self::NoWindows { .. } => ErrorKind::Usage,
            Self::NotARun(_) | Self::OtherRun { .. } | Self::OtherDescription { .. } => ErrorKind::Conflict,
            Self::OtherNetwork { .. } | Self::Checkpoint { .. } | Self::DamagedModel { .. } | Self::Frame(_) => {
                ErrorKind::Unusable
            }
            Self::Busy(_) => ErrorKind::Busy,
            Self::Diverged { .. } | Self::Io { .. } | Self::Optimizer(_) => ErrorKind::Internal,
        }
    }
}

#[doc(hidden)]
impl From<candle_core::Error> for TrainError {
    fn from(error: candle_core::Error) -> Self {
        Self::Network(error.into())
    }
}

impl From<SettingsError> for TrainError {
    fn from(error: SettingsError) -> Self {
        Self::Config(error.to_string())
    }
}
