//! The training state: what a checkpoint holds.

use std::collections::BTreeMap;

use candle_core::Tensor;
use serde::{Deserialize, Serialize};

use super::TrainError;
use super::config::RunConfig;
use super::observer::TrainingStage;
use super::optimizer::Optimizer;
use foreframe_core::nn::Parameters;

/// One point of the loss curves.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct HistoryPoint {
    pub(super) stage: TrainingStage,
    pub(super) step: usize,
    pub(super) train_loss: f64,
    pub(super) validation_loss: f64,
}

/// How far a training is, and what it has measured.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct TrainProgress {
    pub(super) stage: TrainingStage,
    /// Number of completed updates of the stage.
    pub(super) step: usize,
    pub(super) best_step: usize,
    pub(super) best_loss: Option<f64>,
    pub(super) history: Vec<HistoryPoint>,
}

/// The training state: everything that the next step depends on.
pub(super) struct TrainState {
    pub(super) progress: TrainProgress,
    pub(super) parameters: Parameters,
    pub(super) optimizer: Optimizer,
    /// The parameters with the lowest validation loss of the stage.
    pub(super) best: BTreeMap<String, Tensor>,
}

impl TrainState {
    pub(super) fn new(parameters: Parameters, run: &RunConfig) -> Result<Self, TrainError> {
        let best = parameters.snapshot()?;
        Ok(Self {
            progress: TrainProgress {
                stage: TrainingStage::Pretrain,
                step: 0,
                best_step: 0,
                best_loss: None,
                history: Vec::new(),
            },
            parameters,
            optimizer: Optimizer::new(run.optimizer()),
            best,
        })
    }

    /// Restores the best weights of the first stage and starts sequence training with a new optimizer.
    pub(super) fn start_sequence(&mut self, run: &RunConfig) -> Result<(), TrainError> {
        self.restore_best()?;
        self.optimizer = Optimizer::new(run.optimizer());
        self.progress = TrainProgress {
            stage: TrainingStage::Sequence,
            step: 0,
            best_step: 0,
            best_loss: None,
            history: std::mem::take(&mut self.progress.history),
        };
        Ok(())
    }

    /// Sets the parameters to the best weights of this stage.
    pub(super) fn restore_best(&mut self) -> Result<(), TrainError> {
        Ok(self.parameters.restore(&self.best)?)
    }
}
