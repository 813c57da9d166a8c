//! `foreframe train`

use std::path::{Path, PathBuf};

use super::{CliError, command_line, interrupt, open_dataset, progress::ProgressLine, say};
use crate::training::{self, TrainConfig, Training, TrainingEvent, TrainingOutcome, TrainingStage};

/// Train a model on a data set.
///
/// Two stages: the dense codec alone (pretrain), then the recurrent network (fit). Validation chooses the weights. Ctrl-C
/// writes a checkpoint, and so does every few hundred steps; the same command goes on from it, to the same weights as if
/// it had never stopped.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  foreframe train --preset paper --dataset static-observer
  foreframe train --preset moving --set seed=2 --set fit.steps=4000 --out runs/moving-2
  foreframe train --preset paper --print-config > mine.toml   # every field, to edit and pass with --config")]
pub(super) struct TrainArgs {
    /// paper (1000 windows), static (all windows) or moving (told the robot's state and actions)
    #[arg(long, default_value = "paper")]
    preset: String,
    /// The data set's directory, or its name in data/datasets [default: static-observer or, for moving, moving-observer]
    #[arg(long, value_name = "DATASET")]
    dataset: Option<PathBuf>,
    /// The run's directory: configuration, checkpoint and at the end the model [default: runs/NAME]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// A TOML file whose fields replace the preset's
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// One field, as in fit.steps=3000; may be given many times, and goes over --config
    #[arg(long = "set", value_name = "KEY=VALUE")]
    settings: Vec<String>,
    /// Print the configuration and stop
    #[arg(long)]
    print_config: bool,
}

pub(super) fn run(args: &TrainArgs) -> Result<(), CliError> {
    let file = args.config.as_deref().map(read_config).transpose()?;
    let config = TrainConfig::layered(&args.preset, file.as_deref(), &args.settings)?;
    if args.print_config {
        return say(config.to_toml()?.trim_end());
    }
    let dataset = args.dataset.clone().unwrap_or_else(|| default_dataset(&args.preset));
    let (dataset_dir, dataset) = open_dataset(&dataset)?;
    let run_dir = args
        .out
        .clone()
        .unwrap_or_else(|| PathBuf::from("runs").join(&config.name));
    let command = command_line();
    let job = Training {
        config: &config,
        dataset: &dataset,
        run_dir: &run_dir,
        command: &command,
    };
    let cancelled = interrupt::flag()?;
    let progress = ProgressLine::new("steps");
    let mut watch = TrainingDisplay::new(&progress, &config);
    let outcome = training::run(&job, &mut |event: TrainingEvent| watch.on_event(event), &cancelled);
    progress.finish();
    match outcome? {
        TrainingOutcome::Finished { model_dir, manifest } => say(format!(
            "{}: {} parameters, validation {}\nnext: foreframe evaluate --model {} --dataset {}",
            model_dir.display(),
            manifest.parameters,
            manifest.metrics["validation"],
            model_dir.display(),
            dataset_dir.display(),
        )),
        TrainingOutcome::Interrupted { stage, step } => Err(CliError::Interrupted(format!(
            "stopped in {stage} after step {step}; the checkpoint is in {}, the same command goes on from it",
            run_dir.display()
        ))),
    }
}

fn read_config(path: &Path) -> Result<String, CliError> {
    std::fs::read_to_string(path).map_err(|error| CliError::io("read", path, &error))
}

fn default_dataset(preset: &str) -> PathBuf {
    PathBuf::from(if preset.starts_with("moving") {
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
    validation: Option<f64>,
}

impl<'a> TrainingDisplay<'a> {
    fn new(progress: &'a ProgressLine, config: &TrainConfig) -> Self {
        Self {
            progress,
            steps: [config.pretrain.steps, config.fit.steps],
            stage: None,
            validation: None,
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
                let validation = self.validation;
                self.progress.update(step as u64, steps as u64, || match validation {
                    Some(best) => format!("loss {loss:.6}, validation {best:.6}"),
                    None => format!("loss {loss:.6}"),
                });
            }
            TrainingEvent::Validated {
                step, loss, is_best, ..
            } => {
                self.validation = Some(loss);
                let kept = if is_best { ", the best so far" } else { "" };
                self.progress
                    .line(&format!("step {step}: validation MSE {loss:.6}{kept}"));
            }
            TrainingEvent::Recalled { .. } | TrainingEvent::Checkpointed { .. } => {}
        }
    }

    fn start(&mut self, stage: TrainingStage, step: usize) {
        let total = self.steps[usize::from(stage == TrainingStage::Fit)];
        self.progress.start(&stage.to_string(), step as u64, total as u64);
        self.stage = Some(stage);
    }
}
