//! Events of a training, for progress displays and reports.

use foreframe_core::named_enum;
use serde::{Deserialize, Serialize};

named_enum! {
    /// The two stages of a training.
    #[derive(PartialOrd, Ord, Serialize, Deserialize)]
    #[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
    #[serde(rename_all = "lowercase")]
    pub enum TrainingStage {
        /// Stage 1, pre-training: the dense codec alone.
        Pretrain = "pretrain",
        /// Stage 2, sequence training: the recurrent network.
        Sequence = "sequence",
    }
}

/// An event of a training.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum TrainingEvent {
    /// The training starts or resumes.
    Started {
        /// The stage.
        stage: TrainingStage,
        /// After this number of updates of the stage.
        step: usize,
        /// Number of training windows.
        windows: usize,
    },
    /// A validation result of an earlier call, restored from the checkpoint. Sent before `Started` if a training resumes.
    Restored {
        /// The stage.
        stage: TrainingStage,
        /// After this number of updates.
        step: usize,
        /// The loss of that update's batch.
        train_loss: f64,
        /// The mean squared error on the validation windows.
        validation_loss: f64,
    },
    /// An update was completed.
    Step {
        /// The stage.
        stage: TrainingStage,
        /// Number of completed updates, including this one.
        step: usize,
        /// Number of updates of the stage.
        steps: usize,
        /// The loss of the update's batch.
        loss: f64,
    },
    /// A validation was completed.
    Validated {
        /// The stage.
        stage: TrainingStage,
        /// After this number of updates.
        step: usize,
        /// The mean squared error against the target frames.
        loss: f64,
        /// Whether this is the lowest error so far, so that these weights are kept.
        is_best: bool,
    },
    /// A checkpoint is damaged and is not used.
    CheckpointDamaged {
        /// Whether it is the one before the latest; then the training starts from the beginning.
        is_previous: bool,
    },
    /// A checkpoint was written.
    Checkpointed {
        /// The stage.
        stage: TrainingStage,
        /// After this number of updates.
        step: usize,
    },
}

/// Receives the events of a training.
pub trait Observer {
    /// Called for each event on the training's thread; a slow implementation slows down the training.
    fn on_event(&mut self, event: TrainingEvent);
}

impl<F: FnMut(TrainingEvent)> Observer for F {
    fn on_event(&mut self, event: TrainingEvent) {
        self(event);
    }
}
