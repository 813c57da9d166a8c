//! A run's directory: its configuration, and its last checkpoint in one safetensors file that is replaced atomically.

use std::collections::{BTreeMap, HashMap};
use std::error::Error;
use std::fs::{self, File, TryLockError};
use std::path::{Path, PathBuf};

use candle_core::{Device, Tensor};
use safetensors::SafeTensors;
use serde::{Deserialize, Serialize};

use super::TrainError;
use super::config::{RunConfig, TrainConfig};
use super::observer::{Observer, TrainingEvent, TrainingStage};
use super::optimizer::Optimizer;
use super::state::{TrainProgress, TrainState};
use foreframe_core::files::{
    is_partial_of, none_if_missing, remove_stale_partials, sha256_hex, try_lock, write_atomically,
};
use foreframe_core::nn::{ModelSpec, Parameters};
use foreframe_data::dataset::Dataset;

/// Name of the checkpoint file of a run.
pub const CHECKPOINT_FILE: &str = "checkpoint.safetensors";
/// The checkpoint before it. A training resumes from this one if the latest is damaged.
const PREVIOUS_FILE: &str = "checkpoint.previous.safetensors";
/// The length of a SHA-256 in hexadecimal digits.
const HASH_LENGTH: usize = 64;
/// Key of the training state in the file's metadata: the file's SHA-256, a space, and the state as JSON. The hash is computed
/// with zeros in its own place. Both are in one entry, because the order of entries is random.
const META_KEY: &str = "foreframe.training";
/// Name of the file with the configuration.
const CONFIG_FILE: &str = "config.toml";
/// Name of the file with the loss curves.
pub(super) const HISTORY_FILE: &str = "history.json";
/// Name of the folder with the published model.
pub(super) const MODEL_DIR: &str = "model";
/// Name of the file with the hash of the training data and, after it, its description.
const DATA_FILE: &str = "dataset.sha256";
const PARAMETERS: &str = "parameters.";
const BEST: &str = "best.";
const OPTIMIZER: &str = "optimizer.";

/// The directory of one run.
pub(super) struct RunFiles {
    run_dir: PathBuf,
    config_text: String,
    content_hash: String,
    /// What the hash of the content leaves out: camera, channels, frame size and period.
    description: String,
}

impl RunFiles {
    /// Checks that the directory is unused, or contains a run with the same configuration and data. Writes nothing.
    /// Errors: `NotARun`, `OtherRun`, `Io`.
    pub(super) fn check(run_dir: &Path, config: &TrainConfig, dataset: &Dataset) -> Result<Self, TrainError> {
        let files = Self {
            run_dir: run_dir.to_owned(),
            config_text: config.to_toml()?,
            content_hash: dataset.info().content_hash.clone(),
            description: dataset.description(),
        };
        let (config, data) = (files.path(CONFIG_FILE), files.path(DATA_FILE));
        if config.is_file() && data.is_file() {
            let read = |path: &Path| fs::read_to_string(path).map_err(io_failed("read", path));
            let (found, run_dir) = (read(&data)?, run_dir.to_owned());
            if read(&config)? != files.config_text {
                let what = "configuration";
                return Err(TrainError::OtherRun { run_dir, what });
            }
            let (content, description) = found.split_once('\n').unwrap_or((&found, ""));
            if content != files.content_hash {
                let what = "data set";
                return Err(TrainError::OtherRun { run_dir, what });
            }
            // A run of an earlier program has no description.
            if !description.is_empty() && description != files.description {
                return Err(TrainError::OtherDescription {
                    run_dir,
                    dataset: dataset.info().name.clone(),
                });
            }
            return Ok(files);
        }
        let is_left_by_a_killed_start =
            |path: &Path| path == data || is_partial_of(&data, path) || is_partial_of(&config, path);
        let is_occupied = fs::read_dir(run_dir).is_ok_and(|mut entries| {
            entries.any(|entry| entry.is_ok_and(|entry| !is_left_by_a_killed_start(&entry.path())))
        });
        if is_occupied || run_dir.is_file() {
            return Err(TrainError::NotARun(run_dir.to_owned()));
        }
        Ok(files)
    }

    /// Creates the directory of a new run, if needed, and locks it until the returned file is dropped. Errors: `Busy`, `Io`.
    pub(super) fn lock(&self) -> Result<File, TrainError> {
        let (config, data) = (self.path(CONFIG_FILE), self.path(DATA_FILE));
        if !config.is_file() {
            fs::create_dir_all(&self.run_dir).map_err(io_failed("create", &self.run_dir))?;
            let text = format!("{}\n{}", self.content_hash, self.description);
            write_atomically(&data, text.as_bytes()).map_err(io_failed("write", &data))?;
            write_atomically(&config, self.config_text.as_bytes()).map_err(io_failed("write", &config))?;
        }
        let lock = File::open(&config).map_err(io_failed("read", &config))?;
        match try_lock(&lock) {
            Ok(()) => {
                remove_stale_partials(&self.run_dir);
                Ok(lock)
            }
            Err(TryLockError::WouldBlock) => Err(TrainError::Busy(self.run_dir.clone())),
            Err(TryLockError::Error(source)) => Err(io_failed("lock", &config)(source)),
        }
    }

    /// Identifies configuration and data. A checkpoint can be resumed only with the same fingerprint.
    fn fingerprint(&self) -> String {
        sha256_hex(format!("{}\n{}\n{}", self.config_text, self.content_hash, self.description).as_bytes())
    }

    /// The same without the description, as an earlier program wrote it.
    fn earlier_fingerprint(&self) -> String {
        sha256_hex(format!("{}\n{}", self.config_text, self.content_hash).as_bytes())
    }

    /// The directory.
    pub(super) fn run_dir(&self) -> &Path {
        &self.run_dir
    }

    /// The path of a file or folder of the run.
    pub(super) fn path(&self, name: &str) -> PathBuf {
        self.run_dir.join(name)
    }
}

pub(super) fn io_failed(action: &'static str, path: &Path) -> impl FnOnce(std::io::Error) -> TrainError + use<> {
    let path = path.to_owned();
    move |source| TrainError::Io { action, path, source }
}

/// The training state without the tensors.
#[derive(Serialize, Deserialize)]
struct CheckpointMeta {
    fingerprint: String,
    #[serde(flatten)]
    progress: TrainProgress,
}

/// How far a training is. A later position is greater.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Deserialize)]
pub struct CheckpointPosition {
    /// The stage.
    pub stage: TrainingStage,
    /// Completed updates of the stage.
    pub step: usize,
}

impl CheckpointPosition {
    /// The position of the checkpoint in these bytes; none if they are not a checkpoint.
    #[must_use]
    pub fn of(checkpoint: &[u8]) -> Option<Self> {
        if !is_intact(checkpoint) {
            return None;
        }
        let (_, header) = SafeTensors::read_metadata(checkpoint).ok()?;
        serde_json::from_str(state_text(header.metadata().as_ref()?.get(META_KEY)?)?).ok()
    }
}

/// Where the hash of a checkpoint is in its bytes.
fn hash_range(checkpoint: &[u8]) -> Option<std::ops::Range<usize>> {
    let length = u64::from_le_bytes(*checkpoint.first_chunk::<8>()?);
    let header = checkpoint.get(8..usize::try_from(length).ok()?.checked_add(8)?)?;
    let key = format!("\"{META_KEY}\":\"");
    let start = header.windows(key.len()).position(|part| part == key.as_bytes())? + 8 + key.len();
    let range = start..start + HASH_LENGTH;
    checkpoint.get(range.clone()).map(|_| range)
}

/// The hash of a checkpoint, with zeros in its own place.
fn hash_of(checkpoint: &[u8], range: &std::ops::Range<usize>) -> String {
    let mut bytes = checkpoint.to_vec();
    if let Some(digits) = bytes.get_mut(range.clone()) {
        digits.fill(b'0');
    }
    sha256_hex(&bytes)
}

/// Whether a checkpoint has the bytes that were written.
fn is_intact(checkpoint: &[u8]) -> bool {
    hash_range(checkpoint)
        .is_some_and(|range| checkpoint.get(range.clone()) == Some(hash_of(checkpoint, &range).as_bytes()))
}

/// Writes the hash into a checkpoint whose metadata has zeros in its place.
#[must_use]
pub fn seal(mut checkpoint: Vec<u8>) -> Vec<u8> {
    if let Some(range) = hash_range(&checkpoint) {
        let hash = hash_of(&checkpoint, &range);
        if let Some(digits) = checkpoint.get_mut(range) {
            digits.copy_from_slice(hash.as_bytes());
        }
    }
    checkpoint
}

/// The metadata entry of a training state, with zeros for the hash that [`seal`] fills in.
#[must_use]
pub fn state_entry(state: &str) -> (String, String) {
    (META_KEY.to_owned(), format!("{} {state}", "0".repeat(HASH_LENGTH)))
}

/// The JSON text in a [`state_entry`].
fn state_text(entry: &str) -> Option<&str> {
    entry.get(HASH_LENGTH + 1..)
}

impl RunFiles {
    /// Replaces the run's checkpoint with this state. Errors: `Io`, `Checkpoint`.
    pub(super) fn save(&self, state: &TrainState) -> Result<(), TrainError> {
        let path = self.path(CHECKPOINT_FILE);
        let failed = |error: &dyn Error| unusable(&path, error.to_string());
        let meta = CheckpointMeta {
            fingerprint: self.fingerprint(),
            progress: state.progress.clone(),
        };
        let text = serde_json::to_string(&meta).map_err(|error| failed(&error))?;
        let groups = [
            (PARAMETERS, state.parameters.snapshot()?),
            (BEST, state.best.clone()),
            (OPTIMIZER, state.optimizer.export()?),
        ];
        let tensors: BTreeMap<String, Tensor> = groups
            .into_iter()
            .flat_map(|(prefix, tensors)| {
                tensors
                    .into_iter()
                    .map(move |(name, tensor)| (format!("{prefix}{name}"), tensor))
            })
            .collect();
        let metadata = HashMap::from([state_entry(&text)]);
        let bytes = safetensors::serialize(&tensors, Some(metadata)).map_err(|error| failed(&error))?;
        // If the process is killed between the two, the previous one is the latest.
        none_if_missing(fs::rename(&path, self.path(PREVIOUS_FILE))).map_err(io_failed("rename", &path))?;
        write_atomically(&path, &seal(bytes)).map_err(io_failed("write", &path))
    }

    /// The state in the run's last intact checkpoint, if it has one. Reports damaged ones to the observer.
    /// Errors: `Checkpoint` if it is of another run, `Io`.
    pub(super) fn load_latest(
        &self,
        spec: &ModelSpec,
        run: &RunConfig,
        observer: &mut dyn Observer,
    ) -> Result<Option<TrainState>, TrainError> {
        for (path, is_previous) in [(self.path(CHECKPOINT_FILE), false), (self.path(PREVIOUS_FILE), true)] {
            let Some(bytes) = none_if_missing(fs::read(&path)).map_err(io_failed("read", &path))? else {
                continue;
            };
            if is_intact(&bytes) {
                let state = self.load(&bytes, spec, run);
                return state.map(Some).map_err(|reason| unusable(&path, reason));
            }
            observer.on_event(TrainingEvent::CheckpointDamaged { is_previous });
            // The next save must not replace the intact one by it.
            none_if_missing(fs::remove_file(&path)).map_err(io_failed("delete", &path))?;
        }
        Ok(None)
    }

    /// The state in an intact checkpoint. Errors: a sentence, for example if it is of another run.
    fn load(&self, bytes: &[u8], spec: &ModelSpec, run: &RunConfig) -> Result<TrainState, String> {
        let (_, header) = SafeTensors::read_metadata(bytes).map_err(|error| error.to_string())?;
        let text = header
            .metadata()
            .as_ref()
            .and_then(|metadata| state_text(metadata.get(META_KEY)?))
            .ok_or("it contains no training state")?;
        let meta: CheckpointMeta = serde_json::from_str(text).map_err(|error| error.to_string())?;
        if ![self.fingerprint(), self.earlier_fingerprint()].contains(&meta.fingerprint) {
            return Err("it belongs to another run".to_owned());
        }
        let tensors = candle_core::safetensors::load_buffer(bytes, &Device::Cpu).map_err(|error| error.to_string())?;
        let group = |prefix: &str| -> BTreeMap<String, Tensor> {
            tensors
                .iter()
                .filter_map(|(name, tensor)| Some((name.strip_prefix(prefix)?.to_owned(), tensor.clone())))
                .collect()
        };
        let weights = |prefix| Parameters::from_tensors(spec, group(prefix)).map_err(|error| error.to_string());
        let parameters = weights(PARAMETERS)?;
        let optimizer = Optimizer::import(run.optimizer(), &group(OPTIMIZER), &parameters);
        Ok(TrainState {
            progress: meta.progress,
            optimizer: optimizer.map_err(|error| error.to_string())?,
            best: weights(BEST)?.snapshot().map_err(|error| error.to_string())?,
            parameters,
        })
    }
}

fn unusable(path: &Path, reason: String) -> TrainError {
    let path = path.to_owned();
    TrainError::Checkpoint { path, reason }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_flipped_bit_damages_a_checkpoint() {
        let tensor = Tensor::zeros((2, 3), candle_core::DType::F32, &Device::Cpu).unwrap();
        let metadata = HashMap::from([state_entry(r#"{"stage":"sequence","step":7}"#)]);
        let bytes = seal(safetensors::serialize([("a", tensor)], Some(metadata)).unwrap());
        assert_eq!(CheckpointPosition::of(&bytes).map(|reached| reached.step), Some(7));
        for index in 0..bytes.len() {
            let mut damaged = bytes.clone();
            damaged[index] ^= 4;
            assert!(CheckpointPosition::of(&damaged).is_none(), "byte {index}");
        }
        assert!(CheckpointPosition::of(&bytes[..bytes.len() - 1]).is_none());
    }
}
