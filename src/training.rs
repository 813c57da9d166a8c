//! From windows to weights. [`run`] goes through two stages — `pretrain` teaches the dense codec single frames, `fit`
//! the recurrent network their order — each a loop of `stage`; `checkpoint` lets either be stopped at any step and gone
//! on with to the same bits.

mod batches;
mod checkpoint;
pub mod config;
mod fit;
pub mod observer;
pub mod optimizer;
mod preset;
mod pretrain;
mod principal;
mod stage;

use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use self::batches::FrameSource;
pub use self::checkpoint::{CHECKPOINT_FILE, CheckpointPosition};
use self::checkpoint::{Checkpoint, RunFiles};
pub use self::config::TrainConfig;
use self::config::{CodecStart, WindowBudget};
pub use self::observer::{Observer, TrainingEvent, TrainingStage};
use self::stage::{StageEnd, StageRunner, TrainState};
use crate::dataset::sampler::{Split, Splits};
use crate::dataset::{Dataset, DatasetError, Window};
use crate::files::write_atomically;
use crate::frame::FrameError;
use crate::nn::{ModelSpec, NnError, Parameters};
use crate::registry::{self, DatasetStamp, Manifest, ProgramStamp, RegistryError};

/// Frames that the principal components are taken from, at most.
const MAX_PRINCIPAL_FRAMES: usize = 8192;

/// Why a training did not start or stopped.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TrainError {
    /// There is no preset of that name.
    #[error("there is no preset {0:?}; there are: {names}", names = TrainConfig::preset_names().join(", "))]
    UnknownPreset(String),
    /// A setting is misspelt or out of range.
    #[error("{0}")]
    Config(String),
    /// The directory holds something else.
    #[error("{dir} exists and holds no training run; name a new directory", dir = .0.display())]
    NotARun(PathBuf),
    /// Another training writes there.
    #[error("another training is running in {}; wait for it or name another directory", .0.display())]
    Busy(PathBuf),
    /// The directory holds a run with other settings or data.
    #[error(
        "{} holds a run with another {what}; go on with that one's ({}/config.toml), or name a new directory",
        run_dir.display(), run_dir.display()
    )]
    OtherRun {
        /// The run's directory.
        run_dir: PathBuf,
        /// `configuration` or `data set`.
        what: &'static str,
    },
    /// No window is left to choose the best weights by.
    #[error("the validation split holds no window of {frames} frames; collect more trials, 40 or more")]
    NoValidation {
        /// Frames of a window.
        frames: usize,
    },
    /// The loss or a gradient became NaN or infinite, or the loss absurdly large.
    #[error(
        "training diverged in {stage} at step {step}: {what}; the checkpoint of step {kept} is kept; \
         try a lower learning rate"
    )]
    Diverged {
        /// Where.
        stage: TrainingStage,
        /// The update that would have been made.
        step: usize,
        /// What the loss or the gradient is.
        what: String,
        /// The step of the last good checkpoint.
        kept: usize,
    },
    /// A file of the run could not be read or written.
    #[error("could not {action} {}: {source}", path.display())]
    Io {
        /// `read` or `write`.
        action: &'static str,
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// The checkpoint is damaged.
    #[error("the checkpoint {} cannot be gone on from ({reason}); delete it to start anew", path.display())]
    Checkpoint {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// The data set does not serve.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    /// A frame does not serve.
    #[error(transparent)]
    Frame(#[from] FrameError),
    /// The network refused its input.
    #[error(transparent)]
    Network(#[from] NnError),
    /// An update failed.
    #[error(transparent)]
    Optimizer(#[from] optimizer::OptimizerError),
    /// The model could not be published.
    #[error(transparent)]
    Registry(#[from] RegistryError),
}

impl From<candle_core::Error> for TrainError {
    fn from(error: candle_core::Error) -> Self {
        Self::Network(error.into())
    }
}

/// How a training ended.
#[derive(Debug)]
pub enum TrainingOutcome {
    /// The model stands in `model_dir`.
    Finished {
        /// Where.
        model_dir: PathBuf,
        /// What it says of itself.
        manifest: Box<Manifest>,
    },
    /// It was asked to stop; the same call goes on from there.
    Interrupted {
        /// Where it stopped.
        stage: TrainingStage,
        /// Updates made in that stage.
        step: usize,
    },
}

/// What is trained, on what, and where the run is kept.
pub struct Training<'a> {
    /// All settings.
    pub config: &'a TrainConfig,
    /// The data.
    pub dataset: &'a Dataset,
    /// Holds `config.toml`, `checkpoint.safetensors`, `history.json` and at the end `model/`.
    pub run_dir: &'a Path,
    /// The command line that the manifest tells.
    pub command: &'a str,
}

/// Trains, or goes on where the run in `run_dir` was stopped, until done or cancelled. A run that was stopped and gone on
/// with ends in the same bits as one that never was. Errors: any of [`TrainError`]; what was checkpointed stays.
pub fn run(
    training: &Training<'_>,
    observer: &mut dyn Observer,
    cancelled: &AtomicBool,
) -> Result<TrainingOutcome, TrainError> {
    let (config, dataset) = (training.config, training.dataset);
    config.validate()?;
    let files = RunFiles::check(training.run_dir, config, &dataset.info().content_hash)?;
    // Before the directory is made, so that what is refused here leaves nothing in the way of the next try.
    let plan = TrainingPlan::new(config, dataset)?;
    let _lock = files.claim()?;
    let model_dir = files.model_dir();
    if model_dir.join(registry::MANIFEST_FILE).is_file() {
        let manifest = Box::new(registry::manifest::read(&model_dir)?);
        return Ok(TrainingOutcome::Finished { model_dir, manifest });
    }
    let mut state = match Checkpoint::load(&files, &plan.spec, &config.run)? {
        Some(checkpoint) => checkpoint.into_state(),
        None => TrainState::new(initial_parameters(&plan, config)?, &config.run)?,
    };
    for point in &state.history {
        observer.on_event(TrainingEvent::Recalled {
            stage: point.stage,
            step: point.step,
            train_loss: point.train_loss,
            validation_loss: point.validation_loss,
        });
    }
    observer.on_event(TrainingEvent::Started {
        stage: state.stage,
        step: state.step,
        windows: plan.train.len(),
    });
    let runner = StageRunner {
        files: &files,
        run: &config.run,
        cancelled,
    };
    if state.stage == TrainingStage::Pretrain {
        let codec = pretrain::CodecObjective::new(&plan, config)?;
        if runner.run(&codec, &mut state, observer)? == StageEnd::Interrupted {
            return Ok(TrainingOutcome::Interrupted {
                stage: TrainingStage::Pretrain,
                step: state.step,
            });
        }
        state.enter(TrainingStage::Fit, &config.run)?;
        runner.save(&state, observer)?;
    }
    let sequence = fit::SequenceObjective::new(&plan, config);
    if runner.run(&sequence, &mut state, observer)? == StageEnd::Interrupted {
        return Ok(TrainingOutcome::Interrupted {
            stage: TrainingStage::Fit,
            step: state.step,
        });
    }
    state.restore_best()?;
    let manifest = plan.manifest(training, &state)?;
    write_history(&files, &state)?;
    let manifest = Box::new(registry::publish(&model_dir, &state.parameters, &manifest)?);
    Ok(TrainingOutcome::Finished { model_dir, manifest })
}

fn initial_parameters(plan: &TrainingPlan<'_>, config: &TrainConfig) -> Result<Parameters, TrainError> {
    let parameters = Parameters::initialize(&plan.spec, config.seed.derive("weights", 0))?;
    if config.pretrain.start == CodecStart::Principal {
        let frames = window_frames(&plan.train, config.model.context + config.model.horizon);
        let stride = frames.len().div_ceil(MAX_PRINCIPAL_FRAMES).max(1);
        let frames: Vec<usize> = frames.into_iter().step_by(stride).collect();
        let (read, written) = (plan.source.frames(&frames)?, plan.source.targets(&frames)?);
        principal::set_codec(&parameters, &read, &written, config.seed.derive("principal", 0))?;
    }
    Ok(parameters)
}

fn write_history(files: &RunFiles, state: &TrainState) -> Result<(), TrainError> {
    let path = files.history();
    let text = serde_json::to_vec(&state.history)
        .map_err(|error| TrainError::Config(format!("the history is not writable as JSON: {error}")))?;
    write_atomically(&path, &text).map_err(|source| TrainError::Io {
        action: "write",
        path,
        source,
    })
}

/// What is decided before the first step: the windows and the model's description.
struct TrainingPlan<'a> {
    source: FrameSource<'a>,
    spec: ModelSpec,
    train: Vec<Window>,
    validation: Vec<Window>,
}

impl<'a> TrainingPlan<'a> {
    fn new(config: &TrainConfig, dataset: &'a Dataset) -> Result<Self, TrainError> {
        let shape = config.window_shape();
        let splits = Splits::new(dataset, config.data.split_seed);
        let train = match config.data.windows {
            WindowBudget::Count(count) => {
                splits.sample(dataset, Split::Train, shape, count, config.seed.derive("windows", 0))?
            }
            WindowBudget::All(_) => splits.windows(dataset, Split::Train, shape, 1)?,
        };
        let validation = splits.windows(dataset, Split::Validation, shape, 1)?;
        if validation.is_empty() {
            return Err(TrainError::NoValidation { frames: shape.frames() });
        }
        let stride = validation.len().div_ceil(config.data.validation_windows).max(1);
        let validation = validation.into_iter().step_by(stride).collect();
        let frames = window_frames(&train, shape.context + shape.horizon);
        let spec = config.model_spec(dataset, &frames);
        spec.validate()?;
        Ok(Self {
            source: FrameSource::new(dataset, spec.preprocess, config.fit.target),
            spec,
            train,
            validation,
        })
    }

    fn manifest(&self, training: &Training<'_>, state: &TrainState) -> Result<Manifest, TrainError> {
        let (config, info) = (training.config, training.dataset.info());
        let settings = serde_json::to_value(config).map_err(|error| TrainError::Config(error.to_string()))?;
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
            },
            seed: config.seed,
            command: training.command.to_owned(),
            training: settings,
            metrics: serde_json::json!({
                "validation": { "mse": state.best_loss, "step": state.best_step }
            }),
            parameters: self.spec.parameter_count(),
            multiply_adds_per_frame: self.spec.multiply_adds_per_frame(),
            program: ProgramStamp::current(),
        })
    }
}

/// The distinct frames that windows of `length` frames cover, in order.
fn window_frames(windows: &[Window], length: usize) -> Vec<usize> {
    let mut frames: Vec<usize> = windows
        .iter()
        .flat_map(|window| window.first_frame..window.first_frame + length)
        .collect();
    frames.sort_unstable();
    frames.dedup();
    frames
}
