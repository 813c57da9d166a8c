//! A run's directory: its configuration, and the state of its last checkpoint in one safetensors file, replaced whole.

use std::collections::{BTreeMap, HashMap};
use std::fs::{self, File, TryLockError};
use std::path::{Path, PathBuf};

use candle_core::{Device, Tensor};
use safetensors::SafeTensors;
use serde::{Deserialize, Serialize};

use super::TrainError;
use super::config::{RunConfig, TrainConfig};
use super::observer::TrainingStage;
use super::optimizer::Adam;
use super::stage::{HistoryPoint, TrainState};
use crate::files::{is_partial_of, remove_stale_partials, sha256_hex, write_atomically};
use crate::nn::{ModelSpec, Parameters};

/// The file of a run that says how far it is.
pub const CHECKPOINT_FILE: &str = "checkpoint.safetensors";
/// The key of the state's numbers in the file's metadata.
const META_KEY: &str = "foreframe.training";
/// Names the data that the run trains on.
const DATA_FILE: &str = "dataset.sha256";
const PARAMETERS: &str = "parameters.";
const BEST: &str = "best.";
const OPTIMIZER: &str = "optimizer.";

/// The directory of one run.
pub(super) struct RunFiles {
    run_dir: PathBuf,
    config_text: String,
    content_hash: String,
}

impl RunFiles {
    /// Checks that the directory is free, or that the run in it is of the same configuration and data; writes nothing.
    /// Errors: `NotARun`, `OtherRun`, `Io`.
    pub(super) fn check(run_dir: &Path, config: &TrainConfig, content_hash: &str) -> Result<Self, TrainError> {
        let files = Self {
            run_dir: run_dir.to_owned(),
            config_text: config.to_toml()?,
            content_hash: content_hash.to_owned(),
        };
        if files.config().is_file() && files.data().is_file() {
            for (path, expected, what) in [
                (files.config(), &files.config_text, "configuration"),
                (files.data(), &files.content_hash, "data set"),
            ] {
                if fs::read_to_string(&path).map_err(io_failed("read", &path))? != *expected {
                    return Err(TrainError::OtherRun {
                        run_dir: run_dir.to_owned(),
                        what,
                    });
                }
            }
            return Ok(files);
        }
        let (config, data) = (files.config(), files.data());
        let left_by_a_killed_start =
            |path: &Path| path == data || is_partial_of(&data, path) || is_partial_of(&config, path);
        let is_occupied = fs::read_dir(run_dir).is_ok_and(|mut entries| {
            entries.any(|entry| entry.is_ok_and(|entry| !left_by_a_killed_start(&entry.path())))
        });
        if is_occupied || run_dir.is_file() {
            return Err(TrainError::NotARun(run_dir.to_owned()));
        }
        Ok(files)
    }

    /// Makes the directory of a new run. Nobody else trains in it until the file is dropped. Errors: `Busy`, `Io`.
    pub(super) fn claim(&self) -> Result<File, TrainError> {
        let (config, data) = (self.config(), self.data());
        if !config.is_file() {
            fs::create_dir_all(&self.run_dir).map_err(io_failed("make", &self.run_dir))?;
            write_atomically(&data, self.content_hash.as_bytes()).map_err(io_failed("write", &data))?;
            write_atomically(&config, self.config_text.as_bytes()).map_err(io_failed("write", &config))?;
        }
        let lock = File::open(&config).map_err(io_failed("read", &config))?;
        match lock.try_lock() {
            Ok(()) => {
                remove_stale_partials(&self.run_dir);
                Ok(lock)
            }
            Err(TryLockError::WouldBlock) => Err(TrainError::Busy(self.run_dir.clone())),
            Err(TryLockError::Error(source)) => Err(io_failed("lock", &config)(source)),
        }
    }

    /// What two runs must share for one to go on from the other's checkpoint.
    fn fingerprint(&self) -> String {
        sha256_hex(format!("{}\n{}", self.config_text, self.content_hash).as_bytes())
    }

    fn config(&self) -> PathBuf {
        self.run_dir.join("config.toml")
    }

    fn data(&self) -> PathBuf {
        self.run_dir.join(DATA_FILE)
    }

    /// Where the trained model is published.
    pub(super) fn model_dir(&self) -> PathBuf {
        self.run_dir.join("model")
    }

    /// Where the loss curves are written.
    pub(super) fn history(&self) -> PathBuf {
        self.run_dir.join("history.json")
    }

    fn checkpoint(&self) -> PathBuf {
        self.run_dir.join(CHECKPOINT_FILE)
    }
}

fn io_failed(action: &'static str, path: &Path) -> impl Fn(std::io::Error) -> TrainError {
    let path = path.to_owned();
    move |source| TrainError::Io {
        action,
        path: path.clone(),
        source,
    }
}

/// The numbers beside the tensors.
#[derive(Serialize, Deserialize)]
struct CheckpointMeta {
    fingerprint: String,
    stage: TrainingStage,
    step: usize,
    best_step: usize,
    best_loss: Option<f64>,
    history: Vec<HistoryPoint>,
}

/// How far a training is: the later, the greater.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Deserialize)]
pub struct CheckpointPosition {
    /// In this stage.
    pub stage: TrainingStage,
    /// Updates made in it.
    pub step: usize,
}

impl CheckpointPosition {
    /// How far the training was whose checkpoint these bytes are; none if they are no checkpoint.
    #[must_use]
    pub fn of(checkpoint: &[u8]) -> Option<Self> {
        let (_, header) = SafeTensors::read_metadata(checkpoint).ok()?;
        serde_json::from_str(header.metadata().as_ref()?.get(META_KEY)?).ok()
    }
}

/// A training's state as read from disk.
pub(super) struct Checkpoint {
    state: TrainState,
}

impl Checkpoint {
    /// Replaces the run's checkpoint by this state. Errors: `Io`, `Checkpoint`.
    pub(super) fn save(files: &RunFiles, state: &TrainState) -> Result<(), TrainError> {
        let path = files.checkpoint();
        let meta = CheckpointMeta {
            fingerprint: files.fingerprint().clone(),
            stage: state.stage,
            step: state.step,
            best_step: state.best_step,
            best_loss: state.best_loss,
            history: state.history.clone(),
        };
        let failed = |reason: String| TrainError::Checkpoint {
            path: path.clone(),
            reason,
        };
        let text = serde_json::to_string(&meta).map_err(|error| failed(error.to_string()))?;
        let prefixed = |prefix: &'static str, tensors: BTreeMap<String, Tensor>| {
            tensors
                .into_iter()
                .map(move |(name, tensor)| (format!("{prefix}{name}"), tensor))
        };
        let tensors: BTreeMap<String, Tensor> = prefixed(PARAMETERS, state.parameters.snapshot()?)
            .chain(prefixed(BEST, state.best.clone()))
            .chain(prefixed(OPTIMIZER, state.optimizer.export()?))
            .collect();
        let bytes = safetensors::serialize(&tensors, Some(HashMap::from([(META_KEY.to_owned(), text)])))
            .map_err(|error| failed(error.to_string()))?;
        write_atomically(&path, &bytes).map_err(io_failed("write", &path))
    }

    /// The run's last checkpoint, if it has one. Errors: `Checkpoint` if it is damaged or of another run.
    pub(super) fn load(files: &RunFiles, spec: &ModelSpec, run: &RunConfig) -> Result<Option<Self>, TrainError> {
        let path = files.checkpoint();
        if !path.is_file() {
            return Ok(None);
        }
        let failed = |reason: String| TrainError::Checkpoint {
            path: path.clone(),
            reason,
        };
        let bytes = fs::read(&path).map_err(io_failed("read", &path))?;
        let (_, header) = SafeTensors::read_metadata(&bytes).map_err(|error| failed(error.to_string()))?;
        let text = header
            .metadata()
            .as_ref()
            .and_then(|metadata| metadata.get(META_KEY))
            .ok_or_else(|| failed("it carries no training state".to_owned()))?;
        let meta: CheckpointMeta = serde_json::from_str(text).map_err(|error| failed(error.to_string()))?;
        if meta.fingerprint != files.fingerprint() {
            return Err(failed("it belongs to another run".to_owned()));
        }
        let tensors = candle_core::safetensors::load_buffer(&bytes, &Device::Cpu)?;
        let group = |prefix: &str| -> BTreeMap<String, Tensor> {
            tensors
                .iter()
                .filter_map(|(name, tensor)| Some((name.strip_prefix(prefix)?.to_owned(), tensor.clone())))
                .collect()
        };
        let misfit = |error: crate::nn::NnError| failed(error.to_string());
        let parameters = Parameters::from_tensors(spec, group(PARAMETERS)).map_err(misfit)?;
        let optimizer = Adam::import(run.adam(), &group(OPTIMIZER), &parameters).map_err(|e| failed(e.to_string()))?;
        let state = TrainState {
            stage: meta.stage,
            step: meta.step,
            parameters,
            optimizer,
            best: Parameters::from_tensors(spec, group(BEST))
                .map_err(misfit)?
                .snapshot()?,
            best_step: meta.best_step,
            best_loss: meta.best_loss,
            history: meta.history,
        };
        Ok(Some(Self { state }))
    }

    /// The state to go on from.
    pub(super) fn into_state(self) -> TrainState {
        self.state
    }
}
