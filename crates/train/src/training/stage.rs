//! The training loop of both stages: draw a batch, compute gradients, update; validate and keep the best weights; write
//! checkpoints.

use std::f64::consts::PI;
use std::sync::atomic::{AtomicBool, Ordering};

use candle_core::Tensor;
use rayon::prelude::*;

use super::TrainError;
use super::checkpoint::RunFiles;
use super::config::TrainConfig;
use super::journal::{CompletedUpdate, CompletedValidation, Journal};
use super::observer::TrainingEvent;
use super::optimizer::{Gradients, OptimizerError};
use super::state::{HistoryPoint, TrainState};
use foreframe_core::frame::Frame;
use foreframe_core::nn::Parameters;

/// A larger loss counts as diverged, because pixels are in 0…1.
const MAX_LOSS: f64 = 1e3;

/// The objective of a stage.
pub(super) trait Objective: Sync {
    /// The loss of one part of a step's batch, as a scalar with gradients.
    fn loss(&self, parameters: &Parameters, step: usize, part: BatchPart) -> Result<Tensor, TrainError>;
    /// The mean squared error of the validation split against the target frames.
    fn validation_loss(&self, parameters: &Parameters) -> Result<f64, TrainError>;
    /// The true frames of a fixed validation window above the predicted ones; `None` if the stage predicts none.
    fn sample(&self, parameters: &Parameters) -> Result<Option<Frame>, TrainError>;
}

/// One of the equal parts of a batch, whose gradients are computed in parallel. Their number is a setting and not the number
/// of cores, so that the result has the same bits on every machine.
#[derive(Clone, Copy, Debug)]
pub(super) struct BatchPart {
    pub(super) index: usize,
    pub(super) count: usize,
}

impl BatchPart {
    /// This part of the batch's items.
    pub(super) fn of<T>(self, items: Vec<T>) -> Vec<T> {
        let size = items.len() / self.count;
        items.into_iter().skip(self.index * size).take(size).collect()
    }
}

/// How a stage ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum StageEnd {
    Done,
    Interrupted,
}

/// Runs the training loop of a stage.
pub(super) struct StageRunner<'a> {
    pub(super) files: &'a RunFiles,
    pub(super) config: &'a TrainConfig,
    pub(super) cancelled: &'a AtomicBool,
}

impl StageRunner<'_> {
    /// Runs until the last step of the state's stage or until cancelled, then writes a checkpoint. Errors: `Diverged`, and those
    /// of the objective; the last checkpoint stays on disk.
    pub(super) fn run(
        &self,
        objective: &dyn Objective,
        state: &mut TrainState,
        journal: &mut Journal<'_>,
    ) -> Result<StageEnd, TrainError> {
        let (stage, run) = (state.progress.stage, &self.config.run);
        let (steps, learning_rate) = self.config.stage(stage);
        let mut checkpoint_step = state.progress.step;
        while state.progress.step < steps {
            if self.cancelled.load(Ordering::Relaxed) {
                self.save(state, journal)?;
                return Ok(StageEnd::Interrupted);
            }
            let rate = learning_rate * self.schedule(state.progress.step, steps);
            let step = state.progress.step + 1;
            let diverged = |what| TrainError::Diverged {
                stage,
                step,
                what,
                checkpoint_step,
            };
            let loss = match self.update(objective, state, rate) {
                Ok(loss) if loss > MAX_LOSS => Err(diverged(format!("the loss is {loss:.1}, more than {MAX_LOSS}"))),
                Err(TrainError::Optimizer(OptimizerError::LossNotFinite { value })) => {
                    Err(diverged(format!("the loss is {value}")))
                }
                Err(TrainError::Optimizer(error @ OptimizerError::GradientNotFinite { .. })) => {
                    Err(diverged(error.to_string()))
                }
                updated => updated,
            }?;
            state.progress.step = step;
            let is_validated = step.is_multiple_of(run.validate_every_steps) || step == steps;
            journal.updated(CompletedUpdate {
                stage,
                step,
                steps,
                loss,
                learning_rate: rate,
                is_validated,
            })?;
            if is_validated {
                Self::validate(objective, state, loss, journal, &diverged)?;
            }
            if step.is_multiple_of(run.checkpoint_every_steps) || step == steps {
                self.save(state, journal)?;
                checkpoint_step = step;
            }
        }
        Ok(StageEnd::Done)
    }

    /// Computes one update and returns the batch's loss.
    fn update(&self, objective: &dyn Objective, state: &mut TrainState, rate: f64) -> Result<f64, TrainError> {
        let (parameters, step, count) = (&state.parameters, state.progress.step, self.config.run.batch_parts);
        let gradients = |index| -> Result<Gradients, TrainError> {
            let loss = objective.loss(parameters, step, BatchPart { index, count })?;
            Ok(Gradients::of(&loss, parameters)?)
        };
        let parts: Vec<_> = (0..count).into_par_iter().map(gradients).collect();
        // Of several errors, the first part's, so that it is the same in each run.
        let gradients = Gradients::mean(parts.into_iter().collect::<Result<_, _>>()?)?;
        state.optimizer.update(parameters, &gradients, rate)?;
        Ok(gradients.loss())
    }

    /// The learning rate as a share of its highest value: a linear rise, then half a cosine.
    fn schedule(&self, step: usize, steps: usize) -> f64 {
        let (step, steps, warmup) = (step as f64, steps as f64, self.config.run.warmup_steps as f64);
        if step < warmup {
            return (step + 1.0) / warmup;
        }
        let progress = (step - warmup) / (steps - warmup).max(1.0);
        let last = self.config.run.final_learning_rate;
        last + (1.0 - last) * 0.5 * (1.0 + (PI * progress).cos())
    }

    fn validate(
        objective: &dyn Objective,
        state: &mut TrainState,
        train_loss: f64,
        journal: &mut Journal<'_>,
        diverged: &dyn Fn(String) -> TrainError,
    ) -> Result<(), TrainError> {
        let progress = &mut state.progress;
        let (stage, step) = (progress.stage, progress.step);
        let loss = objective.validation_loss(&state.parameters)?;
        if !(0.0..=MAX_LOSS).contains(&loss) {
            return Err(diverged(format!(
                "the validation loss is {loss:.1}; it must be {MAX_LOSS} or less"
            )));
        }
        let is_best = progress.best_loss.is_none_or(|best| loss < best);
        if is_best {
            state.best = state.parameters.snapshot()?;
            (progress.best_step, progress.best_loss) = (step, Some(loss));
        }
        progress.history.push(HistoryPoint {
            stage,
            step,
            train_loss,
            validation_loss: loss,
        });
        let sample = objective.sample(&state.parameters)?;
        journal.validated(CompletedValidation {
            stage,
            step,
            loss,
            is_best,
            sample,
        })
    }

    /// Writes a checkpoint.
    pub(super) fn save(&self, state: &TrainState, journal: &mut Journal<'_>) -> Result<(), TrainError> {
        self.files.save(state)?;
        let (stage, step) = (state.progress.stage, state.progress.step);
        journal.event(TrainingEvent::Checkpointed { stage, step });
        Ok(())
    }
}
