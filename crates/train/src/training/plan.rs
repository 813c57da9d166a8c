//! What is fixed before the first step of a training: its windows, the model's description and the manifest.

use super::augment::Augmentation;
use super::batches::FrameSource;
use super::config::{Mirror, TrainConfig, WindowBudget};
use super::state::TrainState;
use super::{START_KEY, TrainError, Training};
use crate::frame_marks;
use foreframe_core::nn::ModelSpec;
use foreframe_core::registry::{DatasetShare, DatasetStamp, Manifest, ProgramStamp};
use foreframe_data::dataset::sampler::{Split, Splits, first_seconds};
use foreframe_data::dataset::{Dataset, DatasetInfo, DatasetPart, Window};

/// What is fixed before the first step: the windows and the model specification.
pub(super) struct TrainingPlan<'a> {
    pub(super) source: FrameSource<'a>,
    pub(super) spec: ModelSpec,
    /// Those of the first part of the data set, then those of the next.
    pub(super) train: Vec<Window>,
    pub(super) mixture: Vec<MixturePart>,
}

/// A part of the data set in the training.
pub(super) struct MixturePart {
    pub(super) part: DatasetPart,
    pub(super) train_windows: usize,
    pub(super) validation: Vec<Window>,
}

impl<'a> TrainingPlan<'a> {
    pub(super) fn new(config: &TrainConfig, dataset: &'a Dataset) -> Result<Self, TrainError> {
        let (shape, period_s) = (config.window_shape(), dataset.info().frame_period_s);
        let splits = Splits::new(dataset, config.data.split_seed);
        let available = splits.windows(dataset, Split::Train, shape, 1)?;
        let validation = splits.windows(dataset, Split::Validation, shape, 1)?;
        let train = match config.data.windows {
            WindowBudget::Count(count) if !available.is_empty() => {
                splits.sample(dataset, Split::Train, shape, count, config.seed.derive("windows", 0))?
            }
            _ => available,
        };
        let (mut kept, mut mixture) = (Vec::new(), Vec::new());
        for part in dataset.parts() {
            let of_part = |windows: &[Window]| -> Vec<Window> {
                let inside = |window: &&Window| part.episodes.contains(&window.episode);
                windows.iter().filter(inside).copied().collect()
            };
            let validation = of_part(&validation);
            let part_train = first_seconds(of_part(&train), shape, period_s, config.data.first_seconds);
            let train_windows = part_train.len();
            if train_windows == 0 && config.data.first_seconds > 0.0 && !of_part(&train).is_empty() {
                return Err(TrainError::Config(format!(
                    "data.first_seconds is {}; a window alone takes {} s",
                    config.data.first_seconds,
                    shape.frames() as f64 * period_s
                )));
            }
            if train_windows == 0 || validation.is_empty() {
                return Err(TrainError::NoWindows {
                    dataset: part.info.name.clone(),
                    train: train_windows,
                    validation: validation.len(),
                    frames: shape.frames(),
                });
            }
            let stride = validation.len().div_ceil(config.data.validation_windows).max(1);
            kept.extend(part_train);
            mixture.push(MixturePart {
                train_windows,
                validation: validation.into_iter().step_by(stride).collect(),
                part,
            });
        }
        let train = kept;
        let frames = window_frames(&train, shape.context + shape.horizon);
        let spec = config.model_spec(dataset, &frames);
        check_conditioning(&dataset.info().name, &spec)?;
        check_actions(config, dataset, &spec, &frames)?;
        check_movers(config, dataset, &spec)?;
        spec.validate()?;
        let augmentation = Augmentation::new(&config.data, dataset, &frames, config.seed)?;
        Ok(Self {
            source: FrameSource::new(dataset, spec.preprocess, config.sequence.target, augmentation)
                .with_masks(finds_movers(&spec))
                .with_camera(spec.flow().and_then(|flow| flow.camera)),
            spec,
            train,
            mixture,
        })
    }

    /// The manifest of the trained model. `validation` is the error of each part of a joined data set.
    pub(super) fn manifest(
        &self,
        training: &Training<'_>,
        state: &TrainState,
        validation: &[f64],
    ) -> Result<Manifest, TrainError> {
        let (config, info) = (training.config, training.dataset.info());
        let mut settings = serde_json::to_value(config).map_err(|error| TrainError::Config(error.to_string()))?;
        if let Some(start) = training.start {
            settings[START_KEY] = serde_json::json!({
                "model": start.manifest.name,
                "version": start.manifest.version,
                "weights_sha256": start.manifest.weights_sha256,
            });
        }
        let frame_marks = self.frame_marks(training)?;
        Ok(Manifest {
            name: config.name.clone(),
            version: 1,
            spec: self.spec.clone(),
            weights_sha256: String::new(),
            dataset: DatasetStamp {
                name: info.name.clone(),
                content_hash: info.content_hash.clone(),
                scenario: info.scenario.clone(),
                windows: self.train.len(),
                split_seed: config.data.split_seed,
                parts: self.shares(),
                frame_marks,
            },
            seed: config.seed,
            command: training.command.to_owned(),
            training: settings,
            metrics: self.metrics(state, validation),
            calibration: None,
            parameters: self.spec.parameter_count(),
            multiply_adds_per_frame: self.spec.multiply_adds_per_frame(),
            program: ProgramStamp::current(),
        })
    }

    /// Marks of the training frames and of those of the model that it started from. None if that one has none: these would not be all.
    fn frame_marks(&self, training: &Training<'_>) -> Result<Vec<u64>, TrainError> {
        let of_start = training.start.map(|start| &start.manifest.dataset.frame_marks);
        if of_start.is_some_and(Vec::is_empty) {
            return Ok(Vec::new());
        }
        let length = training.config.window_shape().frames();
        let mut marks = frame_marks::of_windows(training.dataset, &self.train, length)?;
        marks.extend(of_start.into_iter().flatten());
        Ok(frame_marks::kept(marks))
    }

    /// The number of training windows of each part and its share of what is drawn.
    pub(super) fn drawn_parts(&self) -> Vec<(usize, f64)> {
        self.mixture
            .iter()
            .map(|part| (part.train_windows, part.part.share))
            .collect()
    }

    /// The parts of a joined data set, for the manifest; none if it is not joined.
    fn shares(&self) -> Vec<DatasetShare> {
        let share = |part: &MixturePart| DatasetShare {
            name: part.part.info.name.clone(),
            content_hash: part.part.info.content_hash.clone(),
            scenario: part.part.info.scenario.clone(),
            windows: part.train_windows,
            share: part.part.share,
        };
        let parts = if self.mixture.len() > 1 { &self.mixture[..] } else { &[] };
        parts.iter().map(share).collect()
    }

    fn metrics(&self, state: &TrainState, validation: &[f64]) -> serde_json::Value {
        let progress = &state.progress;
        let mut metrics = serde_json::json!({
            "validation": { "mse": progress.best_loss, "step": progress.best_step }
        });
        if self.mixture.len() > 1 {
            let parts = self.mixture.iter().zip(validation);
            metrics["validation"]["datasets"] = parts
                .map(|(part, mse)| serde_json::json!({"name": part.part.info.name, "mse": mse}))
                .collect();
        }
        metrics
    }
}

/// The number of parameters of the network that a training on a data set makes. Errors: `Config` if it takes actions or states that the
/// data set does not have; `Network` if one of its sizes is out of range.
pub fn parameter_count(config: &TrainConfig, dataset: &DatasetInfo) -> Result<u64, TrainError> {
    let spec = config.unscaled_spec(dataset);
    check_conditioning(&dataset.name, &spec)?;
    spec.validate()?;
    Ok(spec.parameter_count())
}

/// Errors: `Config` if the model takes actions or states that the data set does not have.
pub(super) fn check_conditioning(dataset: &str, spec: &ModelSpec) -> Result<(), TrainError> {
    let (takes, has) = (
        [spec.action_inputs().is_some(), spec.state_inputs().is_some()],
        [!spec.actions.is_empty(), !spec.states.is_empty()],
    );
    let missing = ["actions", "states"].into_iter().zip(takes.into_iter().zip(has));
    let Some((missing, _)) = missing.into_iter().find(|(_, (takes, has))| *takes && !has) else {
        return Ok(());
    };
    let fitting = match has {
        [true, true] => "state-action",
        [true, false] => "action",
        [false, true] => "state",
        [false, false] => "none",
    };
    Err(TrainError::Config(format!(
        "data set \"{dataset}\" has no {missing}, but model.conditioning is {}; set model.conditioning to {fitting}, or use a preset or a \
         model that fits: recording takes actions only, static-flow neither",
        spec.conditioning
    )))
}

/// Errors: `ConstantActions` if the model takes actions that are the same in all frames, so that it could not learn what they do.
fn check_actions(
    config: &TrainConfig,
    dataset: &Dataset,
    spec: &ModelSpec,
    frames: &[usize],
) -> Result<(), TrainError> {
    let changes = |component: usize| {
        // Of joined data sets, one may lack a channel.
        let values = frames.iter().map(|&frame| dataset.action(frame)[component]);
        let mut known = values.filter(|value| value.is_finite());
        let first = known.next();
        known.any(|value| Some(value) != first)
    };
    let never_change = spec.action_inputs().is_some() && !(0..spec.actions.len()).any(changes);
    if !never_change || config.data.constant_actions {
        return Ok(());
    }
    Err(TrainError::ConstantActions {
        dataset: dataset.info().name.clone(),
        has_actions: !spec.actions.is_empty(),
        conditioning: spec.conditioning,
    })
}

fn finds_movers(spec: &ModelSpec) -> bool {
    spec.flow().is_some_and(|flow| flow.layers.movers)
}

/// Errors: `Config` if the model is to find movers, and nothing tells where they are.
fn check_movers(config: &TrainConfig, dataset: &Dataset, spec: &ModelSpec) -> Result<(), TrainError> {
    if !finds_movers(spec) {
        return Ok(());
    }
    let refused = |reason: String| Err(TrainError::Config(reason));
    if config.data.mirror == Mirror::Movers {
        return refused(
            "data.mirror is \"movers\", which model.flow.movers does not fit; set one of them to off or false"
                .to_owned(),
        );
    }
    if !dataset.info().has_masks {
        return refused(format!(
            "data set \"{}\" has no masks of movers, but model.flow.movers is true; collected data sets have them; set \
             model.flow.movers to false",
            dataset.info().name
        ));
    }
    if config.sequence.movers_weight == 0.0 {
        return refused(
            "sequence.movers_weight is 0, but model.flow.movers is true; it must be above 0, or nothing would be learned of \
             movers"
                .to_owned(),
        );
    }
    Ok(())
}

/// The distinct frames of windows of `length` frames, in increasing order.
pub(super) fn window_frames(windows: &[Window], length: usize) -> Vec<usize> {
    let mut starts: Vec<usize> = windows.iter().map(|window| window.first_frame).collect();
    starts.sort_unstable();
    let (mut frames, mut next) = (Vec::new(), 0);
    for start in starts {
        // Windows overlap; each frame is listed once.
        frames.extend(next.max(start)..start + length);
        next = start + length;
    }
    frames
}
