//! The memory of jobs: the default limits, and an estimate of what a training needs.

use serde::{Deserialize, Serialize};

use super::{JobError, TrainSpec, datasets};
use crate::store::Objects;
use foreframe_core::error_text;
use foreframe_core::registry::Manifest;
use foreframe_data::dataset::DatasetInfo;
use foreframe_train::training::config::{ArchitectureConfig, CodecStart};
use foreframe_train::training::{self, TrainConfig, TrainError};

const MIB: u64 = 1 << 20;
/// Bytes of an f32.
const VALUE: u64 = 4;
/// Copies of the weights: weights, best weights, gradients, two moments, and a checkpoint of four of these.
const WEIGHT_COPIES: u64 = 9;
/// Values for each pixel and frame of a batch: input, target and prediction.
const PIXEL_VALUES: u64 = 3;
/// Values for each hidden unit and frame of a batch that the backward pass needs: gates, cell and hidden state.
const HIDDEN_VALUES: u64 = 10;
/// How many frames the principal components are computed from at most, and how many copies of them are made.
const PRINCIPAL_FRAMES: u64 = 8192;
const PRINCIPAL_COPIES: u64 = 4;

/// Bytes that a training keeps of each frame besides its pixels: its time, its window, and its places in the order of draws.
const FRAME_BYTES: u64 = 8 + 16 + 16;
/// The default of `dataset_memory_mib` where the memory of the machine is unknown.
const DEFAULT_DATASET_MIB: u64 = 1024;

/// The memory of one job.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct JobMemory {
    /// What it can use, in MiB; 0 for no limit.
    pub limit_mib: u64,
    /// What the frames of a data set can use, in MiB; those of a larger data set stay in a file.
    pub dataset_mib: u64,
}

impl JobMemory {
    /// What the frames of a data set can use in a job, in MiB: never more than a third of the job's limit.
    #[must_use]
    pub fn held_mib(self) -> u64 {
        match self.limit_mib {
            0 => self.dataset_mib,
            limit => self.dataset_mib.min(limit / 3),
        }
    }

    /// What a training will need, without starting it; `base` is the model that it starts from, if it names one. Errors: `Invalid`,
    /// `NotFound`, and those of reading the data sets.
    pub(super) async fn estimate(
        self,
        spec: &TrainSpec,
        base: Option<&Manifest>,
        objects: &Objects,
    ) -> Result<TrainingEstimate, JobError> {
        let mut dataset = datasets::describe(objects, &spec.dataset).await?;
        for name in spec.mixture.keys() {
            dataset.frame_count += datasets::describe(objects, name).await?.frame_count;
        }
        let mut trainings = spec.parts();
        if trainings.is_empty() {
            trainings.push(spec.clone());
        }
        let (mut steps, mut memory_mib) = (0, 0);
        for training in trainings {
            let mut config = training.config(base)?;
            if base.is_some() {
                // Only new weights are computed from principal components.
                config.pretrain.start = CodecStart::Random;
            }
            steps += config.pretrain.steps + config.sequence.steps;
            memory_mib = memory_mib.max(training_mib(&config, &dataset, self.held_mib())?);
        }
        Ok(TrainingEstimate {
            steps,
            memory_mib,
            memory_limit_mib: self.limit_mib,
        })
    }

    /// Errors: `Invalid` if a training certainly needs more memory than a job can use, and those of an estimate.
    pub(super) async fn check(
        self,
        spec: &TrainSpec,
        base: Option<&Manifest>,
        objects: &Objects,
    ) -> Result<(), JobError> {
        self.check_needed(self.estimate(spec, base, objects).await?.memory_mib)
    }

    /// Errors: `Invalid` if a training on such a data set certainly needs more memory than a job can use.
    pub(super) fn check_training(self, config: &TrainConfig, dataset: &DatasetInfo) -> Result<(), JobError> {
        self.check_needed(training_mib(config, dataset, self.held_mib())?)
    }

    fn check_needed(self, needed: u64) -> Result<(), JobError> {
        let allowed = self.limit_mib;
        if allowed == 0 || needed <= allowed {
            return Ok(());
        }
        let reason = format!(
            "the training needs at least {needed} MiB of memory, and a job can use {allowed} MiB (setting job_memory_mib); \
             use a smaller model or batch"
        );
        Err(JobError::invalid("settings", reason))
    }
}

/// What a training will need.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, utoipa::ToSchema)]
pub struct TrainingEstimate {
    /// Updates of both stages, of all trainings of a sweep.
    pub steps: usize,
    /// The least memory that it needs, in MiB; of a sweep, what its largest training needs. What is hard to know is left out.
    pub memory_mib: u64,
    /// The memory that a job can use, in MiB; 0 for no limit. A training that needs more is refused.
    pub memory_limit_mib: u64,
}

impl Default for JobMemory {
    fn default() -> Self {
        Self {
            limit_mib: 0,
            dataset_mib: default_dataset_mib(),
        }
    }
}

/// A quarter of the memory that this process can use, in MiB.
#[must_use]
pub fn default_dataset_mib() -> u64 {
    match default_limit_mib() {
        0 => DEFAULT_DATASET_MIB,
        limit => limit / 3,
    }
}

/// Three quarters of the memory that this process can use, in MiB; 0 if that is unknown.
#[must_use]
pub fn default_limit_mib() -> u64 {
    let limits = [machine_bytes(), cgroup_bytes()];
    limits
        .into_iter()
        .flatten()
        .min()
        .map_or(0, |bytes| bytes / MIB * 3 / 4)
}

fn machine_bytes() -> Option<u64> {
    let text = std::fs::read_to_string("/proc/meminfo").ok()?;
    let line = text.lines().find_map(|line| line.strip_prefix("MemTotal:"))?;
    let kib: u64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    Some(kib << 10)
}

/// The memory limit of this process's control group, or of the group that its container shows as the root.
fn cgroup_bytes() -> Option<u64> {
    let group = std::fs::read_to_string("/proc/self/cgroup").unwrap_or_default();
    let path = group.lines().find_map(|line| line.strip_prefix("0::")).unwrap_or("/");
    let files = [
        format!("/sys/fs/cgroup{path}/memory.max"),
        "/sys/fs/cgroup/memory.max".to_owned(),
        "/sys/fs/cgroup/memory/memory.limit_in_bytes".to_owned(),
    ];
    let limits = files
        .iter()
        .filter_map(|file| std::fs::read_to_string(file).ok()?.trim().parse().ok());
    limits.min()
}

/// Values that the flow network keeps for each pixel of a window's frames until the gradients are computed.
const FLOW_PIXEL_VALUES: u64 = 60;
/// The same of the sprite network.
const SPRITE_PIXEL_VALUES: u64 = 40;

/// The least memory that a training on a data set needs, in MiB, if it holds at most `held_mib` MiB of frames. It leaves out
/// what is hard to know, so a training that passes this check can still reach its limit. Errors: `Invalid` if there is no such network.
fn training_mib(config: &TrainConfig, dataset: &DatasetInfo, held_mib: u64) -> Result<u64, JobError> {
    let weights = training::parameter_count(config, dataset).map_err(|error| {
        let field = match error {
            TrainError::Config(_) => "dataset",
            _ => "settings",
        };
        JobError::invalid(field, error_text::with_causes(&error))
    })?;
    let count = |value: usize| value as u64;
    let pixels = u64::from(dataset.frame_width_px) * u64::from(dataset.frame_height_px);
    let frames = dataset.frame_count as u64;
    let (features, frame_values) = match config.model.architecture {
        ArchitectureConfig::Dense(sizes) => {
            let (features, hidden) = (count(sizes.features), count(sizes.hidden));
            (features, PIXEL_VALUES * pixels + 2 * features + HIDDEN_VALUES * hidden)
        }
        ArchitectureConfig::Flow(_) => (0, FLOW_PIXEL_VALUES * pixels),
        ArchitectureConfig::Sprites(_) => (0, SPRITE_PIXEL_VALUES * pixels),
    };
    let weights = VALUE * WEIGHT_COPIES * weights;
    let window = count(config.model.context + config.model.horizon);
    let sequence_frames = count(config.sequence.batch_size) * window;
    let sequence = VALUE * sequence_frames * frame_values;
    let pretrain = VALUE * count(config.pretrain.batch_size) * (PIXEL_VALUES * pixels + features);
    let principal = match config.pretrain.start {
        CodecStart::Principal => VALUE * PRINCIPAL_COPIES * PRINCIPAL_FRAMES.min(frames) * pixels,
        CodecStart::Random => 0,
    };
    let work = [sequence, pretrain, principal].into_iter().max().unwrap_or(0);
    let decoded = dataset.decoded_bytes();
    let held = if decoded <= held_mib * MIB { decoded } else { 0 };
    let channels = count(dataset.action_channels.len() + dataset.state_channels.len());
    let numbers = frames * (FRAME_BYTES + VALUE * channels);
    Ok((held + numbers + weights + work).div_ceil(MIB))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_default_limit_is_below_the_memory_of_the_machine() {
        if let Some(bytes) = machine_bytes() {
            assert!((1..bytes / MIB).contains(&default_limit_mib()));
        }
    }

    fn frames(count: usize) -> DatasetInfo {
        DatasetInfo {
            frame_width_px: 64,
            frame_height_px: 64,
            frame_period_s: 0.2,
            frame_count: count,
            ..DatasetInfo::default()
        }
    }

    #[test]
    fn frames_in_a_file_need_no_memory() {
        let config = TrainConfig::layered("paper", None, &[]).unwrap();
        let needed = |count| training_mib(&config, &frames(count), 1024).unwrap();
        let (small, held, large) = (needed(10_000), needed(262_144), needed(300_000));
        assert!((small + 900..small + 1024).contains(&held), "{small} {held}");
        assert!(
            large < small,
            "39 MiB of frames in memory, none in the file: {small} {large}"
        );
    }

    #[test]
    fn a_job_holds_at_most_a_third_of_its_limit() {
        let held = |limit_mib| JobMemory {
            limit_mib,
            dataset_mib: 1000,
        };
        assert_eq!([0, 600, 9000].map(|limit| held(limit).held_mib()), [1000, 200, 1000]);
    }

    #[test]
    fn a_huge_training_needs_more_than_a_usual_one() {
        let dataset = frames(1000);
        let usual = TrainConfig::layered("paper", None, &[]).unwrap();
        let huge = "[model]\nhidden = 2048\nfeatures = 2048\n[sequence]\nbatch_size = 4096\n";
        let huge = TrainConfig::layered("paper", Some(huge), &[]).unwrap();
        let (usual, huge) = (
            training_mib(&usual, &dataset, 1024).unwrap(),
            training_mib(&huge, &dataset, 1024).unwrap(),
        );
        assert!(usual < 2048 && huge > 4096, "{usual} {huge}");
    }

    #[test]
    fn the_weights_of_every_network_count() {
        let dataset = frames(1000);
        let of = |toml: &str| {
            let config = TrainConfig::layered("moving-mnist", Some(toml), &[]).unwrap();
            training_mib(&config, &dataset, 1024)
        };
        // 75 million parameters: 2.7 GB with gradients, moments and copies.
        let wide = of("[model.sprites]\nchannels = 512\nencoder_blocks = 16\n").unwrap();
        assert!((2500..3500).contains(&wide), "{wide}");
        let refused = of("[model.sprites]\nchannels = 0\n").unwrap_err().to_string();
        assert!(refused.contains("sprites.channels"), "{refused}");
    }
}
