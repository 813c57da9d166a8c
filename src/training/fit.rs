//! Stage 2, sequence training: trains the encoder together with its two decoders, for prediction and for reconstruction.

use candle_core::Tensor;

use super::batches::Shuffle;
use super::config::{CodecTraining, TrainConfig, TrainingFeedback};
use super::observer::TrainingStage;
use super::stage::{BatchPart, Objective};
use super::{TrainError, TrainingPlan};
use crate::dataset::Window;
use crate::nn::loss::Loss;
use crate::nn::{Feedback, Model, Parameters};

/// Prefix of the names of the codec's tensors.
const CODEC_PREFIX: &str = "frame_";
/// Validation windows per batch.
const VALIDATION_BATCH_SIZE: usize = 64;

/// The loss of prediction and reconstruction.
pub(super) struct SequenceObjective<'a> {
    plan: &'a TrainingPlan<'a>,
    config: &'a TrainConfig,
    shuffle: Shuffle,
}

impl<'a> SequenceObjective<'a> {
    pub(super) fn new(plan: &'a TrainingPlan<'a>, config: &'a TrainConfig) -> Self {
        Self {
            plan,
            config,
            shuffle: Shuffle::new(plan.train.len(), config.seed.derive("fit", 0)),
        }
    }

    fn is_frozen(&self) -> bool {
        self.config.fit.codec == CodecTraining::Frozen
    }

    /// Encodes frames `[B, T, P]` to features `[B, T, F]`.
    fn features(&self, model: &Model, frames: &Tensor) -> Result<Tensor, TrainError> {
        let (batch, time, pixels) = frames.dims3()?;
        let features = model.encode_frames(&frames.reshape((batch * time, pixels))?)?;
        Ok(features.reshape((batch, time, self.plan.spec.features))?)
    }

    /// Decodes features `[B, T, F]` to frames `[B, T, P]`.
    fn frames(model: &Model, features: &Tensor) -> Result<Tensor, TrainError> {
        let (batch, time, width) = features.dims3()?;
        let frames = model.decode_frames(&features.reshape((batch * time, width))?)?;
        Ok(frames.reshape((batch, time, ()))?)
    }
}

impl Objective for SequenceObjective<'_> {
    fn stage(&self) -> TrainingStage {
        TrainingStage::Fit
    }

    fn steps(&self) -> usize {
        self.config.fit.steps
    }

    fn learning_rate(&self) -> f64 {
        self.config.fit.learning_rate
    }

    fn loss(&self, parameters: &Parameters, step: usize, part: BatchPart) -> Result<Tensor, TrainError> {
        let fit = &self.config.fit;
        let drawn = part.of(self.shuffle.batch(step, fit.batch_size));
        let windows: Vec<&Window> = drawn.into_iter().map(|position| &self.plan.train[position]).collect();
        let is_teacher_forced = fit.feedback == TrainingFeedback::TeacherForcing;
        let batch = self
            .plan
            .source
            .windows(&windows, self.config.window_shape(), is_teacher_forced)?;
        let frozen: &[&str] = if self.is_frozen() { &[CODEC_PREFIX] } else { &[] };
        let model = Model::with_frozen(self.plan.spec.clone(), parameters, frozen)?;
        let inputs = self.features(&model, &batch.inputs)?;
        let true_features = batch
            .future
            .as_ref()
            .map(|future| self.features(&model, future))
            .transpose()?;
        let feedback = true_features
            .as_ref()
            .map_or(Feedback::Prediction, Feedback::TeacherForcing);
        let predicted = model.predict(&inputs, &batch.condition, feedback)?;
        let loss = fit.loss.between(&Self::frames(&model, &predicted)?, &batch.targets)?;
        if fit.reconstruction_weight == 0.0 {
            return Ok(loss);
        }
        let reconstructed = Self::frames(&model, &model.reconstruct(&inputs)?)?;
        let reconstruction = fit.loss.between(&reconstructed, &batch.input_targets)?;
        Ok((loss + (reconstruction * fit.reconstruction_weight)?)?)
    }

    fn validation_loss(&self, parameters: &Parameters) -> Result<f64, TrainError> {
        let model = Model::new(self.plan.spec.clone(), parameters)?;
        let windows: Vec<&Window> = self.plan.validation.iter().collect();
        let mut sum = 0.0;
        for chunk in windows.chunks(VALIDATION_BATCH_SIZE) {
            let batch = self.plan.source.windows(chunk, self.config.window_shape(), false)?;
            let predicted = model.predict_frames(&batch.inputs, &batch.condition)?;
            let loss = Loss::Mse.between(&predicted, &batch.targets)?.to_scalar::<f32>()?;
            sum += f64::from(loss) * chunk.len() as f64;
        }
        Ok(sum / windows.len().max(1) as f64)
    }
}
