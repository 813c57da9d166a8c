//! `foreframe evaluate`

use std::path::PathBuf;

use super::{CliError, command_line, load_model, open_dataset, progress::ProgressLine, say};
use crate::evaluation::{self, EvaluateConfig, EvaluationStage};
use crate::registry::{self, LoadedModel};
use crate::types::Seed;

/// Measure a model on held-out trials: report, figures, GIF.
///
/// Two test sets: trials that training never saw, and start/goal pairs and controller gains that it never saw. The skill is
/// the share of the best trivial baseline's error that the model takes away.
#[derive(clap::Args)]
#[command(after_help = "Example: foreframe evaluate --model paper --dataset static-observer --out reports/paper")]
pub(super) struct EvaluateArgs {
    /// A model's name or directory
    #[arg(long)]
    model: String,
    /// The data set's directory, or its name in data/datasets [default: that of the scenario the model was trained on]
    #[arg(long, value_name = "DATASET")]
    dataset: Option<PathBuf>,
    /// The directory to write report.md, report.json and figures into [default: reports/MODEL]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// An unconditioned model of the same budget, for the table that tells whether the action matters
    #[arg(long, value_name = "MODEL")]
    twin: Option<String>,
    /// Windows of each test set at most, spread evenly over its trials
    #[arg(long, default_value_t = EvaluateConfig::default().max_windows)]
    windows: usize,
    /// Resamples of the trials for the intervals
    #[arg(long, default_value_t = EvaluateConfig::default().bootstrap_samples)]
    resamples: usize,
    /// Seed of the resamples and the shuffled actions
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Write the scores into the model's manifest too
    #[arg(long)]
    record: bool,
    /// Where models are looked for by name
    #[arg(long, value_name = "DIR", default_value = "models")]
    models: PathBuf,
}

pub(super) fn run(args: &EvaluateArgs) -> Result<(), CliError> {
    let (model_dir, loaded) = load_model(&args.model, &args.models)?;
    let twin = args
        .twin
        .as_deref()
        .map(|twin| load_model(twin, &args.models))
        .transpose()?;
    let out = args
        .out
        .clone()
        .unwrap_or_else(|| PathBuf::from("reports").join(&loaded.manifest.name));
    let (_, dataset) = open_dataset(&args.dataset.clone().map_or_else(|| trained_on(&loaded), Ok)?)?;
    evaluation::prepare(&out)?;
    let config = EvaluateConfig {
        max_windows: args.windows,
        bootstrap_samples: args.resamples,
        seed: Seed(args.seed),
        twin: twin.as_ref().map(|(_, twin)| twin),
        command: command_line(),
        ..EvaluateConfig::default()
    };
    let progress = ProgressLine::new("windows");
    let mut report = evaluation::run(&loaded, &dataset, &config, &|now| {
        let what = match now.stage {
            EvaluationStage::Scores => "scores",
            EvaluationStage::Actions => "actions",
        };
        progress.update(now.done as u64, now.total as u64, || format!("{} {what}", now.split));
    })?;
    progress.finish();
    let inputs = evaluation::figure_inputs(&loaded, &dataset, &report)?;
    let [markdown, _] = evaluation::write(&out, &mut report, &inputs)?;
    if args.record {
        registry::record_metrics(&model_dir, report.headline())?;
    }
    for (split, score) in report.headline().as_object().into_iter().flatten() {
        say(format!("{split}: {score}"))?;
    }
    say(markdown.display())
}

/// The scenario that the model was trained on, which is its data set's name unless another was given.
fn trained_on(loaded: &LoadedModel) -> Result<PathBuf, CliError> {
    let manifest = &loaded.manifest;
    manifest.dataset.scenario.as_ref().map(PathBuf::from).ok_or_else(|| {
        CliError::Usage(format!(
            "--dataset is missing; model {:?} was trained on {:?}, which no scenario made",
            manifest.name, manifest.dataset.name
        ))
    })
}
