//! Stage 2, sequence training: trains the encoder together with its two decoders, for prediction and for reconstruction.

use candle_core::Tensor;

use super::TrainError;
use super::batches::{DrawnWindow, WindowBatch};
use super::config::{CodecTraining, TrainConfig, TrainingFeedback};
use super::plan::{MixturePart, TrainingPlan};
use super::sample::{liveliest, side_by_side};
use super::shuffle::Shuffle;
use super::stage::{BatchPart, Objective};
use foreframe_core::frame::Frame;
use foreframe_core::nn::loss::Loss;
use foreframe_core::nn::mask_loss::mask_loss;
use foreframe_core::nn::sprites::motion_loss;
use foreframe_core::nn::ssim_loss::ssim_loss;
use foreframe_core::nn::{Feedback, Network, NnError, Parameters};

/// Prefix of the names of the codec's tensors.
const CODEC_PREFIX: &str = "frame_";
/// The name of the random numbers that shuffle the windows. Another name would give other weights from the same seed.
const SHUFFLE: &str = "fit";
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
            shuffle: Shuffle::mixed(&plan.drawn_parts(), config.seed.derive(SHUFFLE, 0)),
        }
    }

    fn is_frozen(&self) -> bool {
        self.config.sequence.codec == CodecTraining::Frozen
    }

    /// Encodes frames `[B, T, P]` to features `[B, T, F]`.
    fn features(&self, model: &Network, frames: &Tensor) -> Result<Tensor, TrainError> {
        let (batch, time, pixels) = frames.dims3()?;
        let features = model.encode_frames(&frames.reshape((batch * time, pixels))?)?;
        Ok(features.reshape((batch, time, self.plan.spec.code_len()))?)
    }

    /// The loss of predicted frames `[B, T, P]`, with that of their similarity.
    fn frames_loss(&self, predicted: &Tensor, targets: &Tensor) -> Result<Tensor, TrainError> {
        let sequence = &self.config.sequence;
        let loss = sequence.loss.between(predicted, targets)?;
        if sequence.ssim_weight == 0.0 {
            return Ok(loss);
        }
        let width = self.plan.spec.frame_width_px as usize;
        let similarity = ssim_loss(predicted, targets, width)?;
        Ok((loss + (similarity * sequence.ssim_weight)?)?)
    }

    /// The flow network's loss: of the frames, of the scene alone, and of the camera's motion where poses are measured.
    /// In the frame and SSIM losses, only the first `counting` frames count.
    fn flow_loss(&self, model: &Network, batch: &WindowBatch, counting: usize) -> Result<Tensor, TrainError> {
        let sequence = &self.config.sequence;
        let Some(predicted) = model.predict_flow(&batch.inputs, &batch.condition, counting)? else {
            return Err(TrainError::Config("only the flow network has this loss".to_owned()));
        };
        let targets = batch.targets.narrow(1, 0, counting)?.contiguous()?;
        let mut loss = self.frames_loss(&predicted.frames, &targets)?;
        if let Some(scene) = predicted.scene.filter(|_| sequence.scene_weight > 0.0) {
            let truth = batch.targets.narrow(1, 0, scene.dim(1)?)?.contiguous()?;
            let scene = sequence.loss.between(&scene, &truth)?;
            loss = (loss + (scene * sequence.scene_weight)?)?;
        }
        let squared = |found: &Tensor, truth: &Tensor| Loss::Mse.between(found, truth);
        if sequence.motion_weight > 0.0
            && let (Some(state), Some(future)) = (&batch.measured, &batch.future_states)
            && let Some(truth) = self.plan.spec.measured_motion(state, future)?
        {
            loss = added(loss, sequence.motion_weight, &predicted.motion, &truth, squared)?;
        }
        if let (Some(movers), Some(truth)) = (&predicted.movers, &batch.movers) {
            let truth = truth.narrow(1, 0, 1 + counting)?.contiguous()?;
            loss = added(loss, sequence.movers_weight, movers, &truth, mask_loss)?;
        }
        if let (Some(speeds), Some(state)) = (&predicted.speeds, &batch.measured)
            && let Some(truth) = self.plan.spec.measured_speeds(state)?
        {
            loss = added(loss, sequence.speeds_weight, speeds, &truth, squared)?;
        }
        Ok(loss)
    }

    /// The sprite network's loss: of the frames to come, of the context's frames as the sprites show them, and of the way that the
    /// sprites go.
    fn sprite_loss(&self, model: &Network, batch: &WindowBatch) -> Result<Tensor, TrainError> {
        let sequence = &self.config.sequence;
        let Some(predicted) = model.predict_sprites(&batch.inputs)? else {
            return Err(TrainError::Config("only the sprite network has this loss".to_owned()));
        };
        let coming = self.frames_loss(&predicted.frames, &batch.targets)?;
        let context = sequence.loss.between(&predicted.context, &batch.input_targets)?;
        let motion = motion_loss(&self.plan.spec, &predicted, &batch.input_targets, &batch.targets)?;
        let loss = (coming + (context * sequence.reconstruction_weight)?)?;
        Ok((loss + (motion * sequence.motion_weight)?)?)
    }

    /// Decodes features `[B, T, F]` to frames `[B, T, P]`.
    fn frames(model: &Network, features: &Tensor) -> Result<Tensor, TrainError> {
        let (batch, time, width) = features.dims3()?;
        let frames = model.decode_frames(&features.reshape((batch * time, width))?)?;
        Ok(frames.reshape((batch, time, ()))?)
    }

    /// The mean squared error on the validation windows of each part of the data set.
    pub(super) fn validation_by_part(&self, parameters: &Parameters) -> Result<Vec<f64>, TrainError> {
        let model = Network::new(self.plan.spec.clone(), parameters)?;
        let of_part = |part: &MixturePart| {
            let windows: Vec<DrawnWindow> = part.validation.iter().map(DrawnWindow::unchanged).collect();
            let mut sum = 0.0;
            for chunk in windows.chunks(VALIDATION_BATCH_SIZE) {
                let batch = self.plan.source.windows(chunk, self.config.window_shape(), false)?;
                let predicted = model.predict_frames(&batch.inputs, &batch.condition)?;
                let loss = Loss::Mse.between(&predicted, &batch.targets)?.to_scalar::<f32>()?;
                sum += f64::from(loss) * chunk.len() as f64;
            }
            Ok(sum / windows.len() as f64)
        };
        self.plan.mixture.iter().map(of_part).collect()
    }
}

/// The loss plus another one, weighted, of those windows whose truth is known, that is nowhere NaN.
fn added(
    loss: Tensor,
    weight: f64,
    found: &Tensor,
    truth: &Tensor,
    between: impl Fn(&Tensor, &Tensor) -> Result<Tensor, NnError>,
) -> Result<Tensor, TrainError> {
    let windows = truth.dim(0)?;
    let each = truth.elem_count() / windows;
    let values = truth.flatten_all()?.to_vec1::<f32>()?;
    let rows = (0..windows as u32).zip(values.chunks_exact(each));
    let known = rows.filter(|(_, values)| !values.iter().any(|value| value.is_nan()));
    let known: Vec<u32> = known.map(|(window, _)| window).collect();
    if known.is_empty() || weight == 0.0 {
        return Ok(loss);
    }
    if known.len() == windows {
        return Ok((loss + (between(found, truth)? * weight)?)?);
    }
    let share = known.len() as f64 / windows as f64;
    let of = |values: &Tensor| values.index_select(&Tensor::new(known.as_slice(), values.device())?, 0);
    Ok((loss + (between(&of(found)?, &of(truth)?)? * (weight * share))?)?)
}

impl Objective for SequenceObjective<'_> {
    fn loss(&self, parameters: &Parameters, step: usize, part: BatchPart) -> Result<Tensor, TrainError> {
        let sequence = &self.config.sequence;
        let drawn = self.shuffle.batch(step, sequence.batch_size).into_iter().enumerate();
        let windows = drawn.map(|(place, position)| DrawnWindow {
            window: &self.plan.train[position],
            change: self.plan.source.augmentation().draw(step, place),
        });
        let windows = part.of(windows.collect());
        let is_teacher_forced = sequence.feedback == TrainingFeedback::TeacherForcing;
        let batch = self
            .plan
            .source
            .windows(&windows, self.config.window_shape(), is_teacher_forced)?;
        let frozen: &[&str] = if self.is_frozen() { &[CODEC_PREFIX] } else { &[] };
        let model = Network::with_frozen(self.plan.spec.clone(), parameters, frozen)?;
        if self.plan.spec.flow().is_some() {
            let counting = sequence.frames_that_count(step, self.plan.spec.horizon);
            return self.flow_loss(&model, &batch, counting);
        }
        if self.plan.spec.sprites().is_some() {
            return self.sprite_loss(&model, &batch);
        }
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
        let loss = sequence
            .loss
            .between(&Self::frames(&model, &predicted)?, &batch.targets)?;
        if sequence.reconstruction_weight == 0.0 {
            return Ok(loss);
        }
        let Some(reconstructed) = model.reconstruct(&inputs)? else {
            return Ok(loss);
        };
        let reconstructed = Self::frames(&model, &reconstructed)?;
        let reconstruction = sequence.loss.between(&reconstructed, &batch.input_targets)?;
        Ok((loss + (reconstruction * sequence.reconstruction_weight)?)?)
    }

    fn validation_loss(&self, parameters: &Parameters) -> Result<f64, TrainError> {
        let parts = self.validation_by_part(parameters)?;
        let shares = self.plan.mixture.iter().map(|part| part.part.share);
        Ok(parts.into_iter().zip(shares).map(|(mse, share)| mse * share).sum())
    }

    fn sample(&self, parameters: &Parameters) -> Result<Option<Frame>, TrainError> {
        let (dataset, shape, spec) = (self.plan.source.dataset(), self.config.window_shape(), &self.plan.spec);
        // Of the first data set, where several are joined.
        let Some(part) = self.plan.mixture.first() else {
            return Ok(None);
        };
        let Some(window) = liveliest(dataset, &part.validation, shape)? else {
            return Ok(None);
        };
        let batch = self
            .plan
            .source
            .windows(&[DrawnWindow::unchanged(window)], shape, false)?;
        let model = Network::new(spec.clone(), parameters)?;
        let predicted = model.predict_frames(&batch.inputs, &batch.condition)?;
        let predicted = predicted.flatten_all()?.to_vec1::<f32>()?;
        // A training that diverges ends with its next update, which tells what diverged.
        if predicted.iter().any(|value| !value.is_finite()) {
            return Ok(None);
        }
        let camera = |values| {
            spec.preprocess
                .frame_from(values, spec.frame_width_px, spec.frame_height_px)
        };
        let predicted: Result<Vec<Frame>, _> = predicted.chunks_exact(spec.pixels()).map(camera).collect();
        let first = window.first_frame + shape.context;
        let truth = (first..first + shape.horizon).map(|frame| dataset.frame(frame));
        side_by_side(&truth.collect::<Result<Vec<_>, _>>()?, &predicted?)
    }
}
