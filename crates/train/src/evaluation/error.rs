//! Why an evaluation was refused or stopped.

use std::path::PathBuf;

use crate::frame_marks::FramesOfTraining;
use foreframe_core::error_kind::{ErrorKind, HasErrorKind};
use foreframe_core::files::is_transient;
use foreframe_core::frame::FrameError;
use foreframe_core::nn::NnError;
use foreframe_core::registry::RegistryError;
use foreframe_core::types::{ModelName, ValueError};
use foreframe_data::dataset::DatasetError;
use foreframe_sim::SimError;

/// What was wrong, and what would be right.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum EvaluationError {
    /// The model was trained on the data set that is to be scored as a whole.
    #[error(
        "model \"{model}\" was trained on data set \"{dataset}\", so not all of it can test the model; score its test split"
    )]
    TrainedOn {
        /// The model's name.
        model: ModelName,
        /// The data set's name.
        dataset: String,
    },
    /// Frames of the data set that is to be scored as a whole were in the model's training.
    #[error(
        "{} of {} sampled frames of data set \"{dataset}\" were in the training of model \"{model}\", so not all of it can test the \
         model; score data that the training never had",
        frames.seen,
        frames.sampled
    )]
    #[doc(hidden)]
    TrainedOnFrames {
        /// The model's name.
        model: ModelName,
        /// The data set's name.
        dataset: String,
        /// How many.
        frames: FramesOfTraining,
    },
    /// The model has scores of another data set, which would be replaced.
    #[error(
        "model \"{model}\" has scores \"{set}\" of another data set; those on data set \"{dataset}\" would replace them; leave out \
         --save-scores"
    )]
    #[doc(hidden)]
    OtherScores {
        /// The model's name.
        model: ModelName,
        /// The name of the set.
        set: &'static str,
        /// The data set's name.
        dataset: String,
    },
    /// The model takes other frames, another frame period, or other actions or states.
    #[error("data set \"{dataset}\" has {found}; model \"{model}\" {wanted}")]
    Mismatch {
        /// The data set's name.
        dataset: String,
        /// What it has.
        found: String,
        /// The model's name.
        model: ModelName,
        /// What it takes or predicts.
        wanted: String,
    },
    /// The model was trained on a recording that should tell how it does on what it never saw.
    #[error(
        "model \"{model}\" was trained on data set \"{dataset}\"; only a recording that it never saw tells how wide its bands must be"
    )]
    Seen {
        /// The model's name.
        model: ModelName,
        /// The data set's name.
        dataset: String,
    },
    /// Another split would test on what the model was trained on.
    #[error(
        "model \"{model}\" was trained on this data set with split seed {trained}; split seed {given} would test it on frames it was trained on"
    )]
    SplitSeed {
        /// The model's name.
        model: ModelName,
        /// The seed of its training's split.
        trained: u64,
        /// The seed asked for.
        given: u64,
    },
    /// The twin can't be compared with the model.
    #[error("twin \"{twin}\" has {found}; to be compared with model \"{model}\" it needs {wanted}")]
    Twin {
        /// The twin's name.
        twin: ModelName,
        /// What it has.
        found: String,
        /// The model's name.
        model: ModelName,
        /// What it needs.
        wanted: String,
    },
    /// A setting is out of range.
    #[error("{setting} is {value}; it must be at least {least}")]
    Setting {
        /// The setting.
        setting: &'static str,
        /// Its value.
        value: usize,
        /// The least accepted.
        least: usize,
    },
    /// There is nothing to test on.
    #[error("data set \"{dataset}\" has no held-out trials with split seed {split_seed}; collect at least ten trials")]
    NothingHeldOut {
        /// The data set's name.
        dataset: String,
        /// The split's seed.
        split_seed: u64,
    },
    /// A prediction was NaN or infinite.
    #[error(
        "model \"{model}\" predicted a value that is not a finite number for the window at frame {frame}; its weights are not usable"
    )]
    NotFinite {
        /// The model's name.
        model: ModelName,
        /// First frame of the window.
        frame: usize,
    },
    /// The model has no calibration, which the comparison needs.
    #[error("model \"{model}\" is not calibrated, so it has no novelty; run `foreframe calibrate` first")]
    NotCalibrated {
        /// The model's name.
        model: ModelName,
    },
    /// No recording is as long as the model's context.
    #[error("data set \"{dataset}\" has no recording of {context} frames or more, which the model's context takes")]
    NoContext {
        /// The data set's name.
        dataset: String,
        /// Frames of the context.
        context: usize,
    },
    /// Another thread stopped it.
    #[error("the evaluation was cancelled")]
    Cancelled,
    /// The output directory is not empty, or is a file.
    #[error("{} exists and is not an empty directory; name a new one", .0.display())]
    OutputExists(PathBuf),
    /// A file could not be written.
    #[error("could not write {}: {source}", path.display())]
    Io {
        /// The file or directory.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// A chart could not be drawn.
    #[error("could not draw {file}: {reason}")]
    Chart {
        /// The chart's file.
        file: String,
        /// The drawing library's reason.
        reason: String,
    },
    /// The data set is not usable.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    /// A frame is not usable.
    #[error(transparent)]
    Frame(#[from] FrameError),
    /// The simulator refused to replay a trial.
    #[error("could not replay a trial of the data set: {0}")]
    Replay(#[from] SimError),
    /// An action of the data set is no action.
    #[error(transparent)]
    Action(ValueError),
    /// The model's files are not usable.
    #[error(transparent)]
    Registry(#[from] RegistryError),
    /// The network refused its input.
    #[error(transparent)]
    Network(#[from] NnError),
}

impl HasErrorKind for EvaluationError {
    fn kind(&self) -> ErrorKind {
        if is_transient(self) {
            return ErrorKind::Away;
        }
        match self {
            Self::Dataset(error) => error.kind(),
            Self::Registry(error) => error.kind(),
            Self::Mismatch { .. }
            | Self::SplitSeed { .. }
            | Self::Twin { .. }
            | Self::Setting { .. }
            | Self::NothingHeldOut { .. }
            | Self::NotCalibrated { .. }
            | Self::Seen { .. }
            | Self::OtherScores { .. }
            | Self::NoContext { .. } => ErrorKind::Usage,
            Self::OutputExists(_) => ErrorKind::Conflict,
            Self::TrainedOn { .. }
            | Self::TrainedOnFrames { .. }
            | Self::NotFinite { .. }
            | Self::Frame(_)
            | Self::Replay(_)
            | Self::Action(_) => ErrorKind::Unusable,
            Self::Cancelled => ErrorKind::Cancelled,
            Self::Io { .. } | Self::Chart { .. } | Self::Network(_) => ErrorKind::Internal,
        }
    }
}

#[doc(hidden)]
impl From<candle_core::Error> for EvaluationError {
    fn from(error: candle_core::Error) -> Self {
        Self::Network(error.into())
    }
}
