//! Makes a data set of moving digits, as Moving MNIST, from files of digits. What is on disk depends only on the digits, the
//! seed and the numbers of trials and frames; if it is stopped, the same call continues after the last whole shard.
//!
//! Such a data set is split by whole trials in their order (see [`sampler`](crate::dataset::sampler)), so the last tenth of the trials
//! gets the digits for test, the tenth before it those for validation.

use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};

use rand::seq::IndexedRandom;
use rayon::prelude::*;
use serde::Serialize;

use super::config::{CollectProgress, DEFAULT_TRIALS_PER_SHARD, ShardTrials};
use super::digits::DigitPools;
use crate::dataset::store::arguments::{arguments_text, has_arguments, lock};
use crate::dataset::store::layout::INFO;
use crate::dataset::store::preview::describe;
use crate::dataset::store::shard::EncodedEpisode;
use crate::dataset::store::writer::ShardWriter;
use crate::dataset::{DatasetError, DatasetInfo, EpisodeData, Split};
use foreframe_core::types::Seed;
use foreframe_sim::moving_digits::{DIGITS_FRAME_SIDE_PX, moving_digits};

/// The scenario's name, on the command line and on disk.
pub const MOVING_MNIST: &str = "moving-mnist";
/// Frames of a trial of the published test set.
pub const DEFAULT_FRAMES: usize = 20;
/// Seconds from one frame to the next. The benchmark knows none; with it, 20 frames last two seconds.
pub const DIGITS_FRAME_PERIOD_S: f64 = 0.1;
/// Digits of a trial.
const DIGITS: usize = 2;
/// A data set of fewer trials would be split within its trials.
const MIN_TRIALS: u64 = 10;
/// Longest trial, in frames.
pub const MAX_FRAMES: usize = 1000;

/// What to make. The fields that determine the bytes are written to the directory, in this order.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct MovingMnistConfig {
    /// An IDX file of digits, or a folder with IDX files or PNG images.
    #[serde(skip)]
    pub digits: PathBuf,
    /// Number of trials, at least 10.
    pub trials: u64,
    /// Frames of a trial, 2 to [`MAX_FRAMES`].
    pub frames: usize,
    /// The seed from which the seed of every trial is derived.
    pub seed: Seed,
    /// The data set's directory.
    #[serde(skip)]
    pub out: PathBuf,
}

impl MovingMnistConfig {
    fn validate(&self) -> Result<(), DatasetError> {
        let Self { trials, frames, .. } = self;
        let wrong = if *trials < MIN_TRIALS {
            format!(
                "{trials} trials are too few; moving digits need at least {MIN_TRIALS}, a tenth of them for testing"
            )
        } else if !(2..=MAX_FRAMES).contains(frames) {
            format!("a trial of {frames} frames is out of range; it must have 2 to {MAX_FRAMES}")
        } else {
            return Ok(());
        };
        Err(DatasetError::Invalid(wrong))
    }

    /// The split to which a trial will belong.
    fn split_of(&self, trial: u64) -> Split {
        let tenth = self.trials.div_ceil(10);
        match self.trials - trial {
            left if left <= tenth => Split::Test,
            left if left <= 2 * tenth => Split::Validation,
            _ => Split::Train,
        }
    }

    fn info(&self) -> DatasetInfo {
        DatasetInfo {
            name: format!("{MOVING_MNIST}-{}-seed-{}", self.trials, self.seed.0),
            frame_width_px: DIGITS_FRAME_SIDE_PX as u32,
            frame_height_px: DIGITS_FRAME_SIDE_PX as u32,
            frame_period_s: DIGITS_FRAME_PERIOD_S,
            scenario: Some(MOVING_MNIST.to_owned()),
            seed: Some(self.seed),
            ..DatasetInfo::default()
        }
    }

    fn trial(&self, pools: &DigitPools, trial: u64) -> EpisodeData {
        let mut random = self.seed.derive(MOVING_MNIST, trial).rng();
        let pool = pools.of(self.split_of(trial));
        let digits: Vec<_> = (0..DIGITS).filter_map(|_| pool.choose(&mut random)).collect();
        EpisodeData {
            timestamps_s: (0..self.frames)
                .map(|frame| frame as f64 * DIGITS_FRAME_PERIOD_S)
                .collect(),
            pixels: moving_digits(&digits, self.frames, &mut random),
            ..EpisodeData::default()
        }
    }
}

/// The arguments that determine the bytes. They are written first.
#[derive(Serialize)]
struct MovingMnistArguments<'a> {
    scenario: &'static str,
    digits_sha256: &'a str,
    #[serde(flatten)]
    config: &'a MovingMnistConfig,
}

/// Makes the data set, or continues. Returns at once if it is complete.
/// Errors: `Invalid`, `OutExists`, `OtherArguments`, `Busy`, `Cancelled`, `Io`.
pub fn collect_digits(
    config: &MovingMnistConfig,
    on_progress: &(dyn Fn(CollectProgress) + Sync),
    cancelled: &AtomicBool,
) -> Result<DatasetInfo, DatasetError> {
    config.validate()?;
    let pools = DigitPools::read(&config.digits)?;
    let arguments = arguments_text(&MovingMnistArguments {
        scenario: MOVING_MNIST,
        digits_sha256: &pools.hash(),
        config,
    });
    has_arguments(&config.out, &arguments)?;
    let _lock = lock(&config.out, &arguments)?;
    if config.out.join(INFO).exists() {
        return describe(&config.out);
    }
    let mut writer = ShardWriter::new(&config.out, config.info());
    let shards = ShardTrials {
        trials: config.trials,
        per_shard: DEFAULT_TRIALS_PER_SHARD,
    };
    for shard in 0..shards.count() {
        let (done, total) = (writer.episode_count() as u64, config.trials);
        on_progress(CollectProgress { done, total });
        if cancelled.load(Ordering::Relaxed) {
            return Err(DatasetError::Cancelled { done, total });
        }
        if !writer.resume(Some(shards.count_of(shard))) {
            let info = writer.info();
            let encode = |trial| EncodedEpisode::new(info, trial as usize, config.trial(&pools, trial));
            let episodes: Result<Vec<_>, _> = shards.of(shard).into_par_iter().map(encode).collect();
            writer.write(&episodes?)?;
        }
    }
    writer.complete()
}
