//! The progress of an evaluation, and what each of its passes over a set needs to report it.

use std::sync::atomic::{AtomicBool, Ordering};

use super::EvaluationError;
use super::bootstrap::Bootstrap;
use foreframe_data::dataset::sampler::Split;

/// What is being computed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum EvaluationStage {
    /// Model and baselines, frame by frame.
    Scores,
    /// The action table.
    Actions,
    /// Plan identification.
    Plans,
    /// Expected errors and novelty.
    Calibration,
}

impl EvaluationStage {
    /// The stage in a word.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Scores => "scores",
            Self::Actions => "actions",
            Self::Plans => "plans",
            Self::Calibration => "calibration",
        }
    }
}

/// Progress of the evaluation.
#[derive(Clone, Copy, Debug)]
pub struct EvaluationProgress {
    /// The set.
    pub split: Split,
    /// What is being computed.
    pub stage: EvaluationStage,
    /// Windows done.
    pub done: usize,
    /// Windows in all.
    pub total: usize,
}

/// What every pass over a set needs besides its windows.
pub struct EvaluationContext<'a> {
    pub(super) split: Split,
    pub(super) batch: usize,
    pub(super) bootstrap: Bootstrap,
    pub(super) on_progress: &'a (dyn Fn(EvaluationProgress) + Sync),
    pub(super) cancelled: Option<&'a AtomicBool>,
}

impl EvaluationContext<'_> {
    /// Reports progress. Errors: `Cancelled` if the evaluation is to stop.
    pub(super) fn report(&self, stage: EvaluationStage, done: usize, total: usize) -> Result<(), EvaluationError> {
        (self.on_progress)(EvaluationProgress {
            split: self.split,
            stage,
            done,
            total,
        });
        match self.cancelled {
            Some(cancelled) if cancelled.load(Ordering::Acquire) => Err(EvaluationError::Cancelled),
            _ => Ok(()),
        }
    }
}
