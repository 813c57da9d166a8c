//! The progress of an evaluation, and what each of its passes over windows needs.

use std::sync::atomic::Ordering;

use serde::Serialize;
use serde::de::DeserializeOwned;

use super::EvaluationError;
use super::config::EvaluateConfig;
use super::division::Division;
use super::inference::Inference;
use foreframe_core::named_enum;
use foreframe_data::dataset::Window;
use foreframe_data::dataset::sampler::Split;

named_enum! {
    /// What is being computed.
    pub enum EvaluationStage {
        /// Model and baselines, frame by frame.
        Scores = "scores",
        /// The action table.
        Actions = "actions",
        /// Plan identification.
        Plans = "plans",
        /// Which plan would be chosen.
        Ranking = "ranking",
        /// Where movers are.
        Surroundings = "surroundings",
        /// How far away things are.
        Depth = "depth",
        /// Errors by what a pixel shows.
        #[doc(hidden)]
        Visibility = "visibility",
        /// Expected errors and novelty.
        Calibration = "calibration",
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

/// A pass over the windows of a set.
#[derive(Clone, Copy)]
pub(super) struct Pass {
    pub(super) stage: EvaluationStage,
    /// Which pass of its stage, from 0.
    pub(super) number: usize,
    /// How many passes its stage has.
    pub(super) count: usize,
    /// Windows that are computed together.
    pub(super) batch: usize,
}

/// What every pass over windows of a data set needs besides them.
#[derive(Clone, Copy)]
pub(super) struct EvaluationContext<'a> {
    pub(super) inference: Inference<'a>,
    pub(super) split: Split,
    pub(super) config: &'a EvaluateConfig<'a>,
    pub(super) division: &'a Division<'a>,
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

    /// A stage of one pass.
    pub(super) fn pass(&self, stage: EvaluationStage) -> Pass {
        Pass {
            stage,
            number: 0,
            count: 1,
            batch: self.config.batch,
        }
    }

    /// As [`Self::in_batches`], but what a part has saved is read, and a part computes and gives only the batches of its share.
    /// `compute` takes a batch of `items`, and may give any number of results for it. Errors: those of `compute`, `Cancelled`,
    /// `Io` where the results of a part cannot be saved.
    pub(super) fn in_divided_batches<I, T: Serialize + DeserializeOwned>(
        &self,
        pass: Pass,
        items: &[I],
        compute: impl Fn(&[I]) -> Result<Vec<T>, EvaluationError>,
    ) -> Result<Vec<T>, EvaluationError> {
        let batches: Vec<&[I]> = items.chunks(pass.batch).collect();
        let share = self.division.share(batches.len());
        let file = format!("{}-{}-{}", self.split, pass.stage.name(), pass.number);
        let mut saved = self.division.saved::<T>(&file);
        let total: usize = batches[share.clone()].iter().map(|batch| batch.len()).sum();
        let (mut found, mut done, mut is_new) = (Vec::with_capacity(share.len()), 0, false);
        for index in share.clone() {
            found.push(if let Some(results) = saved.remove(&index) {
                results
            } else {
                is_new = true;
                compute(batches[index])?
            });
            if is_new && found.len() == share.len() {
                self.division.save(&file, share.start, &found)?;
            }
            done += batches[index].len();
            self.report(pass.stage, pass.number * total + done, pass.count * total)?;
        }
        Ok(found.into_iter().flatten().collect())
    }
}
