//! Adapting a model that sees depth to a robot that it never saw, from a few minutes of that robot's recording: estimates the camera if
//! nobody says it, trains the model further, and tells whether it became better.

mod error;

use std::sync::atomic::AtomicBool;

use serde::Serialize;

pub use self::error::AdaptError;
use crate::evaluation::{self, CameraEstimate};
use crate::settings::SettingsLayer;
use crate::training::TrainConfig;
use foreframe_core::error_text::comma_separated;
use foreframe_core::nn::{Conditioning, POSE_CHANNELS};
use foreframe_core::registry::{Manifest, Model};
use foreframe_core::types::ModelName;
use foreframe_data::dataset::sampler::Split;
use foreframe_data::dataset::{Dataset, DatasetInfo, Window};

/// Validation windows that choose the weights, at most, and about as many others that judge them.
const COMPARED_WINDOWS: usize = 100;
/// Where a camera is taken to be whose height is not known, in metres: distances then count in units of it.
const HEIGHT_M: f32 = 0.6;

/// How a model is adapted.
#[derive(Clone, Debug)]
pub struct AdaptSettings {
    /// The new model's name.
    pub name: ModelName,
    /// Updates, of 16 windows each; the weights with the least validation error are kept.
    pub steps: u32,
    /// Channels whose sign changes in a mirror, such as a steering angle. If there are any, half of the training windows are mirrored.
    pub mirror: Vec<String>,
    /// Whether the model also learns to remember the one room of the recording, which it finds by the absolute pose in the state.
    pub remember: bool,
    /// Further settings of the training.
    pub layers: Vec<SettingsLayer>,
}

impl AdaptSettings {
    /// Updates, unless others are asked for.
    pub const STEPS: u32 = 1200;

    /// Errors: `NoChannel`, `NoPose`, `NoActions`, `Fixed`.
    fn check_channels(&self, info: &DatasetInfo) -> Result<(), AdaptError> {
        let states = info.state_channels.iter().map(|channel| channel.name.as_str());
        let states: Vec<&str> = states.collect();
        let actions = info.action_channels.iter().map(|channel| channel.name.as_str());
        let channels: Vec<&str> = actions.chain(states.iter().copied()).collect();
        if let Some(unknown) = self.mirror.iter().find(|name| !channels.contains(&name.as_str())) {
            return Err(AdaptError::NoChannel {
                name: unknown.clone(),
                known: comma_separated(&channels),
            });
        }
        if self.remember && !self.mirror.is_empty() {
            return Err(AdaptError::Fixed(
                "mirror",
                "a mirrored room is not the one to remember",
            ));
        }
        if self.remember && !POSE_CHANNELS.iter().all(|name| states.contains(name)) {
            return Err(AdaptError::NoPose(info.name.clone()));
        }
        if self.remember && info.action_channels.is_empty() {
            return Err(AdaptError::NoActions(info.name.clone()));
        }
        Ok(())
    }

    /// The settings of the training: those of the base, for what the data set has. Errors: `NotAdaptable`, and those of
    /// [`TrainConfig::of_model`].
    pub fn training(&self, base: &Manifest, info: &DatasetInfo) -> Result<TrainConfig, AdaptError> {
        if !base.spec.sees_speeds() {
            return Err(AdaptError::NotAdaptable(base.name.clone()));
        }
        evaluation::check_fit(base, info)?;
        self.check_channels(info)?;
        let conditioning = match (info.action_channels.is_empty(), info.state_channels.is_empty()) {
            (false, false) => Conditioning::StateAction,
            (false, true) => Conditioning::Action,
            (true, false) => Conditioning::State,
            (true, true) => Conditioning::None,
        };
        let finds_movers = base.spec.flow().is_some_and(|flow| flow.layers.movers) && info.has_masks;
        let settings = [
            format!("model.conditioning={conditioning}"),
            format!("model.flow.movers={finds_movers}"),
            format!("sequence.steps={}", self.steps),
            "sequence.learning_rate=0.004".to_owned(),
            "run.validate_every_steps=50".to_owned(),
            "data.brightness=0.1".to_owned(),
            format!("data.validation_windows={COMPARED_WINDOWS}"),
            "sequence.batch_size=16".to_owned(),
            "run.batch_parts=2".to_owned(),
            match self.mirror.as_slice() {
                [] => "data.mirror=off".to_owned(),
                channels => format!("data.mirror={channels:?}"),
            },
        ];
        // Without the pose, the room could not be found.
        let remembering: &[&str] = if self.remember {
            &["model.flow.memory=true", "sequence.scene_weight=0.3", "data.hidden=0.0"]
        } else {
            &["model.flow.memory=false"]
        };
        let settings = settings.iter().map(String::as_str).chain(remembering.iter().copied());
        let own = settings.map(SettingsLayer::assignment);
        let layers = own.chain(self.layers.iter().cloned().map(Ok));
        let layers = layers.collect::<Result<Vec<_>, _>>()?;
        let config = TrainConfig::of_model(base, layers)?;
        let shape = config.window_shape();
        let fixed = "it is that of the model to start from";
        let rules = [
            ("model.context", shape.context == base.spec.context, fixed),
            ("model.horizon", shape.horizon == base.spec.horizon, fixed),
            (
                "data.split_seed",
                config.data.split_seed == base.dataset.split_seed,
                fixed,
            ),
            (
                "sequence.steps",
                config.sequence.steps == self.steps as usize,
                "use steps",
            ),
        ];
        if let Some((setting, _, why)) = rules.into_iter().find(|(_, holds, _)| !holds) {
            return Err(AdaptError::Fixed(setting, why));
        }
        Ok(TrainConfig {
            name: self.name.clone(),
            ..config
        })
    }
}

/// What is known before the training starts.
pub struct Adaptation<'a> {
    base: &'a Model,
    /// The recording, with an estimated camera where none is known.
    pub dataset: Dataset,
    /// The estimated camera; `None` where the recording says it, or no window fits.
    pub camera: Option<CameraEstimate>,
    /// The settings of the training, which starts from the base's weights.
    pub config: TrainConfig,
    /// Windows of the validation split that judge the adapted model.
    windows: Vec<Window>,
}

impl<'a> Adaptation<'a> {
    /// Looks at the recording. Errors: `NotAdaptable`, `NothingToJudge`, `Cancelled` of the evaluation, those of the settings, of the data
    /// set and of the network.
    pub fn of(
        base: &'a Model,
        dataset: Dataset,
        settings: &AdaptSettings,
        cancelled: &AtomicBool,
    ) -> Result<Self, AdaptError> {
        let mut config = settings.training(&base.manifest, dataset.info())?;
        let all = evaluation::windows_of(base, &dataset, Split::Validation)?;
        if all.len() < 2 {
            return Err(AdaptError::NothingToJudge(dataset.info().name.clone()));
        }
        config.data.validation_windows = config.data.validation_windows.clamp(1, all.len() / 2);
        let windows = judging_windows(&all, config.data.validation_windows);
        let mut episodes = 0..dataset.episodes().len();
        let camera = if episodes.any(|episode| dataset.camera(episode).is_some()) {
            None
        } else {
            evaluation::estimate_camera(base, &dataset, HEIGHT_M, config.data.first_seconds, cancelled)?
        };
        Ok(Self {
            base,
            dataset: match &camera {
                Some(found) => dataset.with_camera(found.camera),
                None => dataset,
            },
            camera,
            config,
            windows,
        })
    }

    /// How well the adapted model predicts windows that did not choose its weights. Errors: `Cancelled` of the evaluation,
    /// those of the network and of the data set.
    pub fn judge(&self, adapted: &Model, cancelled: &AtomicBool) -> Result<AdaptScores, AdaptError> {
        let mean_of = |model: &Model| -> Result<f64, AdaptError> {
            let horizon = model.spec().horizon;
            Ok(mean(&evaluation::window_errors(
                model,
                &self.dataset,
                &self.windows,
                horizon,
                cancelled,
            )?))
        };
        Ok(AdaptScores {
            windows: self.windows.len(),
            copied: mean(&evaluation::copied_errors(self.base, &self.dataset, &self.windows)?),
            before: mean_of(self.base)?,
            after: mean_of(adapted)?,
        })
    }
}

/// Mean squared errors, intensities 0…1, on windows of the validation split.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct AdaptScores {
    /// How many windows.
    pub windows: usize,
    /// Of the last frame, as the prediction of all that follow.
    pub copied: f64,
    /// Of the model to start from.
    pub before: f64,
    /// Of the adapted model.
    pub after: f64,
}

impl AdaptScores {
    /// The errors in units of 10⁻⁴ as lines of a table, for models of these names.
    #[must_use]
    pub fn table(&self, base: &str, adapted: &str) -> String {
        let e4 = |mse: f64| format!("{:8.1}", mse * 1e4);
        format!(
            "MSE ×10⁻⁴ on {} validation windows\n{}  the last frame, copied\n{}  {base} as it is\n{}  {adapted}",
            self.windows,
            e4(self.copied),
            e4(self.before),
            e4(self.after),
        )
    }

    /// Whether the model became better, so that it is worth keeping.
    #[must_use]
    pub fn is_better(&self) -> bool {
        self.after < self.before
    }
}

/// Of the windows of the validation split, those in the middle between the `choosing` ones that choose the weights: the training takes the
/// first of each stride.
fn judging_windows(all: &[Window], choosing: usize) -> Vec<Window> {
    let stride = all.len().div_ceil(choosing);
    all.iter().skip(stride / 2).step_by(stride).copied().collect()
}

fn mean(errors: &[f64]) -> f64 {
    errors.iter().sum::<f64>() / errors.len() as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_window_both_chooses_the_weights_and_judges_them() {
        for count in [2, 3, 71, 100, 199, 200, 201, 1000] {
            let window = |first_frame| Window {
                episode: 0,
                first_frame,
            };
            let all: Vec<Window> = (0..count).map(window).collect();
            let choosing = COMPARED_WINDOWS.min(count / 2);
            let chosen: Vec<&Window> = all.iter().step_by(count.div_ceil(choosing)).collect();
            let judging = judging_windows(&all, choosing);
            assert!(judging.iter().all(|window| !chosen.contains(&window)), "{count}");
            assert!(judging.len() * 2 >= choosing, "{count}: {}", judging.len());
        }
    }
}
