//! `foreframe collect`

use std::path::{Path, PathBuf};

use clap::value_parser;

use super::{CliError, DATASETS_DIR, interrupt, progress::ProgressLine, say};
use crate::dataset::DatasetError;
use crate::dataset::collect::{CollectConfig, collect};
use crate::jobs::spec::MAX_TRIALS;
use crate::sim::{Scenario, WorldConfig};
use crate::types::Seed;

/// More would only wait for each other.
const MAX_THREADS: i64 = 256;

/// Simulate trials and store their frames, actions and states.
///
/// The data set is Parquet in the LeRobot v3 layout. Collection can be stopped at any time: the same command goes on where
/// it was, and the result is the same as if it had never stopped.
#[derive(clap::Args)]
#[command(after_help = "Example: foreframe collect --scenario moving-observer --trials 500")]
pub(super) struct CollectArgs {
    /// static-observer (the paper's: a standing camera, one robot), moving-observer (the camera's robot drives too) or
    /// crowded (several robots)
    #[arg(long, default_value = "static-observer")]
    scenario: Scenario,
    /// How many trials to simulate
    #[arg(long, default_value_t = 1000, value_parser = value_parser!(u64).range(1..=MAX_TRIALS))]
    trials: u64,
    /// The origin of all randomness: the same seed gives the same bytes
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// The data set's directory [default: data/datasets/SCENARIO]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Threads to simulate on [default: one a core]
    #[arg(long, value_parser = value_parser!(u16).range(1..=MAX_THREADS))]
    threads: Option<u16>,
    /// Width and height of the frames, in pixels
    #[arg(long, value_name = "PX", default_value_t = WorldConfig::default().frame_width_px)]
    frame_size: u32,
    /// Standard deviation of the camera's noise, where 1 is white
    #[arg(long, value_name = "STD", default_value_t = WorldConfig::default().camera.noise_std)]
    noise: f64,
}

pub(super) fn run(args: CollectArgs) -> Result<(), CliError> {
    let out = args
        .out
        .unwrap_or_else(|| Path::new(DATASETS_DIR).join(args.scenario.to_string()));
    let mut config = CollectConfig::new(args.scenario, args.trials, Seed(args.seed), &out);
    config.world.frame_width_px = args.frame_size;
    config.world.frame_height_px = args.frame_size;
    config.world.camera.noise_std = args.noise;
    config.threads = args.threads.unwrap_or_default().into();
    config.validate()?;
    let (cancelled, progress) = (interrupt::flag()?, ProgressLine::new("trials"));
    progress.start(&format!("collecting {}", config.scenario), 0, config.trials);
    let collected = collect(
        &config,
        &|now| progress.update(now.done, now.total, String::new),
        &cancelled,
    );
    progress.finish();
    match collected {
        Ok(info) => say(format!(
            "{}: {} trials, {} frames of {}×{} px, content {}\nnext: foreframe train --dataset {}",
            out.display(),
            info.episode_count,
            info.frame_count,
            info.frame_width_px,
            info.frame_height_px,
            info.content_hash,
            out.display(),
        )),
        Err(stopped @ DatasetError::Cancelled { .. }) => Err(CliError::Interrupted(stopped.to_string())),
        Err(error) => Err(error.into()),
    }
}
