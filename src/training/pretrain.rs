//! Stage 1: the dense encoder and the reconstruction layer as an autoencoder of single frames.

use candle_core::Tensor;

use super::batches::Shuffle;
use super::config::TrainConfig;
use super::observer::TrainingStage;
use super::stage::{BatchPart, Objective};
use super::{TrainError, TrainingPlan, window_frames};
use crate::nn::loss::Loss;
use crate::nn::{Model, Parameters};

/// How many frames of the validation windows choose the best codec, at most.
const MAX_VALIDATION_FRAMES: usize = 1024;

/// The codec's reconstruction error.
pub(super) struct CodecObjective<'a> {
    plan: &'a TrainingPlan<'a>,
    config: &'a TrainConfig,
    frames: Vec<usize>,
    shuffle: Shuffle,
    /// Frames of the validation windows as they are read, and as they are to be written.
    validation: [Tensor; 2],
}

impl<'a> CodecObjective<'a> {
    pub(super) fn new(plan: &'a TrainingPlan<'a>, config: &'a TrainConfig) -> Result<Self, TrainError> {
        let length = config.model.context + config.model.horizon;
        let frames = window_frames(&plan.train, length);
        let validation = window_frames(&plan.validation, length);
        let stride = validation.len().div_ceil(MAX_VALIDATION_FRAMES).max(1);
        let validation: Vec<usize> = validation.into_iter().step_by(stride).collect();
        Ok(Self {
            plan,
            config,
            shuffle: Shuffle::new(frames.len(), config.seed.derive("pretrain", 0)),
            frames,
            validation: [plan.source.frames(&validation)?, plan.source.targets(&validation)?],
        })
    }

    fn reconstruct(&self, parameters: &Parameters, frames: &Tensor) -> Result<Tensor, TrainError> {
        let model = Model::new(self.plan.spec.clone(), parameters)?;
        Ok(model.decode_frames(&model.encode_frames(frames)?)?)
    }
}

impl Objective for CodecObjective<'_> {
    fn stage(&self) -> TrainingStage {
        TrainingStage::Pretrain
    }

    fn steps(&self) -> usize {
        self.config.pretrain.steps
    }

    fn learning_rate(&self) -> f64 {
        self.config.pretrain.learning_rate
    }

    fn loss(&self, parameters: &Parameters, step: usize, part: BatchPart) -> Result<Tensor, TrainError> {
        let batch = part.of(self.shuffle.batch(step, self.config.pretrain.batch_size));
        let batch: Vec<usize> = batch.into_iter().map(|position| self.frames[position]).collect();
        let frames = self.plan.source.frames(&batch)?;
        Ok(self
            .config
            .fit
            .loss
            .between(&self.reconstruct(parameters, &frames)?, &frames)?)
    }

    fn validation_loss(&self, parameters: &Parameters) -> Result<f64, TrainError> {
        let [frames, targets] = &self.validation;
        let loss = Loss::Mse.between(&self.reconstruct(parameters, frames)?, targets)?;
        Ok(f64::from(loss.to_scalar::<f32>()?))
    }
}
