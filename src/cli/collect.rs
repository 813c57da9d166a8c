//! `foreframe collect`

use std::fmt;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use clap::value_parser;

use super::error::CliError;
use super::interrupt;
use super::next_step::{first_trainable, shell_path};
use super::process::print_line;
use super::progress::ProgressLine;
use super::settings::CommonArgs;
use super::workspace::{Workspace, dataset_name};
use foreframe_core::types::{DatasetName, Seed};
use foreframe_data::dataset::DatasetInfo;
use foreframe_data::dataset::collect::{CollectConfig, CollectProgress, collect};
use foreframe_data::dataset::moving_mnist::{
    DEFAULT_FRAMES, MAX_FRAMES, MOVING_MNIST, MovingMnistConfig, collect_digits,
};
use foreframe_jobs::jobs::spec::MAX_TRIALS;
use foreframe_sim::{Look, RoomSet, Scenario, SimError, WorldConfig};
use foreframe_train::training::TrainConfig;

/// More threads would only wait for each other.
const MAX_THREADS: i64 = 256;
/// Trials that are enough for a training.
const ENOUGH_TRIALS: u64 = 40;

/// What to collect.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum CollectSubject {
    /// A simulated scenario.
    Simulated(Scenario),
    /// Digits that move.
    MovingMnist,
}

impl FromStr for CollectSubject {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, String> {
        if name == MOVING_MNIST {
            return Ok(Self::MovingMnist);
        }
        let scenario = name.parse().map(Self::Simulated);
        scenario.map_err(|error: SimError| format!("{error}, {MOVING_MNIST}"))
    }
}

impl fmt::Display for CollectSubject {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Simulated(scenario) => scenario.fmt(out),
            Self::MovingMnist => out.write_str(MOVING_MNIST),
        }
    }
}

/// Simulate trials and store their frames, actions and states as a data set.
///
/// The data set is stored as Parquet files in the LeRobot v3 layout. Ctrl-C keeps the trials that are finished; the same
/// command continues, and the result is the same as without the interruption. With more `--trials`, it adds those to the data
/// set that is there. Of moving-mnist, the last tenth of the trials is
/// the test split, with digits of their own, and the tenth before it the validation split.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  foreframe collect --trials 200
  foreframe collect --scenario moving-observer --trials 500
  foreframe collect --scenario moving-observer --rooms varied --trials 500
  foreframe collect --trials 60 --seed 2 --name small
  foreframe collect --scenario moving-mnist --digits mnist/ --trials 10000")]
pub(super) struct CollectArgs {
    /// static-observer (the camera stands, one robot drives), moving-observer (the camera robot drives too), crowded
    /// (several robots drive), crossing (robots drive to and fro across the way ahead) or moving-mnist (two digits move
    /// over a black square; needs --digits)
    #[arg(long, default_value = "static-observer")]
    scenario: CollectSubject,
    /// For moving-mnist: an IDX file of digits (.gz or not), a folder with MNIST's train-images and t10k-images files, or a
    /// folder of 28×28 PNG images
    #[arg(long, value_name = "PATH", conflicts_with_all = ["frame_size", "noise", "look", "rooms", "threads"])]
    digits: Option<PathBuf>,
    /// For moving-mnist: frames of a trial
    #[arg(long, requires = "digits", default_value_t = DEFAULT_FRAMES as u16, value_parser = value_parser!(u16).range(2..=MAX_FRAMES as i64))]
    frames: u16,
    /// How many trials to simulate
    #[arg(long, default_value_t = 1000, value_parser = value_parser!(u64).range(1..=MAX_TRIALS))]
    trials: u64,
    /// The seed of all random numbers: on processors of one kind, the same seed gives the same bytes
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// The data set's name [default: SCENARIO, with `--rooms` SCENARIO-SET]
    #[arg(long)]
    name: Option<String>,
    /// The data set's directory [default: `DATA_DIR/datasets/NAME`]
    #[arg(long, value_name = "DIR", conflicts_with = "name")]
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
    /// Draws a room, a camera and robots for each trial: varied (to train on; the trials of its test split are rooms never
    /// seen), new-materials or new-cameras (only for tests: surfaces and furniture, or cameras, that varied never has)
    /// [default: all trials are in the same room]
    #[arg(long, value_name = "SET")]
    rooms: Option<RoomSet>,
    /// Stores the true pose in the states. Without it, they hold what a robot's odometry measures in these rooms: it starts
    /// at 0 and drifts
    #[arg(long, requires = "rooms")]
    true_pose: bool,
    #[command(flatten)]
    settings: CommonArgs,
}

pub(super) fn run(args: &CollectArgs) -> Result<(), CliError> {
    let workspace = Workspace::new(args.settings.start()?);
    let out = match &args.out {
        Some(out) => out.clone(),
        None => workspace.datasets_dir().join(name(args)?),
    };
    let (cancelled, progress) = (interrupt::flag()?, ProgressLine::new("trials"));
    progress.label(&format!("collecting {}", args.scenario));
    let on_progress = |now: CollectProgress| progress.update(now.done, now.total, String::new);
    let collected = match (args.scenario, &args.digits) {
        (CollectSubject::Simulated(scenario), None) => {
            let config = simulation(args, scenario, &out);
            config.validate()?;
            collect(&config, &on_progress, &cancelled)
        }
        (CollectSubject::MovingMnist, Some(digits)) => {
            let config = MovingMnistConfig {
                digits: digits.clone(),
                trials: args.trials,
                frames: args.frames.into(),
                seed: Seed(args.seed),
                out: out.clone(),
            };
            collect_digits(&config, &on_progress, &cancelled)
        }
        (CollectSubject::Simulated(scenario), Some(_)) => {
            return Err(CliError::Usage(format!(
                "--digits is for --scenario {MOVING_MNIST}; {scenario} is simulated without digits"
            )));
        }
        (CollectSubject::MovingMnist, None) => {
            return Err(CliError::Usage(format!(
                "--scenario {MOVING_MNIST} needs --digits: a folder with train-images-idx3-ubyte.gz and \
                 t10k-images-idx3-ubyte.gz, or with PNG images"
            )));
        }
    };
    progress.finish();
    let info = collected?;
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

/// The data set's name. Errors: `Usage` if the given one is not valid.
fn name(args: &CollectArgs) -> Result<DatasetName, CliError> {
    if let Some(name) = &args.name {
        return dataset_name(name);
    }
    let name = match args.rooms {
        Some(rooms) => format!("{}-{rooms}", args.scenario),
        None => args.scenario.to_string(),
    };
    Ok(name
        .parse()
        .expect("a scenario whose name is not one of a data set is a bug"))
}

/// The collection of a simulated scenario.
fn simulation(args: &CollectArgs, scenario: Scenario, out: &Path) -> CollectConfig {
    let mut config = CollectConfig::new(scenario, args.trials, Seed(args.seed), out);
    config.world.frame_width_px = args.frame_size;
    config.world.frame_height_px = args.frame_size;
    config.world.camera.noise_std = args.noise;
    config.world.look = args.look;
    config.world.rooms = args.rooms;
    config.world.true_pose = args.true_pose;
    config.threads = args.threads.unwrap_or_default().into();
    config
}

/// A command that works on the data set, or what to do if it is too small to train on.
fn next_step(args: &CollectArgs, out: &Path, info: &DatasetInfo) -> Result<String, CliError> {
    let (dataset, flags) = (shell_path(out), args.settings.repeated());
    if args.rooms.is_some_and(RoomSet::is_only_for_tests) {
        return Ok(format!(
            "foreframe evaluate --model rooms --dataset {dataset}{flags}   # or another model; these rooms are only for tests"
        ));
    }
    let presets: &[&str] = match args.scenario {
        CollectSubject::Simulated(Scenario::StaticObserver) => &["paper", "static"],
        CollectSubject::Simulated(_) if args.rooms.is_some() => &["rooms"],
        CollectSubject::Simulated(Scenario::MovingObserver) => &["moving"],
        CollectSubject::Simulated(Scenario::Crowded | Scenario::Crossing) => &["static"],
        CollectSubject::MovingMnist => &[MOVING_MNIST],
    };
    let configs: Vec<TrainConfig> = presets
        .iter()
        .map(|preset| TrainConfig::preset(preset))
        .collect::<Result<_, _>>()?;
    // A preset's name is that of its configuration.
    if let Some(TrainConfig { name: preset, .. }) = first_trainable(out, info, configs)? {
        return Ok(format!("foreframe train --preset {preset} --dataset {dataset}{flags}"));
    }
    if args.scenario == CollectSubject::MovingMnist && usize::from(args.frames) < DEFAULT_FRAMES {
        return Ok(format!(
            "collect longer trials into another directory, as with --frames {DEFAULT_FRAMES}; those of {} frames are too short to \
             train on",
            args.frames
        ));
    }
    if args.scenario == CollectSubject::MovingMnist {
        return Ok("collect more trials into another directory; these are too few to train on".to_owned());
    }
    let trials = ENOUGH_TRIALS.max(args.trials + 1);
    Ok(format!(
        "the same command with --trials {trials}, which adds trials; {} are too few to train on",
        args.trials
    ))
}
