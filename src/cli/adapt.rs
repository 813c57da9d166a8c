//! `foreframe adapt`

use std::fs;
use std::path::{Path, PathBuf};

use super::error::CliError;
use super::interrupt;
use super::next_step::{name_from, shell_path};
use super::process::{command_line, print_line};
use super::settings::DirectoryArgs;
use super::train::{OneTraining, warn_of_small_channels};
use super::workspace::Workspace;
use foreframe_core::error_kind::{ErrorKind, HasErrorKind as _};
use foreframe_core::registry;
use foreframe_core::types::{ModelName, ValueError};
use foreframe_train::adaptation::{AdaptError, AdaptSettings, Adaptation};
use foreframe_train::settings::SettingsLayer;

/// Adapt a model that sees depth to a robot of your own, from a few minutes of recording.
///
/// Estimates the camera if the recording does not say it, then trains the model further on the recording: what it knows of depth and
/// of pictures stays, and it learns what the recording's actions do. Prints the error on the validation split before and after. If that
/// did not fall, no model is written.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  foreframe import ~/mycar/data --name mycar --every 4
  foreframe adapt mycar --mirror angle
  foreframe adapt mycar --from rooms --name mycar-2 --steps 2000
  foreframe adapt myroom --remember")]
pub(super) struct AdaptArgs {
    /// The directory of a data set, or its name in `DATA_DIR/datasets`
    #[arg(value_name = "DATASET")]
    dataset: PathBuf,
    /// The model to start from, which must see how fast the camera drives: its directory, name or NAME@VERSION
    #[arg(long, value_name = "MODEL", default_value = "rooms")]
    from: String,
    /// The name of the new model: 1 to 64 of a–z, 0–9 and '-' [default: DATASET-adapted]
    #[arg(long)]
    name: Option<ModelName>,
    /// Updates, of 16 windows each; the weights with the least validation error are kept
    #[arg(long, default_value_t = AdaptSettings::STEPS, value_parser = clap::value_parser!(u32).range(1..))]
    steps: u32,
    /// A channel whose sign changes in a mirror, such as a steering angle; may be repeated. Then half of the training windows are
    /// mirrored
    #[arg(long, value_name = "CHANNEL")]
    mirror: Vec<String>,
    /// Also remember what the room of the recording looks like, for a robot that stays in it. Its states must have x, y, `heading_cos`
    /// and `heading_sin`, always from the same origin, and the recording needs actions
    #[arg(long, conflicts_with = "mirror")]
    remember: bool,
    /// Another setting of the training, as in data.brightness=0; may be repeated
    #[arg(long = "set", value_name = "KEY=VALUE")]
    settings: Vec<String>,
    /// The directory of the run, for the checkpoint and at the end the model [default: runs/NAME]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    #[command(flatten)]
    directories: DirectoryArgs,
}

pub(super) fn run(args: &AdaptArgs) -> Result<(), CliError> {
    let workspace = Workspace::new(args.directories.start(None, Vec::new())?);
    let (_, base) = workspace.load_model(&args.from)?;
    let start = workspace.load_weights(&args.from)?;
    let (directory, dataset) = workspace.open_dataset(&args.dataset)?;
    let settings = settings(args, &directory)?;
    warn_of_small_channels(&dataset);
    let cancelled = interrupt::flag()?;
    let adaptation = Adaptation::of(&base, dataset, &settings, &cancelled)
        .map_err(interrupted("stopped before the training; nothing was written"))?;
    if let Some(camera) = &adaptation.camera {
        print_line(format!(
            "camera, {camera}; import with --fov and --tilt if you know better"
        ))?;
    }
    let config = &adaptation.config;
    let run_dir = (args.out.clone()).unwrap_or_else(|| PathBuf::from("runs").join(config.name.as_str()));
    let command = command_line();
    let training = OneTraining {
        dataset: &adaptation.dataset,
        command: &command,
        start: Some(&start),
        cancelled: &cancelled,
    };
    let (model_dir, _) = training.run(config, &run_dir)?;
    let adapted = registry::load(&model_dir)?;
    let scores = adaptation
        .judge(&adapted, &cancelled)
        .map_err(interrupted("stopped before the comparison; the same command goes on"))?;
    print_line(scores.table(&args.from, config.name.as_str()))?;
    if !scores.is_better() {
        fs::remove_dir_all(&run_dir).map_err(|error| CliError::io("delete", &run_dir, &error))?;
        return Err(CliError::Usage(format!(
            "{} became no better than {}, so it was deleted; record more, or try other --steps",
            config.name, args.from
        )));
    }
    let (flags, model) = (args.directories.repeated(), shell_path(&model_dir));
    print_line(format!(
        "{:.0} % less than before\nnext: foreframe evaluate --model {model} --dataset {}{flags}\n      foreframe publish {}{flags}",
        100.0 * (1.0 - scores.after / scores.before),
        shell_path(&directory),
        shell_path(&run_dir),
    ))
}

/// Ctrl-C is an interruption, not a failure.
fn interrupted(sentence: &'static str) -> impl Fn(AdaptError) -> CliError {
    move |error| match error.kind() {
        ErrorKind::Cancelled => CliError::Interrupted(sentence.to_owned()),
        _ => error.into(),
    }
}

/// What the arguments say, for the data set in that directory.
fn settings(args: &AdaptArgs, dataset: &Path) -> Result<AdaptSettings, CliError> {
    let layers = args.settings.iter().map(|setting| SettingsLayer::assignment(setting));
    let layers = layers.collect::<Result<Vec<_>, _>>()?;
    if layers.iter().any(|layer| layer.keys().any(|key| key == "name")) {
        let right = "--set name does not name the adapted model; use --name";
        return Err(CliError::Usage(right.to_owned()));
    }
    let name = if let Some(name) = &args.name {
        name.clone()
    } else {
        let path = dataset.canonicalize().unwrap_or_else(|_| dataset.to_owned());
        let of_dataset = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let name = format!("{}-adapted", name_from(&of_dataset, "recording")).parse();
        name.map_err(|error: ValueError| CliError::Usage(format!("{error}; give another --name")))?
    };
    Ok(AdaptSettings {
        name,
        steps: args.steps,
        mirror: args.mirror.clone(),
        remember: args.remember,
        layers,
    })
}
