//! `foreframe train`

mod sweep;

use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::sync::atomic::AtomicBool;

use self::sweep::SweepRun;
use super::error::CliError;
use super::interrupt;
use super::next_step::shell_path;
use super::process::{command_line, print_line};
use super::progress::ProgressLine;
use super::settings::DirectoryArgs;
use super::workspace::Workspace;
use crate::config::is_setting;
use foreframe_core::frame::warp::CameraModel;
use foreframe_core::registry::{Manifest, StoredWeights};
use foreframe_data::dataset::{Dataset, DatasetPart};
use foreframe_data::inspection::small_channels;
use foreframe_train::evaluation;
use foreframe_train::settings::SettingsLayer;
use foreframe_train::training::config::ArchitectureConfig;
use foreframe_train::training::{self, Sweep, TrainConfig, Training, TrainingEvent, TrainingOutcome, TrainingStage};

/// Train a model on a data set.
///
/// Training has two stages: pretrain (the frame codec alone) and sequence (the recurrent network). The weights with the lowest
/// validation error are kept, and the model is calibrated (see `foreframe calibrate`). A checkpoint is written every few hundred
/// steps and on Ctrl-C; the same command continues from it, and ends with the same weights as without the interruption.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  foreframe train --preset paper --dataset static-observer
  foreframe train --preset moving --set seed=2 --set sequence.steps=4000 --out runs/moving-2
  foreframe train --preset moving --sweep seed=1..3 --sweep model.hidden=64,128
  foreframe train --preset paper --print-config > mine.toml
  foreframe train --preset paper --config mine.toml
  foreframe train --from moving-flow --dataset mine --set name=mine --set sequence.steps=300
  foreframe train --preset rooms --dataset rooms-a --dataset rooms-b=0.3 --out runs/rooms")]
pub(super) struct TrainArgs {
    /// paper (dense network, 1000 windows), static (dense, all windows), moving (dense, with state and actions), static-flow,
    /// moving-flow (flow network; moving-flow takes state and actions), rooms (flow network with depth, for rooms of `collect --rooms
    /// varied`), recording (flow network, with actions) or moving-mnist (sprite network, for the benchmark)
    #[arg(long, default_value = "paper", conflicts_with = "from")]
    preset: String,
    /// Start from the weights and settings of this model: its directory, name or NAME@VERSION. A few hundred steps are often
    /// enough, as with --set sequence.steps=300
    #[arg(long, value_name = "MODEL")]
    from: Option<String>,
    /// The directory of a data set, or its name in `DATA_DIR/datasets`; may be repeated. Each set gives equally many
    /// windows, unless it has a weight, as in rooms=3 [default: static-observer; for moving and moving-flow,
    /// moving-observer]
    #[arg(long = "dataset", value_name = "DATASET[=WEIGHT]")]
    datasets: Vec<WeightedDataset>,
    /// The directory of the run, for the configuration, the checkpoint and at the end the model [default: runs/NAME]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// A TOML file of training settings, which replace those of the preset, and of settings of the program
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// One training setting, as in sequence.steps=3000, or one of the program, as in `dataset_memory_mib`=500; may be repeated, and
    /// replaces that of --config
    #[arg(long = "set", value_name = "KEY=VALUE")]
    settings: Vec<String>,
    /// Train once for each value of a setting, as in seed=1..3 (1, 2 and 3) or model.hidden=64,128; if repeated, for each
    /// combination, at most 64. Prints a table, the lowest validation error first. Each run has a directory below --out
    #[arg(long = "sweep", value_name = "KEY=VALUES")]
    sweep: Vec<String>,
    /// Print the training settings and stop
    #[arg(long)]
    print_config: bool,
    #[command(flatten)]
    directories: DirectoryArgs,
}

pub(super) fn run(args: &TrainArgs) -> Result<(), CliError> {
    let settings = GivenSettings::read(args)?;
    let workspace = Workspace::new(args.directories.start(settings.program_file, settings.program)?);
    let start = args
        .from
        .as_ref()
        .map(|model| workspace.load_weights(model))
        .transpose()?;
    let config = training_config(args, start.as_ref(), settings.training.clone())?;
    let points = Sweep::parse(args.sweep.iter().map(String::as_str))?.points();
    // All configurations are checked before the first training starts.
    let configs = points.iter().map(|point| {
        let layers = settings.training.iter().cloned().chain([sweep::layer(point)]);
        training_config(args, start.as_ref(), layers.collect())
    });
    let configs = configs.collect::<Result<Vec<_>, _>>()?;
    if args.print_config {
        return print_line(config.to_toml()?.trim_end());
    }
    let (directories, dataset) = open_datasets(args, &workspace, start.as_ref(), &config)?;
    for config in &configs {
        config.validate()?;
        training::parameter_count(config, dataset.info())?;
    }
    warn_of_small_channels(&dataset);
    note_camera(&dataset, &config);
    let run_dir = args
        .out
        .clone()
        .unwrap_or_else(|| PathBuf::from("runs").join(&config.name));
    let (command, flags) = (command_line(), args.directories.repeated());
    let cancelled = interrupt::flag()?;
    let one = OneTraining {
        dataset: &dataset,
        command: &command,
        start: start.as_ref(),
        cancelled: &cancelled,
    };
    if !args.sweep.is_empty() {
        let runs = points.into_iter().zip(configs);
        let mut finished = Vec::new();
        for (point, config) in runs {
            let run = SweepRun::new(point, config, &run_dir);
            let (_, manifest) = one.run(&run.config, &run.run_dir)?;
            finished.push((run, manifest));
        }
        return sweep::print_table(&finished, &flags);
    }
    let (model_dir, manifest) = one.run(&config, &run_dir)?;
    print_line(format!(
        "{}: {} parameters, validation MSE {:.6} at step {}",
        model_dir.display(),
        manifest.parameters,
        manifest.metrics["validation"]["mse"].as_f64().unwrap_or(f64::NAN),
        manifest.metrics["validation"]["step"],
    ))?;
    let mut next = Vec::new();
    for (directory, part) in directories.iter().zip(dataset.parts()) {
        if let Err(reason) = evaluation::check_fit(&manifest, &part.info) {
            print_line(format!(
                "note: the model cannot be evaluated on one of its data sets: {reason}"
            ))?;
            continue;
        }
        let (model, dataset) = (shell_path(&model_dir), shell_path(directory));
        next.push(format!("foreframe evaluate --model {model} --dataset {dataset}{flags}"));
    }
    next.push(format!("foreframe publish {}{flags}", shell_path(&run_dir)));
    print_line(format!("next: {}", next.join("\n      ")))
}

/// The data sets that are named, as one, and their directories.
fn open_datasets(
    args: &TrainArgs,
    workspace: &Workspace,
    start: Option<&StoredWeights>,
    config: &TrainConfig,
) -> Result<(Vec<PathBuf>, Dataset), CliError> {
    let mut named = args.datasets.clone();
    if named.is_empty() {
        named.push(WeightedDataset::from(default_dataset(args, start)));
    }
    let (mut directories, mut weighted) = (Vec::new(), Vec::new());
    for WeightedDataset { place, weight } in &named {
        let (directory, dataset) = workspace.open_dataset(place)?;
        directories.push(directory);
        weighted.push((dataset, *weight));
    }
    Ok((directories, Dataset::join(weighted, config.lacking())?))
}

/// Warns of channels that the networks see too small.
pub(super) fn warn_of_small_channels(dataset: &Dataset) {
    for sentence in small_channels(dataset) {
        tracing::warn!("{sentence}");
    }
}

/// Says that a model is trained without a camera, since its data sets do not have the same. One that sees depth takes that of each episode.
fn note_camera(dataset: &Dataset, config: &TrainConfig) {
    let takes_one = matches!(config.model.architecture, ArchitectureConfig::Flow(layers) if !layers.depth);
    if !(takes_one && dataset.lost_camera()) {
        return;
    }
    let camera = |part: &DatasetPart| match part.info.camera {
        Some(CameraModel {
            horizontal_fov_rad,
            tilt_down_rad,
            ..
        }) => format!(
            "\"{}\" {:.1}° wide, tilted down {:.1}°",
            part.info.name,
            horizontal_fov_rad.to_degrees(),
            tilt_down_rad.to_degrees()
        ),
        None => format!("\"{}\" not known", part.info.name),
    };
    let cameras: Vec<String> = dataset.parts().iter().map(camera).collect();
    tracing::warn!(
        "the data sets do not have the same camera ({}), so the model is trained without a camera model; --fov and --tilt of the \
         import describe it",
        cameras.join("; ")
    );
}

/// What all trainings of a command share.
pub(super) struct OneTraining<'a> {
    pub(super) dataset: &'a Dataset,
    pub(super) command: &'a str,
    pub(super) start: Option<&'a StoredWeights>,
    pub(super) cancelled: &'a AtomicBool,
}

impl OneTraining<'_> {
    /// Trains and calibrates a model, or continues. Returns its directory and its description.
    pub(super) fn run(&self, config: &TrainConfig, run_dir: &Path) -> Result<(PathBuf, Box<Manifest>), CliError> {
        let training = Training {
            config,
            dataset: self.dataset,
            run_dir,
            command: self.command,
            start: self.start,
        };
        let progress = ProgressLine::new("steps");
        let mut display = TrainingDisplay::new(&progress, config);
        let outcome = training::run(
            &training,
            &mut |event: TrainingEvent| display.on_event(event),
            self.cancelled,
        );
        progress.finish();
        match outcome? {
            TrainingOutcome::Finished { model_dir, manifest } => {
                let calibrated = evaluation::calibrate_trained(&model_dir, self.dataset, self.cancelled);
                calibrated.map_err(CliError::not_calibrated)?;
                Ok((model_dir, manifest))
            }
            TrainingOutcome::Interrupted { stage, step } => Err(CliError::Interrupted(format!(
                "stopped in {stage} after step {step}; the checkpoint is in {}, and the same command continues from it",
                run_dir.display()
            ))),
        }
    }
}

/// What --config and --set give. Both take settings of the program, which have one meaning in all commands, and of the training;
/// no name is in both.
#[derive(Default)]
struct GivenSettings {
    program_file: Option<SettingsLayer>,
    program: Vec<SettingsLayer>,
    training: Vec<SettingsLayer>,
}

impl GivenSettings {
    fn read(args: &TrainArgs) -> Result<Self, CliError> {
        let mut given = Self::default();
        if let Some(path) = &args.config {
            let (program, training) = SettingsLayer::file(path)?.partition(is_setting);
            given.program_file = Some(program);
            given.training.push(training);
        }
        for setting in &args.settings {
            let (program, training) = SettingsLayer::assignment(setting)?.partition(is_setting);
            given.program.push(program);
            given.training.push(training);
        }
        Ok(given)
    }
}

/// The preset, or the settings of the model to start from, under the given settings.
fn training_config(
    args: &TrainArgs,
    start: Option<&StoredWeights>,
    layers: Vec<SettingsLayer>,
) -> Result<TrainConfig, CliError> {
    Ok(match start {
        Some(start) => TrainConfig::of_model(&start.manifest, layers)?,
        None => TrainConfig::from_layers(&args.preset, layers)?,
    })
}

/// A data set and the weight of its windows among those of the others.
#[derive(Clone, Debug)]
struct WeightedDataset {
    place: PathBuf,
    weight: f64,
}

impl From<PathBuf> for WeightedDataset {
    fn from(place: PathBuf) -> Self {
        Self { place, weight: 1.0 }
    }
}

impl FromStr for WeightedDataset {
    type Err = String;

    /// A name or directory, with a weight after the last `=` if what follows it is a number.
    fn from_str(text: &str) -> Result<Self, String> {
        let Some((place, weight)) = text.rsplit_once('=') else {
            return Ok(Self::from(PathBuf::from(text)));
        };
        match weight.parse::<f64>() {
            Ok(weight) if weight.is_finite() && weight > 0.0 && !place.is_empty() => Ok(Self {
                place: PathBuf::from(place),
                weight,
            }),
            _ => Err(format!(
                "\"{text}\" is no data set with a weight; write NAME=WEIGHT with a number above 0, as in rooms=0.3"
            )),
        }
    }
}

fn default_dataset(args: &TrainArgs, start: Option<&StoredWeights>) -> PathBuf {
    if let Some(start) = start {
        return PathBuf::from(&start.manifest.dataset.name);
    }
    PathBuf::from(if args.preset.starts_with("moving") {
        "moving-observer"
    } else {
        "static-observer"
    })
}

/// Shows a training's events.
struct TrainingDisplay<'a> {
    progress: &'a ProgressLine,
    steps: [usize; 2],
    stage: Option<TrainingStage>,
    /// The lowest validation error of the stage.
    best: [Option<f64>; 2],
}

impl<'a> TrainingDisplay<'a> {
    fn new(progress: &'a ProgressLine, config: &TrainConfig) -> Self {
        Self {
            progress,
            steps: [config.pretrain.steps, config.sequence.steps],
            stage: None,
            best: [None; 2],
        }
    }

    fn on_event(&mut self, event: TrainingEvent) {
        match event {
            TrainingEvent::Started { stage, step, windows } => {
                self.start(stage, step);
                self.progress.line(&format!("from step {step}, on {windows} windows"));
            }
            TrainingEvent::Step {
                stage,
                step,
                steps,
                loss,
            } => {
                if self.stage != Some(stage) {
                    self.start(stage, step - 1);
                }
                let message = self.message(stage, loss);
                self.progress.update(step as u64, steps as u64, || message);
            }
            TrainingEvent::Validated {
                stage,
                step,
                loss,
                is_best,
            } => {
                self.validated(stage, loss);
                let remark = if is_best { ", the best so far" } else { "" };
                self.progress
                    .line(&format!("step {step}: validation MSE {loss:.6}{remark}"));
            }
            TrainingEvent::CheckpointDamaged { is_previous } => {
                tracing::warn!(is_previous, "a checkpoint is damaged and is not used");
            }
            TrainingEvent::Restored {
                stage, validation_loss, ..
            } => self.validated(stage, validation_loss),
            TrainingEvent::Checkpointed { .. } => {}
        }
    }

    /// The stage's own losses: those of the other stage measure something else.
    fn message(&self, stage: TrainingStage, loss: f64) -> String {
        match self.best[index(stage)] {
            Some(best) => format!("loss {loss:.6}, best validation {best:.6}"),
            None => format!("loss {loss:.6}"),
        }
    }

    fn validated(&mut self, stage: TrainingStage, loss: f64) {
        let best = &mut self.best[index(stage)];
        *best = Some(best.map_or(loss, |best| best.min(loss)));
    }

    fn start(&mut self, stage: TrainingStage, step: usize) {
        let total = self.steps[index(stage)];
        self.progress.start(&stage.to_string(), step as u64, total as u64);
        self.stage = Some(stage);
    }
}

fn index(stage: TrainingStage) -> usize {
    usize::from(stage == TrainingStage::Sequence)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_name_is_a_setting_of_both_program_and_training() {
        let training: toml::Table = TrainConfig::preset("paper")
            .unwrap()
            .to_toml()
            .unwrap()
            .parse()
            .unwrap();
        assert_eq!(
            training.keys().filter(|name| is_setting(name)).collect::<Vec<_>>(),
            [""; 0]
        );
    }

    #[test]
    fn sequence_shows_its_own_best_validation() {
        let progress = ProgressLine::new("steps");
        let config = TrainConfig::preset("paper").unwrap();
        let mut display = TrainingDisplay::new(&progress, &config);
        let mut validated = |stage, loss| {
            display.on_event(TrainingEvent::Validated {
                stage,
                step: 1,
                loss,
                is_best: false,
            });
            display.message(TrainingStage::Sequence, 0.5)
        };
        assert_eq!(validated(TrainingStage::Pretrain, 0.1), "loss 0.500000");
        validated(TrainingStage::Sequence, 0.3);
        assert_eq!(
            validated(TrainingStage::Sequence, 0.4),
            "loss 0.500000, best validation 0.300000"
        );
    }
}
