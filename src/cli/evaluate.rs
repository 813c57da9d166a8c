//! `foreframe evaluate`

use std::path::PathBuf;

use super::output::OutputDirectory;
use super::settings::CommonArgs;
use super::workspace::Workspace;
use super::{CliError, command_line, print_line, progress::ProgressLine};
use crate::evaluation::{self, EvaluateConfig, EvaluationStage};
use crate::registry::{self, LoadedModel};
use crate::types::Seed;

/// Measure a model on trials that it was not trained on, and write a report with figures and a GIF.
///
/// There are two test sets: trials that training never saw, and start/goal pairs and controller gains that it never saw. The
/// skill is 1 − MSE / MSE of the best simple baseline: 1 is perfect, 0 is no better than the baseline.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  foreframe evaluate --model paper --dataset static-observer
  foreframe evaluate --model runs/moving/model --twin runs/plain/model --out reports/moving
  foreframe evaluate --model mine@2 --dataset small --data-dir /var/lib/foreframe")]
pub(super) struct EvaluateArgs {
    /// The directory of a model, its name, or NAME@VERSION
    #[arg(long)]
    model: String,
    /// The directory of a data set, or its name in DATA_DIR/datasets [default: the scenario that the model was trained on]
    #[arg(long, value_name = "DATASET")]
    dataset: Option<PathBuf>,
    /// A new directory for report.md, report.json and the figures [default: reports/MODEL]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// The same model trained without actions or state, to measure what those inputs are worth
    #[arg(long, value_name = "MODEL")]
    twin: Option<String>,
    /// At most so many windows of each test set, spread evenly over its trials
    #[arg(long, default_value_t = EvaluateConfig::default().max_windows)]
    windows: usize,
    /// Bootstrap resamples of the trials, for the intervals
    #[arg(long, default_value_t = EvaluateConfig::default().bootstrap_samples)]
    resamples: usize,
    /// The seed of the resamples and of the shuffled actions
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Write the scores into the model's manifest too
    #[arg(long)]
    record: bool,
    #[command(flatten)]
    settings: CommonArgs,
}

pub(super) fn run(args: &EvaluateArgs) -> Result<(), CliError> {
    let workspace = Workspace::new(args.settings.start()?);
    let (model_dir, loaded) = workspace.load_model(&args.model)?;
    let twin = args
        .twin
        .as_deref()
        .map(|twin| workspace.load_model(twin))
        .transpose()?;
    let out = args
        .out
        .clone()
        .unwrap_or_else(|| PathBuf::from("reports").join(&loaded.manifest.name));
    let dataset = args.dataset.clone().map_or_else(|| trained_on(&loaded), Ok)?;
    let (_, dataset) = workspace.open_dataset(&dataset)?;
    let output = OutputDirectory::create(&out)?;
    let config = EvaluateConfig {
        max_windows: args.windows,
        bootstrap_samples: args.resamples,
        seed: Seed(args.seed),
        twin: twin.as_ref().map(|(_, twin)| twin),
        command: command_line(),
        ..EvaluateConfig::default()
    };
    let progress = ProgressLine::new("windows");
    progress.label("evaluating");
    let mut report = evaluation::run(&loaded, &dataset, &config, &|now| {
        let what = match now.stage {
            EvaluationStage::Scores => "scores",
            EvaluationStage::Actions => "actions",
        };
        progress.update(now.done as u64, now.total as u64, || format!("{} {what}", now.split));
    })?;
    progress.finish();
    let inputs = evaluation::figure_inputs(&loaded, &dataset, &report)?;
    evaluation::write(output.path(), &mut report, &inputs)?;
    output.finish()?;
    if args.record {
        registry::record_metrics(&model_dir, report.headline())?;
    }
    for (split, score) in report.headline().as_object().into_iter().flatten() {
        print_line(format!("{split}: {score}"))?;
    }
    print_line(out.join("report.md").display())
}

/// The scenario that the model was trained on: the default name of its data set.
fn trained_on(loaded: &LoadedModel) -> Result<PathBuf, CliError> {
    let manifest = &loaded.manifest;
    manifest.dataset.scenario.as_ref().map(PathBuf::from).ok_or_else(|| {
        CliError::Usage(format!(
            "--dataset is missing; model {:?} was trained on {:?}, which is not a simulated scenario",
            manifest.name, manifest.dataset.name
        ))
    })
}
