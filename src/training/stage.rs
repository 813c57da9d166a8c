//! The loop that both stages share: draw, differentiate, update; validate and keep the best; write checkpoints.

use std::collections::BTreeMap;
use std::f64::consts::PI;
use std::sync::atomic::{AtomicBool, Ordering};

use candle_core::Tensor;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::TrainError;
use super::checkpoint::{Checkpoint, RunFiles};
use super::config::RunConfig;
use super::observer::{Observer, TrainingEvent, TrainingStage};
use super::optimizer::{Adam, Gradients, OptimizerError};
use crate::nn::Parameters;

/// Pixels lie in 0…1, so a loss above this is no prediction any more.
const MAX_LOSS: f64 = 1e3;

/// What a stage minimizes.
pub(super) trait Objective: Sync {
    /// Which of the two it is.
    fn stage(&self) -> TrainingStage;
    /// Updates to make.
    fn steps(&self) -> usize;
    /// Adam's learning rate at its highest.
    fn learning_rate(&self) -> f64;
    /// The loss of one part of the batch that belongs to a step, a scalar to differentiate.
    fn loss(&self, parameters: &Parameters, step: usize, part: BatchPart) -> Result<Tensor, TrainError>;
    /// The mean squared error of the validation split against the target frames.
    fn validation_loss(&self, parameters: &Parameters) -> Result<f64, TrainError>;
}

/// One of the equal parts of a batch, which are differentiated side by side. Their number is a setting, not the machine's
/// count of cores, so that the same bits come out everywhere.
#[derive(Clone, Copy, Debug)]
pub(super) struct BatchPart {
    pub(super) index: usize,
    pub(super) count: usize,
}

impl BatchPart {
    /// This part of the batch's items.
    pub(super) fn of(self, items: Vec<usize>) -> Vec<usize> {
        let size = items.len() / self.count;
        items.into_iter().skip(self.index * size).take(size).collect()
    }
}

/// A point of the loss curves.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct HistoryPoint {
    pub(super) stage: TrainingStage,
    pub(super) step: usize,
    pub(super) train_loss: f64,
    pub(super) validation_loss: f64,
}

/// Everything that the next step depends on.
pub(super) struct TrainState {
    pub(super) stage: TrainingStage,
    /// Updates made in the stage.
    pub(super) step: usize,
    pub(super) parameters: Parameters,
    pub(super) optimizer: Adam,
    /// The parameters of the lowest validation loss of the stage.
    pub(super) best: BTreeMap<String, Tensor>,
    pub(super) best_step: usize,
    pub(super) best_loss: Option<f64>,
    pub(super) history: Vec<HistoryPoint>,
}

impl TrainState {
    pub(super) fn new(parameters: Parameters, run: &RunConfig) -> Result<Self, TrainError> {
        let best = parameters.snapshot()?;
        Ok(Self {
            stage: TrainingStage::Pretrain,
            step: 0,
            parameters,
            optimizer: Adam::new(run.adam()),
            best,
            best_step: 0,
            best_loss: None,
            history: Vec::new(),
        })
    }

    /// Takes the best weights of this stage and starts the next with a fresh optimizer.
    pub(super) fn enter(&mut self, stage: TrainingStage, run: &RunConfig) -> Result<(), TrainError> {
        self.restore_best()?;
        self.stage = stage;
        self.step = 0;
        self.optimizer = Adam::new(run.adam());
        self.best_step = 0;
        self.best_loss = None;
        Ok(())
    }

    /// Sets the parameters to the best of this stage.
    pub(super) fn restore_best(&mut self) -> Result<(), TrainError> {
        self.parameters.restore(&self.best)?;
        Ok(())
    }
}

/// Whether a stage came to its end.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum StageEnd {
    Done,
    Interrupted,
}

/// Runs stages.
pub(super) struct StageRunner<'a> {
    pub(super) files: &'a RunFiles,
    pub(super) run: &'a RunConfig,
    pub(super) cancelled: &'a AtomicBool,
}

impl StageRunner<'_> {
    /// Updates until the stage's last step, or until cancelled; the state is then on disk. Errors: `Diverged` with the last
    /// checkpoint kept, and those of the objective.
    pub(super) fn run(
        &self,
        objective: &dyn Objective,
        state: &mut TrainState,
        observer: &mut dyn Observer,
    ) -> Result<StageEnd, TrainError> {
        let (stage, steps) = (objective.stage(), objective.steps());
        let mut saved_step = state.step;
        while state.step < steps {
            if self.cancelled.load(Ordering::Relaxed) {
                self.save(state, observer)?;
                return Ok(StageEnd::Interrupted);
            }
            let loss = self.update(objective, state, saved_step)?;
            state.step += 1;
            let step = state.step;
            observer.on_event(TrainingEvent::Step {
                stage,
                step,
                steps,
                loss,
            });
            if step.is_multiple_of(self.run.validate_every_steps) || step == steps {
                Self::validate(objective, state, loss, observer)?;
            }
            if step.is_multiple_of(self.run.checkpoint_every_steps) || step == steps {
                self.save(state, observer)?;
                saved_step = step;
            }
        }
        Ok(StageEnd::Done)
    }

    /// One update; returns the batch's loss.
    fn update(&self, objective: &dyn Objective, state: &mut TrainState, kept: usize) -> Result<f64, TrainError> {
        let step = state.step;
        let diverged = |what| TrainError::Diverged {
            stage: objective.stage(),
            step: step + 1,
            what,
            kept,
        };
        let parameters = &state.parameters;
        let part = |index| -> Result<Result<Gradients, OptimizerError>, TrainError> {
            let loss = objective.loss(
                parameters,
                step,
                BatchPart {
                    index,
                    count: self.run.batch_parts,
                },
            )?;
            Ok(Gradients::of(&loss, parameters, &[]))
        };
        let parts = (0..self.run.batch_parts)
            .into_par_iter()
            .map(part)
            .collect::<Result<Vec<_>, _>>()?;
        let rate = objective.learning_rate() * self.schedule(step, objective.steps());
        let updated = parts
            .into_iter()
            .collect::<Result<_, _>>()
            .and_then(Gradients::mean)
            .and_then(|gradients| {
                state.optimizer.update(&state.parameters, &gradients, rate)?;
                Ok(gradients.loss())
            });
        match updated {
            Ok(loss) if loss > MAX_LOSS => Err(diverged(format!("the loss is {loss:.1}, over {MAX_LOSS}"))),
            Ok(loss) => Ok(loss),
            Err(OptimizerError::LossNotFinite { value }) => Err(diverged(format!("the loss is {value}"))),
            Err(error @ OptimizerError::GradientNotFinite { .. }) => Err(diverged(error.to_string())),
            Err(other) => Err(TrainError::Optimizer(other)),
        }
    }

    /// The learning rate's share of its highest: a linear rise, then half a cosine.
    fn schedule(&self, step: usize, steps: usize) -> f64 {
        let (step, steps, warmup) = (step as f64, steps as f64, self.run.warmup_steps as f64);
        if step < warmup {
            return (step + 1.0) / warmup;
        }
        let progress = (step - warmup) / (steps - warmup).max(1.0);
        let last = self.run.final_learning_rate;
        last + (1.0 - last) * 0.5 * (1.0 + (PI * progress).cos())
    }

    fn validate(
        objective: &dyn Objective,
        state: &mut TrainState,
        train_loss: f64,
        observer: &mut dyn Observer,
    ) -> Result<(), TrainError> {
        let (stage, step) = (objective.stage(), state.step);
        let loss = objective.validation_loss(&state.parameters)?;
        let is_best = state.best_loss.is_none_or(|best| loss < best);
        if is_best {
            state.best = state.parameters.snapshot()?;
            state.best_step = step;
            state.best_loss = Some(loss);
        }
        state.history.push(HistoryPoint {
            stage,
            step,
            train_loss,
            validation_loss: loss,
        });
        observer.on_event(TrainingEvent::Validated {
            stage,
            step,
            loss,
            is_best,
        });
        Ok(())
    }

    /// Writes the state to disk.
    pub(super) fn save(&self, state: &TrainState, observer: &mut dyn Observer) -> Result<(), TrainError> {
        Checkpoint::save(self.files, state)?;
        observer.on_event(TrainingEvent::Checkpointed {
            stage: state.stage,
            step: state.step,
        });
        Ok(())
    }
}
