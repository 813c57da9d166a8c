//! `foreframe calibrate`

use std::path::PathBuf;

use super::error::CliError;
use super::interrupt;
use super::process::print_line;
use super::progress::ProgressLine;
use super::settings::CommonArgs;
use super::workspace::{Workspace, trained_on};
use foreframe_core::registry::calibration::Calibration;
use foreframe_core::registry::{self, Model};
use foreframe_data::dataset::Dataset;
use foreframe_train::evaluation::{self, EvaluateConfig, EvaluationProgress};

/// Measure on the validation split which errors to expect of a model, and write it into the model's manifest.
///
/// Predictions then carry an expected error with a 90 % band, a novelty, and warnings about actions and states out of the
/// range of the training. `train` does this at its end; this command does it again, for example with other data. It replaces the
/// calibration in the model's manifest, also that of a shipped model.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  foreframe calibrate --model runs/moving/model --dataset moving-observer
  foreframe calibrate --model moving-flow
  foreframe calibrate --model runs/without-car/model --dataset rooms --unseen car
  foreframe calibrate --model runs/rooms/model --dataset rooms --like runs/without-car/model")]
pub(super) struct CalibrateArgs {
    /// The directory of a model, its name, or NAME@VERSION
    #[arg(long)]
    model: String,
    /// The directory of a data set, or its name in `DATA_DIR/datasets` [default: the scenario that the model was trained on]
    #[arg(long, value_name = "DATASET")]
    dataset: Option<PathBuf>,
    /// A recording of a robot that the training never saw; may be repeated. Where neither state nor actions are known, as with a robot
    /// that is new to the model, the bands become wide enough for its errors too
    #[arg(long, value_name = "DATASET")]
    unseen: Vec<PathBuf>,
    /// A model that was trained like this one, but without a robot, and calibrated with --unseen; may be repeated. The bands become at
    /// least as wide as its
    #[arg(long, value_name = "MODEL")]
    like: Vec<String>,
    /// Validation windows at most, spread evenly over the trials
    #[arg(long, default_value_t = EvaluateConfig::default().max_windows)]
    windows: usize,
    #[command(flatten)]
    settings: CommonArgs,
}

pub(super) fn run(args: &CalibrateArgs) -> Result<(), CliError> {
    let workspace = Workspace::new(args.settings.start()?);
    let (model_dir, loaded) = workspace.load_model(&args.model)?;
    let dataset = args.dataset.clone().map_or_else(|| trained_on(&loaded), Ok)?;
    let (_, dataset) = workspace.open_dataset(&dataset)?;
    let others = Others::open(args, &workspace, &loaded)?;
    let cancelled = interrupt::flag()?;
    let config = EvaluateConfig {
        max_windows: args.windows,
        cancelled: Some(&cancelled),
        ..EvaluateConfig::default()
    };
    let progress = ProgressLine::new("windows");
    progress.label("calibrating");
    let on_progress = |now: EvaluationProgress| {
        progress.update(now.done as u64, now.total as u64, || format!("{} split", now.split));
    };
    let found = evaluation::calibrate(&loaded, &dataset, &config, &on_progress).and_then(|mut calibration| {
        for unseen in &others.unseen {
            evaluation::widen_for_unseen(&loaded, unseen, &config, &mut calibration, &on_progress)?;
        }
        Ok(calibration)
    });
    progress.finish();
    let mut calibration = found.map_err(CliError::not_calibrated)?;
    for like in &others.like {
        evaluation::widen_like(&mut calibration, like);
    }
    let windows = calibration.windows;
    registry::record_calibration(&model_dir, calibration)?;
    print_line(format!(
        "{}: calibrated on {windows} validation windows",
        model_dir.display()
    ))
}

/// What the bands for robots that the model never saw are widened by.
struct Others {
    unseen: Vec<Dataset>,
    like: Vec<Calibration>,
}

impl Others {
    /// Opens it before the long work. Errors: `Usage` if the model or the others have no such bands.
    fn open(args: &CalibrateArgs, workspace: &Workspace, loaded: &Model) -> Result<Self, CliError> {
        let can_do_without = loaded.spec().sees_speeds() && loaded.spec().action_inputs().is_some();
        let is_asked = !args.unseen.is_empty() || !args.like.is_empty();
        if is_asked && !can_do_without {
            return Err(CliError::Usage(format!(
                "{} has no bands for robots that it never saw: only models that take actions and can do without them have; leave out \
                 --unseen and --like",
                args.model
            )));
        }
        let unseen = args.unseen.iter().map(|dataset| Ok(workspace.open_dataset(dataset)?.1));
        let like = args.like.iter().map(|model| {
            let (_, other) = workspace.load_model(model)?;
            let calibration = other.manifest.calibration.clone();
            let fitting = calibration.filter(|other| other.steps_without_actions.len() == loaded.spec().horizon);
            fitting.ok_or_else(|| {
                CliError::Usage(format!(
                    "{model} has no bands for robots that it never saw, for {} frames each",
                    loaded.spec().horizon
                ))
            })
        });
        Ok(Self {
            unseen: unseen.collect::<Result<_, CliError>>()?,
            like: like.collect::<Result<_, _>>()?,
        })
    }
}
