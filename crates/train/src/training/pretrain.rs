//! Stage 1: the dense encoder and the reconstruction layer as an autoencoder of single frames.

use candle_core::Tensor;

use super::TrainError;
use super::config::TrainConfig;
use super::plan::{TrainingPlan, window_frames};
use super::shuffle::Shuffle;
use super::stage::{BatchPart, Objective};
use foreframe_core::frame::Frame;
use foreframe_core::nn::loss::Loss;
use foreframe_core::nn::{Network, Parameters};
use foreframe_data::dataset::Window;

/// Largest number of validation frames used to choose the best codec.
const MAX_VALIDATION_FRAMES: usize = 1024;

/// The reconstruction error of the codec.
pub(super) struct CodecObjective<'a> {
    plan: &'a TrainingPlan<'a>,
    config: &'a TrainConfig,
    frames: Vec<usize>,
    shuffle: Shuffle,
    /// Frames of the validation windows: inputs and targets.
    validation: [Tensor; 2],
}

impl<'a> CodecObjective<'a> {
    pub(super) fn new(plan: &'a TrainingPlan<'a>, config: &'a TrainConfig) -> Result<Self, TrainError> {
        let length = config.model.context + config.model.horizon;
        let frames = window_frames(&plan.train, length);
        let validation: Vec<Window> = plan.mixture.iter().flat_map(|part| part.validation.clone()).collect();
        let validation = window_frames(&validation, length);
        let stride = validation.len().div_ceil(MAX_VALIDATION_FRAMES).max(1);
        let validation: Vec<usize> = validation.into_iter().step_by(stride).collect();
        Ok(Self {
            plan,
            config,
            shuffle: Shuffle::new(frames.len(), config.seed.derive("pretrain", 0)),
            frames,
            validation: [plan.source.inputs(&validation)?, plan.source.targets(&validation)?],
        })
    }

    fn reconstruct(&self, parameters: &Parameters, inputs: &Tensor) -> Result<Tensor, TrainError> {
        let model = Network::new(self.plan.spec.clone(), parameters)?;
        Ok(model.decode_frames(&model.encode_frames(inputs)?)?)
    }
}

impl Objective for CodecObjective<'_> {
    fn loss(&self, parameters: &Parameters, step: usize, part: BatchPart) -> Result<Tensor, TrainError> {
        let batch = part.of(self.shuffle.batch(step, self.config.pretrain.batch_size));
        let batch: Vec<usize> = batch.into_iter().map(|position| self.frames[position]).collect();
        let reconstructed = self.reconstruct(parameters, &self.plan.source.inputs(&batch)?)?;
        let targets = self.plan.source.targets(&batch)?;
        Ok(self.config.sequence.loss.between(&reconstructed, &targets)?)
    }

    fn validation_loss(&self, parameters: &Parameters) -> Result<f64, TrainError> {
        let [inputs, targets] = &self.validation;
        let loss = Loss::Mse.between(&self.reconstruct(parameters, inputs)?, targets)?;
        Ok(f64::from(loss.to_scalar::<f32>()?))
    }

    fn sample(&self, _: &Parameters) -> Result<Option<Frame>, TrainError> {
        Ok(None)
    }
}

#[cfg(test)]
mod tests {
    use candle_core::Device;

    use super::*;
    use foreframe_core::types::Seed;
    use foreframe_data::dataset::{Dataset, DatasetInfo, EpisodeData};

    const SIDE_PX: u32 = 8;

    #[test]
    fn the_frames_of_overlapping_windows_are_listed_once() {
        let window = |first_frame| Window {
            episode: 0,
            first_frame,
        };
        let windows = [9, 2, 3, 20, 3].map(window);
        assert_eq!(
            window_frames(&windows, 4),
            [2, 3, 4, 5, 6, 9, 10, 11, 12, 20, 21, 22, 23]
        );
        assert!(window_frames(&[], 4).is_empty());
    }

    /// Episodes in which every frame is the same checkerboard.
    fn checkerboards() -> Dataset {
        let frames = 12;
        let board: Vec<u8> = (0..SIDE_PX * SIDE_PX)
            .map(|i| {
                if (i / SIDE_PX + i % SIDE_PX).is_multiple_of(2) {
                    0
                } else {
                    255
                }
            })
            .collect();
        let episode = EpisodeData {
            timestamps_s: (0..frames).map(|frame| 0.2 * f64::from(frame)).collect(),
            pixels: board.repeat(frames as usize),
            ..EpisodeData::default()
        };
        let info = DatasetInfo {
            name: "checkerboards".to_owned(),
            frame_width_px: SIDE_PX,
            frame_height_px: SIDE_PX,
            frame_period_s: 0.2,
            ..DatasetInfo::default()
        };
        Dataset::from_episodes(info, vec![episode; 20]).unwrap()
    }

    #[test]
    fn the_codec_is_fitted_to_sharp_targets() {
        let settings = [
            "sequence.target=sharp",
            "data.windows=all",
            "model.features=4",
            "model.hidden=4",
            "model.conditioning=none",
        ];
        let config = TrainConfig::layered("paper", None, &settings.map(str::to_owned)).unwrap();
        assert!(
            config.model.preprocess.blur_sigma_px > 0.0,
            "the inputs must be smoothed"
        );
        let dataset = checkerboards();
        let plan = TrainingPlan::new(&config, &dataset).unwrap();
        let objective = CodecObjective::new(&plan, &config).unwrap();
        // This decoder ignores the features and always writes the sharp, inverted checkerboard.
        let parameters = Parameters::initialize(&plan.spec, Seed(1)).unwrap();
        let weight = parameters.get("frame_decoder.weight").unwrap();
        weight.set(&weight.zeros_like().unwrap()).unwrap();
        let sharp: Vec<f32> = dataset
            .pixels(0)
            .unwrap()
            .iter()
            .map(|&pixel| 1.0 - f32::from(pixel) / 255.0)
            .collect();
        let bias = Tensor::from_vec(sharp, (SIDE_PX * SIDE_PX) as usize, &Device::Cpu).unwrap();
        parameters.get("frame_decoder.bias").unwrap().set(&bias).unwrap();
        let whole = BatchPart { index: 0, count: 1 };
        let fitted = objective
            .loss(&parameters, 0, whole)
            .unwrap()
            .to_scalar::<f32>()
            .unwrap();
        let validated = objective.validation_loss(&parameters).unwrap();
        assert!(
            fitted < 1e-9 && validated < 1e-9,
            "fitted {fitted}, validated {validated}"
        );
    }
}
