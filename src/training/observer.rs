//! What a training tells whoever watches.

use serde::{Deserialize, Serialize};

/// The two stages of a training.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[cfg_attr(feature = "server", derive(utoipa::ToSchema))]
#[serde(rename_all = "lowercase")]
pub enum TrainingStage {
    /// The dense codec alone.
    Pretrain,
    /// The recurrent network.
    Fit,
}

impl std::fmt::Display for TrainingStage {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.write_str(match self {
            Self::Pretrain => "pretrain",
            Self::Fit => "fit",
        })
    }
}

/// Something that happened.
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub enum TrainingEvent {
    /// The run starts, or goes on, here.
    Started {
        /// In this stage.
        stage: TrainingStage,
        /// After so many updates of it.
        step: usize,
        /// Training windows there are.
        windows: usize,
    },
    /// A validation of an earlier call, as the checkpoint recalls it; told before `Started` where a run goes on.
    Recalled {
        /// In this stage.
        stage: TrainingStage,
        /// After so many updates.
        step: usize,
        /// The loss of that update's batch.
        train_loss: f64,
        /// The mean squared error on the validation windows.
        validation_loss: f64,
    },
    /// An update was made.
    Step {
        /// In this stage.
        stage: TrainingStage,
        /// Updates made, this one included.
        step: usize,
        /// Updates to make.
        steps: usize,
        /// The loss of its batch.
        loss: f64,
    },
    /// The validation windows were predicted.
    Validated {
        /// In this stage.
        stage: TrainingStage,
        /// After so many updates.
        step: usize,
        /// Their mean squared error against the target frames.
        loss: f64,
        /// Whether it is the lowest so far, whose weights are kept.
        is_best: bool,
    },
    /// The state was written to disk.
    Checkpointed {
        /// In this stage.
        stage: TrainingStage,
        /// After so many updates.
        step: usize,
    },
}

/// Whoever watches a training.
pub trait Observer {
    /// Is told of each event on the training's thread; a slow answer slows the training.
    fn on_event(&mut self, event: TrainingEvent);
}

impl<F: FnMut(TrainingEvent)> Observer for F {
    fn on_event(&mut self, event: TrainingEvent) {
        self(event);
    }
}
