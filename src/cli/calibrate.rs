//! `foreframe calibrate`

use std::path::PathBuf;

use super::error::CliError;
use super::interrupt;
use super::process::print_line;
use super::progress::ProgressLine;
use super::settings::CommonArgs;
use super::workspace::{Workspace, trained_on};
use foreframe_core::registry;
use foreframe_train::evaluation::{self, EvaluateConfig};

/// Measure on the validation split which errors to expect of a model, and write it into the model's manifest.
///
/// Predictions then carry an expected error with a 90 % band, a novelty, and warnings about actions and states out of the
/// range of the training. `train` does this at its end; this command does it again, for example with other data. It replaces the
/// calibration in the model's manifest, also that of a shipped model.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  foreframe calibrate --model runs/moving/model --dataset moving-observer
  foreframe calibrate --model moving-flow")]
pub(super) struct CalibrateArgs {
    /// The directory of a model, its name, or NAME@VERSION
    #[arg(long)]
    model: String,
    /// The directory of a data set, or its name in `DATA_DIR/datasets` [default: the scenario that the model was trained on]
    #[arg(long, value_name = "DATASET")]
    dataset: Option<PathBuf>,
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
    let cancelled = interrupt::flag()?;
    let config = EvaluateConfig {
        max_windows: args.windows,
        cancelled: Some(&cancelled),
        ..EvaluateConfig::default()
    };
    let progress = ProgressLine::new("windows");
    progress.label("calibrating");
    let found = evaluation::calibrate(&loaded, &dataset, &config, &|now| {
        progress.update(now.done as u64, now.total as u64, || format!("{} split", now.split));
    });
    progress.finish();
    let calibration = found.map_err(CliError::not_calibrated)?;
    let windows = calibration.windows;
    registry::record_calibration(&model_dir, calibration)?;
    print_line(format!(
        "{}: calibrated on {windows} validation windows",
        model_dir.display()
    ))
}
