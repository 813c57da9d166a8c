//! Training. [`run`] has two stages: `pretrain` trains the dense codec on single frames, `sequence` trains the recurrent
//! network on windows. Both use the loop in `stage`. With `checkpoint`, a training can be stopped at any step and resumed; the
//! result has the same bits as an uninterrupted training.

mod augment;
mod batches;
mod checkpoint;
pub mod config;
mod error;
mod event_file;
mod journal;
pub mod observer;
pub mod optimizer;
mod plan;
mod preset;
mod pretrain;
mod principal_components;
mod random_codec;
mod sample;
mod sequence;
mod shuffle;
mod stage;
mod start;
mod state;
pub mod sweep;

use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

pub use self::checkpoint::{CHECKPOINT_FILE, CheckpointPosition, seal, state_entry};
use self::checkpoint::{HISTORY_FILE, MODEL_DIR, RunFiles, io_failed};
use self::config::CodecStart;
pub use self::config::TrainConfig;
pub use self::error::TrainError;
use self::journal::Journal;
pub use self::journal::{CURVE_POINTS, SAMPLE_FILE};
pub use self::observer::{Observer, TrainingEvent, TrainingStage};
pub use self::plan::parameter_count;
use self::plan::{TrainingPlan, window_frames};
use self::stage::{StageEnd, StageRunner};
pub use self::start::check_start;
use self::state::TrainState;
pub use self::sweep::Sweep;
use foreframe_core::files::{is_transient, write_atomically};
use foreframe_core::nn::Parameters;
use foreframe_core::registry::{self, Manifest, StoredWeights};
use foreframe_data::dataset::Dataset;

/// Largest number of frames from which the codec's initial weights are computed.
const MAX_PRINCIPAL_FRAMES: usize = 8192;

/// The entry of a manifest's training settings that names the model whose weights the training started from.
const START_KEY: &str = "from";

/// How a training ended.
#[derive(Debug)]
pub enum TrainingOutcome {
    /// The training is complete and the model is published in `model_dir`.
    Finished {
        /// The model's directory.
        model_dir: PathBuf,
        /// The model's manifest.
        manifest: Box<Manifest>,
    },
    /// The training was cancelled. The same call resumes it.
    Interrupted {
        /// The stage in which it stopped.
        stage: TrainingStage,
        /// Updates made in that stage.
        step: usize,
    },
}

/// The inputs of a training.
pub struct Training<'a> {
    /// The configuration.
    pub config: &'a TrainConfig,
    /// The data set.
    pub dataset: &'a Dataset,
    /// The run's directory. It contains `config.toml`, `checkpoint.safetensors`, event files for `TensorBoard`, after the first validation of
    /// the network `sample.png`, and at the end `history.json` and `model/`.
    pub run_dir: &'a Path,
    /// The command line, for the manifest.
    pub command: &'a str,
    /// The model whose weights it starts from (fine-tuning); `None` for new weights.
    pub start: Option<&'a StoredWeights>,
}

/// Starts a training, or resumes the run in `run_dir`, until it is complete or cancelled. A resumed run ends with the same
/// bits as an uninterrupted one. Errors: any of [`TrainError`]; the last checkpoint stays on disk.
pub fn run(
    training: &Training<'_>,
    observer: &mut dyn Observer,
    cancelled: &AtomicBool,
) -> Result<TrainingOutcome, TrainError> {
    let (config, dataset) = (training.config, training.dataset);
    config.validate()?;
    let files = RunFiles::check(training.run_dir, config, dataset)?;
    // Check the data before creating the directory, so that a refused training leaves no files.
    let plan = TrainingPlan::new(config, dataset)?;
    if let Some(start) = training.start {
        start::parameters(&plan.spec, start, config.seed)?;
    }
    let _lock = files.lock()?;
    let model_dir = files.path(MODEL_DIR);
    if model_dir.join(registry::MANIFEST_FILE).is_file() {
        return finished(model_dir, training.run_dir);
    }
    let interrupted = |stage, step| Ok(TrainingOutcome::Interrupted { stage, step });
    let mut state = match files.load_latest(&plan.spec, &config.run, observer)? {
        Some(state) => state,
        None => match initial_parameters(&plan, training, cancelled)? {
            Some(parameters) => TrainState::new(parameters, &config.run)?,
            None => return interrupted(TrainingStage::Pretrain, 0),
        },
    };
    for point in &state.progress.history {
        observer.on_event(TrainingEvent::Restored {
            stage: point.stage,
            step: point.step,
            train_loss: point.train_loss,
            validation_loss: point.validation_loss,
        });
    }
    observer.on_event(TrainingEvent::Started {
        stage: with_steps(state.progress.stage, config),
        step: state.progress.step,
        windows: plan.train.len(),
    });
    let reached = CheckpointPosition {
        stage: state.progress.stage,
        step: state.progress.step,
    };
    let mut journal = Journal::open(&files, reached, observer)?;
    let runner = StageRunner {
        files: &files,
        config,
        cancelled,
    };
    if state.progress.stage == TrainingStage::Pretrain {
        let codec = pretrain::CodecObjective::new(&plan, config)?;
        if runner.run(&codec, &mut state, &mut journal)? == StageEnd::Interrupted {
            return interrupted(TrainingStage::Pretrain, state.progress.step);
        }
        state.start_sequence(&config.run)?;
        runner.save(&state, &mut journal)?;
    }
    let objective = sequence::SequenceObjective::new(&plan, config);
    if runner.run(&objective, &mut state, &mut journal)? == StageEnd::Interrupted {
        return interrupted(TrainingStage::Sequence, state.progress.step);
    }
    state.restore_best()?;
    // Of a single data set, it is known already.
    let validation = match plan.mixture.len() {
        1 => Vec::new(),
        _ => objective.validation_by_part(&state.parameters)?,
    };
    let manifest = plan.manifest(training, &state, &validation)?;
    let history = serde_json::to_vec(&state.progress.history);
    let history =
        history.map_err(|error| TrainError::Config(format!("could not write the history as JSON: {error}")))?;
    let history_file = files.path(HISTORY_FILE);
    write_atomically(&history_file, &history).map_err(io_failed("write", &history_file))?;
    let manifest = Box::new(registry::publish(&model_dir, &state.parameters, &manifest)?);
    Ok(TrainingOutcome::Finished { model_dir, manifest })
}

/// The outcome of a run that was complete before. Errors: `DamagedModel`, `Registry`.
fn finished(model_dir: PathBuf, run_dir: &Path) -> Result<TrainingOutcome, TrainError> {
    match registry::load(&model_dir).and_then(|_| registry::manifest::read(&model_dir)) {
        Ok(manifest) => Ok(TrainingOutcome::Finished {
            manifest: Box::new(manifest),
            model_dir,
        }),
        Err(source) if is_transient(&source) => Err(source.into()),
        Err(source) => Err(TrainError::DamagedModel {
            run_dir: run_dir.to_owned(),
            model_dir,
            source,
        }),
    }
}

/// The stage, or the next one if it has no steps: most networks have no pre-training.
fn with_steps(stage: TrainingStage, config: &TrainConfig) -> TrainingStage {
    match stage {
        TrainingStage::Pretrain if config.pretrain.steps == 0 => TrainingStage::Sequence,
        stage => stage,
    }
}

/// The weights to start from; `None` if cancelled.
fn initial_parameters(
    plan: &TrainingPlan<'_>,
    training: &Training<'_>,
    cancelled: &AtomicBool,
) -> Result<Option<Parameters>, TrainError> {
    let config = training.config;
    if let Some(start) = training.start {
        return start::parameters(&plan.spec, start, config.seed).map(Some);
    }
    let parameters = Parameters::initialize(&plan.spec, config.seed.derive("weights", 0))?;
    if plan.spec.keeps_frames() {
        return Ok(Some(parameters));
    }
    let frames = window_frames(&plan.train, config.model.context + config.model.horizon);
    let stride = frames.len().div_ceil(MAX_PRINCIPAL_FRAMES).max(1);
    let frames: Vec<usize> = frames.into_iter().step_by(stride).collect();
    let (inputs, targets) = (plan.source.inputs(&frames)?, plan.source.targets(&frames)?);
    match config.pretrain.start {
        CodecStart::Random => random_codec::centre(&parameters, &inputs, &targets)?,
        CodecStart::Principal => {
            let seed = config.seed.derive("principal", 0);
            if !principal_components::set_codec(&parameters, &inputs, &targets, seed, cancelled)? {
                return Ok(None);
            }
        }
    }
    Ok(Some(parameters))
}
