//! `foreframe collect`

use std::path::{Path, PathBuf};

use clap::value_parser;

use super::settings::CommonArgs;
use super::workspace::Workspace;
use super::{CliError, interrupt, print_line, progress::ProgressLine};
use crate::dataset::collect::{CollectConfig, collect};
use crate::dataset::{Dataset, DatasetError, DatasetInfo, Split, Splits};
use crate::jobs::spec::MAX_TRIALS;
use crate::sim::{Look, Scenario, WorldConfig};
use crate::training::TrainConfig;
use crate::training::config::WindowBudget;
use crate::types::Seed;

/// More threads would only wait for each other.
const MAX_THREADS: i64 = 256;
/// Larger data sets have windows enough for every preset, and take long to read.
const MAX_COUNTED_BYTES: u64 = 400 << 20;
/// Trials that are enough for a training.
const ENOUGH_TRIALS: u64 = 40;

/// Simulate trials and store their frames, actions and states as a data set.
///
/// The data set is stored as Parquet files in the LeRobot v3 layout. Ctrl-C keeps the trials that are finished; the same
/// command continues, and the result is the same as without the interruption.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  foreframe collect --trials 200
  foreframe collect --scenario moving-observer --trials 500
  foreframe collect --trials 60 --seed 2 --out data/datasets/small")]
pub(super) struct CollectArgs {
    /// static-observer (the camera stands, one robot drives), moving-observer (the camera robot drives too) or crowded
    /// (several robots drive)
    #[arg(long, default_value = "static-observer")]
    scenario: Scenario,
    /// How many trials to simulate
    #[arg(long, default_value_t = 1000, value_parser = value_parser!(u64).range(1..=MAX_TRIALS))]
    trials: u64,
    /// The seed of all random numbers: the same seed gives the same bytes
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// The directory of the data set [default: `DATA_DIR/datasets/SCENARIO`]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Threads that simulate [default: one for each core]
    #[arg(long, value_parser = value_parser!(u16).range(1..=MAX_THREADS))]
    threads: Option<u16>,
    /// Width and height of the frames, in pixels
    #[arg(long, value_name = "PX", default_value_t = WorldConfig::default().frame_width_px)]
    frame_size: u32,
    /// Standard deviation of the camera noise; white is 1
    #[arg(long, value_name = "STD", default_value_t = WorldConfig::default().camera.noise_std)]
    noise: f64,
    /// What the room looks like: gray, or bright (white walls and floor, so that only robots stand out)
    #[arg(long, default_value_t = Look::Gray)]
    look: Look,
    #[command(flatten)]
    settings: CommonArgs,
}

pub(super) fn run(args: &CollectArgs) -> Result<(), CliError> {
    let workspace = Workspace::new(args.settings.start()?);
    let out = match &args.out {
        Some(out) => out.clone(),
        None => workspace.datasets_dir().join(args.scenario.to_string()),
    };
    let mut config = CollectConfig::new(args.scenario, args.trials, Seed(args.seed), &out);
    config.world.frame_width_px = args.frame_size;
    config.world.frame_height_px = args.frame_size;
    config.world.camera.noise_std = args.noise;
    config.world.look = args.look;
    config.threads = args.threads.unwrap_or_default().into();
    config.validate()?;
    let (cancelled, progress) = (interrupt::flag()?, ProgressLine::new("trials"));
    progress.label(&format!("collecting {}", config.scenario));
    let collected = collect(
        &config,
        &|now| progress.update(now.done, now.total, String::new),
        &cancelled,
    );
    progress.finish();
    match collected {
        Ok(info) => {
            print_line(format!(
                "{}: {} trials, {} frames of {}×{} px, content {}",
                out.display(),
                info.episode_count,
                info.frame_count,
                info.frame_width_px,
                info.frame_height_px,
                info.content_hash,
            ))?;
            print_line(format!("next: {}", next_step(args, &out, &info)?))
        }
        Err(stopped @ DatasetError::Cancelled { .. }) => Err(CliError::Interrupted(stopped.to_string())),
        Err(error) => Err(error.into()),
    }
}

/// A training command that works on the data set, or what to do if it is too small to train on.
fn next_step(args: &CollectArgs, out: &Path, info: &DatasetInfo) -> Result<String, CliError> {
    let presets: &[&str] = match args.scenario {
        Scenario::StaticObserver => &["paper", "static"],
        Scenario::MovingObserver => &["moving"],
        Scenario::Crowded => &["static"],
    };
    let is_large = info.decoded_bytes() > MAX_COUNTED_BYTES;
    let dataset = (!is_large).then(|| Dataset::open(out)).transpose()?;
    for preset in presets {
        let config = TrainConfig::preset(preset)?;
        if dataset
            .as_ref()
            .is_none_or(|dataset| has_enough_windows(&config, dataset))
        {
            return Ok(format!("foreframe train --preset {preset} --dataset {}", out.display()));
        }
    }
    let trials = ENOUGH_TRIALS.max(args.trials + 1);
    Ok(format!(
        "collect more trials into another directory, as with --trials {trials}; {} are too few to train on",
        args.trials
    ))
}

/// Whether a training with this configuration finds windows enough in the data set.
fn has_enough_windows(config: &TrainConfig, dataset: &Dataset) -> bool {
    let splits = Splits::new(dataset, config.data.split_seed);
    let count = |split| {
        let windows = splits.windows(dataset, split, config.window_shape(), 1);
        windows.map_or(0, |windows| windows.len())
    };
    let needed = match config.data.windows {
        WindowBudget::Count(count) => count,
        WindowBudget::All(_) => 1,
    };
    count(Split::Train) >= needed && count(Split::Validation) > 0
}
