//! The progress of an evaluation, and what each of its passes over windows needs.

use std::sync::atomic::Ordering;

use super::EvaluationError;
use super::config::EvaluateConfig;
use super::inference::Inference;
use foreframe_data::dataset::Window;
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
    /// Where movers are, and how far away things are.
    Surroundings,
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
            Self::Surroundings => "surroundings",
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

/// What every pass over windows of a data set needs besides them.
#[derive(Clone, Copy)]
pub(super) struct EvaluationContext<'a> {
    pub(super) inference: Inference<'a>,
    pub(super) split: Split,
    pub(super) config: &'a EvaluateConfig<'a>,
    pub(super) on_progress: &'a (dyn Fn(EvaluationProgress) + Sync),
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
        match self.config.cancelled {
            Some(cancelled) if cancelled.load(Ordering::Acquire) => Err(EvaluationError::Cancelled),
            _ => Ok(()),
        }
    }

    /// What `compute` gives for the windows, batch by batch. Errors: those of `compute`, `Cancelled`.
    pub(super) fn in_batches<T>(
        &self,
        stage: EvaluationStage,
        windows: &[Window],
        compute: impl Fn(&[Window]) -> Result<Vec<T>, EvaluationError>,
    ) -> Result<Vec<T>, EvaluationError> {
        let mut found = Vec::with_capacity(windows.len());
        for batch in windows.chunks(self.config.batch) {
            found.extend(compute(batch)?);
            self.report(stage, found.len(), windows.len())?;
        }
        Ok(found)
    }
}
