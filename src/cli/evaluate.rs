//! `foreframe evaluate`

use std::path::PathBuf;

use super::{CliError, command_line, load_model, open_dataset, progress::ProgressLine, say};
use crate::evaluation::{self, EvaluateConfig, Purpose};
use crate::registry::{self, LoadedModel};
use crate::types::Seed;

/// Score a model on data that training never saw: report, figures, GIF.
///
/// Three test sets: trials, start/goal pairs and controller gains that training never saw. The skill is the share of the
/// strongest baseline's error that the model removes. To choose between models or settings, use `--split validation`;
/// the test sets are for the final numbers.
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
    /// A model of the same training budget that lacks the action, the state or both, for the table that shows what each
    /// input is worth; may be given several times
    #[arg(long, value_name = "MODEL")]
    twin: Vec<String>,
    /// What to score: the validation split, or the test sets
    #[arg(long, value_enum, default_value_t = SplitChoice::Test)]
    split: SplitChoice,
    /// Windows of each set at most, spread evenly over its trials
    #[arg(long, default_value_t = EvaluateConfig::default().max_windows)]
    windows: usize,
    /// Resamples of the trials for the intervals
    #[arg(long, default_value_t = EvaluateConfig::default().bootstrap_samples)]
    resamples: usize,
    /// Seed of the resamples and the shuffled actions
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Also write the scores into the model's manifest; scores of other splits in it are kept
    #[arg(long)]
    record: bool,
    /// Where models are looked for by name
    #[arg(long, value_name = "DIR", default_value = "models")]
    models: PathBuf,
}

/// What to score.
#[derive(Clone, Copy, clap::ValueEnum)]
enum SplitChoice {
    /// The validation split, to choose between models or settings
    Validation,
    /// The test sets, for the final numbers
    Test,
}

pub(super) fn run(args: &EvaluateArgs) -> Result<(), CliError> {
    let (model_dir, loaded) = load_model(&args.model, &args.models)?;
    let twins = args
        .twin
        .iter()
        .map(|twin| Ok(load_model(twin, &args.models)?.1))
        .collect::<Result<Vec<LoadedModel>, CliError>>()?;
    let out = args
        .out
        .clone()
        .unwrap_or_else(|| PathBuf::from("reports").join(&loaded.manifest.name));
    let (_, dataset) = open_dataset(&args.dataset.clone().map_or_else(|| trained_on(&loaded), Ok)?)?;
    evaluation::prepare(&out)?;
    let config = EvaluateConfig {
        purpose: match args.split {
            SplitChoice::Validation => Purpose::Validation,
            SplitChoice::Test => Purpose::Test,
        },
        max_windows: args.windows,
        bootstrap_samples: args.resamples,
        seed: Seed(args.seed),
        twins: twins.iter().collect(),
        command: command_line(),
        ..EvaluateConfig::default()
    };
    let progress = ProgressLine::new("windows");
    let mut report = evaluation::run(&loaded, &dataset, &config, &|now| {
        let stage = now.stage.name();
        progress.update(now.done as u64, now.total as u64, || format!("{} {stage}", now.split));
    })?;
    progress.finish();
    let inputs = evaluation::figure_inputs(&loaded, &dataset, &report)?;
    let [markdown, _] = evaluation::write(&out, &mut report, &inputs)?;
    if args.record {
        let mut scores = report.headline();
        if config.purpose == Purpose::Test {
            // Earlier versions scored unseen pairs and gains as one set.
            scores["test-unseen"] = serde_json::Value::Null;
        }
        registry::record_metrics(&model_dir, scores)?;
    }
    for (split, score) in report.headline().as_object().into_iter().flatten() {
        say(format!("{split}: {score}"))?;
    }
    say(markdown.display())
}

/// The scenario that the model was trained on: also the name of its data set, unless another name was given.
fn trained_on(loaded: &LoadedModel) -> Result<PathBuf, CliError> {
    let manifest = &loaded.manifest;
    manifest.dataset.scenario.as_ref().map(PathBuf::from).ok_or_else(|| {
        CliError::Usage(format!(
            "--dataset is missing; model {:?} was trained on {:?}, which is no simulated scenario",
            manifest.name, manifest.dataset.name
        ))
    })
}
