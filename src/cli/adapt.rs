//! `foreframe adapt`

use std::fs;
use std::path::PathBuf;

use super::error::CliError;
use super::interrupt;
use super::next_step::shell_path;
use super::process::{command_line, print_line};
use super::settings::DirectoryArgs;
use super::train::OneTraining;
use super::workspace::Workspace;
use foreframe_core::nn::Conditioning;
use foreframe_core::registry::{self, Model};
use foreframe_data::dataset::sampler::Split;
use foreframe_data::dataset::{Dataset, Window};
use foreframe_train::evaluation::{self, CameraEstimate};
use foreframe_train::settings::SettingsLayer;
use foreframe_train::training::TrainConfig;

/// Validation windows that choose the weights, at most, and about as many others that judge them.
const COMPARED_WINDOWS: usize = 100;
/// Where a camera is taken to be whose height is not known, in metres: distances then count in units of it.
const HEIGHT_M: f32 = 0.6;

/// Adapt a model that sees depth to a robot of your own, from a few minutes of recording.
///
/// Estimates the camera if the recording does not say it, then trains the model further on the recording: what it knows of depth and
/// of pictures stays, and it learns what the recording's actions do. Prints the error on the validation split before and after. If that
/// did not fall, no model is written.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  foreframe import ~/mycar/data --name mycar --every 4
  foreframe adapt mycar --mirror angle
  foreframe adapt mycar --from rooms --name mycar-2 --steps 2000")]
pub(super) struct AdaptArgs {
    /// The directory of a data set, or its name in `DATA_DIR/datasets`
    #[arg(value_name = "DATASET")]
    dataset: PathBuf,
    /// The model to start from, which must see how fast the camera drives: its directory, name or NAME@VERSION
    #[arg(long, value_name = "MODEL", default_value = "rooms")]
    from: String,
    /// The name of the new model: 1 to 64 of a–z, 0–9 and '-' [default: DATASET-adapted]
    #[arg(long)]
    name: Option<String>,
    /// Updates, of 16 windows each; the weights with the least validation error are kept
    #[arg(long, default_value_t = 800, value_parser = clap::value_parser!(u32).range(1..))]
    steps: u32,
    /// A channel whose sign changes in a mirror, such as a steering angle; may be repeated. Then half of the training windows are
    /// mirrored
    #[arg(long, value_name = "CHANNEL")]
    mirror: Vec<String>,
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
    if !base.spec().sees_speeds() {
        return Err(CliError::Usage(format!(
            "{} does not see how fast a camera drives, so it cannot be adapted to another robot; start from rooms, or from a model \
             that was trained with model.flow.speeds",
            args.from
        )));
    }
    let start = workspace.load_weights(&args.from)?;
    let (directory, dataset) = workspace.open_dataset(&args.dataset)?;
    let dataset = with_known_camera(&base, dataset)?;
    let config = config(args, &base, &dataset)?;
    let run_dir = (args.out.clone()).unwrap_or_else(|| PathBuf::from("runs").join(config.name.as_str()));
    let windows = compared_windows(&base, &dataset)?;
    let errors_of = |model: &Model| evaluation::window_errors(model, &dataset, &windows, model.spec().horizon);
    let before = mean(&errors_of(&base)?);
    let (command, cancelled) = (command_line(), interrupt::flag()?);
    let training = OneTraining {
        dataset: &dataset,
        command: &command,
        start: Some(&start),
        cancelled: &cancelled,
    };
    let (model_dir, _) = training.run(&config, &run_dir)?;
    let adapted = registry::load(&model_dir)?;
    let after = mean(&errors_of(&adapted)?);
    let copied = mean(&evaluation::copied_errors(&base, &dataset, &windows)?);
    let e4 = |mse: f64| format!("{:8.1}", mse * 1e4);
    print_line(format!(
        "MSE ×10⁻⁴ on {} validation windows\n{}  the last frame, copied\n{}  {} as it is\n{}  {}",
        windows.len(),
        e4(copied),
        e4(before),
        args.from,
        e4(after),
        config.name
    ))?;
    if after >= before {
        fs::remove_dir_all(&run_dir).map_err(|error| CliError::io("delete", &run_dir, &error))?;
        return Err(CliError::Usage(format!(
            "{} became no better than {}, so it was deleted; record more, or try other --steps",
            config.name, args.from
        )));
    }
    let (flags, model) = (args.directories.repeated(), shell_path(&model_dir));
    print_line(format!(
        "{:.0} % less than before\nnext: foreframe evaluate --model {model} --dataset {}{flags}\n      foreframe publish {}{flags}",
        100.0 * (1.0 - after / before),
        shell_path(&directory),
        shell_path(&run_dir),
    ))
}

/// The data set, with an estimated camera if none is known.
fn with_known_camera(base: &Model, dataset: Dataset) -> Result<Dataset, CliError> {
    let episodes = 0..dataset.episodes().len();
    if episodes.clone().any(|episode| dataset.camera(episode).is_some()) {
        return Ok(dataset);
    }
    let Some(found) = evaluation::estimate_camera(base, &dataset, HEIGHT_M)? else {
        return Ok(dataset);
    };
    let CameraEstimate {
        camera,
        fields_of_view_deg: [narrowest, widest],
        tilts_deg: [highest, lowest],
        windows,
    } = found;
    print_line(format!(
        "camera, estimated from {windows} windows: field of view {:.0}° ({narrowest:.0}° to {widest:.0}° fit as well), tilted down by {:.0}° \
         ({highest:.0}° to {lowest:.0}°); import with --fov and --tilt if you know better",
        camera.horizontal_fov_rad.to_degrees(),
        camera.tilt_down_rad.to_degrees(),
    ))?;
    Ok(dataset.with_camera(camera))
}

/// The settings of the training: those of the base, for what the data set has.
fn config(args: &AdaptArgs, base: &Model, dataset: &Dataset) -> Result<TrainConfig, CliError> {
    let info = dataset.info();
    let conditioning = match (info.action_channels.is_empty(), info.state_channels.is_empty()) {
        (false, false) => Conditioning::StateAction,
        (false, true) => Conditioning::Action,
        (true, false) => Conditioning::State,
        (true, true) => Conditioning::None,
    };
    let finds_movers = base.spec().flow().is_some_and(|flow| flow.layers.movers) && info.has_masks;
    let settings = [
        match &args.name {
            Some(name) => format!("name={name}"),
            None => format!("name={}-adapted", info.name),
        },
        format!("model.conditioning={conditioning}"),
        format!("model.flow.movers={finds_movers}"),
        format!("sequence.steps={}", args.steps),
        "sequence.learning_rate=0.001".to_owned(),
        "run.validate_every_steps=50".to_owned(),
        "data.brightness=0.1".to_owned(),
        format!("data.validation_windows={COMPARED_WINDOWS}"),
        "sequence.batch_size=16".to_owned(),
        "run.batch_parts=2".to_owned(),
        match args.mirror.as_slice() {
            [] => "data.mirror=off".to_owned(),
            channels => format!("data.mirror={channels:?}"),
        },
    ];
    let all = settings.iter().chain(&args.settings);
    let layers = all.map(|setting| SettingsLayer::assignment(setting));
    Ok(TrainConfig::of_model(
        &base.manifest,
        layers.collect::<Result<Vec<_>, _>>()?,
    )?)
}

/// Windows of the validation split, evenly spread, between those that choose the weights. Errors: `Usage` if there is none.
fn compared_windows(base: &Model, dataset: &Dataset) -> Result<Vec<Window>, CliError> {
    let all = evaluation::windows_of(base, dataset, Split::Validation)?;
    if all.is_empty() {
        return Err(CliError::Usage(format!(
            "the data set \"{}\" has no windows for validation, by which the adapted model is judged; record more",
            dataset.info().name
        )));
    }
    let stride = all.len().div_ceil(COMPARED_WINDOWS);
    Ok(all.into_iter().skip(stride / 2).step_by(stride).collect())
}

fn mean(errors: &[f64]) -> f64 {
    errors.iter().sum::<f64>() / errors.len() as f64
}
