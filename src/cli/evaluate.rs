//! `foreframe evaluate`

use std::collections::BTreeMap;
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};

use clap::value_parser;
use serde_json::{Value, json};

use super::error::CliError;
use super::output::OutputDirectory;
use super::process::{command_line, print_line};
use super::progress::ProgressLine;
use super::scores::print_scores;
use super::settings::CommonArgs;
use super::workspace::{Workspace, trained_on};
use foreframe_core::registry::{self, Model};
use foreframe_core::types::Seed;
use foreframe_data::dataset::Dataset;
use foreframe_jobs::jobs::spec::MAX_RESAMPLES;
use foreframe_train::evaluation::{
    self, EvaluateConfig, EvaluationReport, MIN_RESAMPLES, NEAREST_WINDOWS, ScoredSplit,
};

/// The page that `--html` adds to the report.
const PAGE: &str = "report.html";

/// The factors of `--brightness`.
const BRIGHTNESS: RangeInclusive<f64> = 0.1..=3.0;

/// Measure a model on data that training never saw, and write a report with figures and a GIF.
///
/// There are three test sets: trials, start/goal pairs (where robots drive to one goal) and controller gains that training never
/// saw. Of rooms that are only for tests, all trials are scored. The skill is 1 − MSE / MSE
/// of the strongest baseline: 1 is perfect, 0 is no better than the baseline. Some baselines learn from the training part of the
/// data set; for a model that was not trained on it, there is a second skill, against the others. To choose between models or
/// settings, use `--split validation`; the test sets are for the final numbers.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  foreframe evaluate --model paper --dataset static-observer --html
  foreframe evaluate --model runs/moving/model --twin runs/plain/model --out reports/moving
  foreframe evaluate --model mine@2 --dataset small --data-dir /var/lib/foreframe
  foreframe evaluate --model runs/moving-mnist/model --dataset mnist-test-seq --split all
  foreframe evaluate --model donkeycar --dataset my-car --brightness 0.7 --out reports/darker")]
pub(super) struct EvaluateArgs {
    /// The directory of a model, its name, or NAME@VERSION
    #[arg(long)]
    model: String,
    /// The directory of a data set, or its name in `DATA_DIR/datasets` [default: the scenario that the model was trained on]
    #[arg(long, value_name = "DATASET")]
    dataset: Option<PathBuf>,
    /// A new directory for report.md, report.json and the figures [default: reports/MODEL]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// A model of the same training budget that lacks the action, the state or both, for the table that shows what each
    /// input is worth; may be given several times
    #[arg(long, value_name = "MODEL")]
    twin: Vec<String>,
    /// A data set whose frames are unlike those of the training, to test the model's novelty; frames of another size are cropped
    /// and resized; may be given several times
    #[arg(long, value_name = "DATASET")]
    novel_dataset: Vec<PathBuf>,
    /// What to score
    #[arg(long, value_enum, default_value_t = SplitChoice::Test)]
    split: SplitChoice,
    /// Windows of each set at most, spread evenly over its trials or blocks of time
    #[arg(long, default_value_t = EvaluateConfig::default().max_windows)]
    windows: usize,
    /// Training windows among which the baseline looks for the 8 nearest, at most; evenly spread if there are more. Each takes up
    /// to 256 bytes of memory for each input frame. Give as many as the model was trained on to compare a model of few windows
    /// with a baseline that knows as little
    #[arg(long, value_name = "WINDOWS", default_value_t = NEAREST_WINDOWS as u32, value_parser = value_parser!(u32).range(1..))]
    nearest_windows: u32,
    /// Bootstrap resamples of the trials or blocks of time, for the intervals; at least 100
    #[arg(long, default_value_t = EvaluateConfig::default().bootstrap_samples as u32, value_parser = value_parser!(u32).range(MIN_RESAMPLES as i64..=MAX_RESAMPLES as i64))]
    resamples: u32,
    /// Multiply the intensities of all frames of the scored data set, inputs and truth, by this before anything is scored, and
    /// limit them to white: does the model still predict in darker or brighter light? From 0.1 to 3
    #[arg(long, value_name = "FACTOR", default_value_t = 1.0, allow_negative_numbers = true, value_parser = brightness, conflicts_with = "save_scores")]
    brightness: f64,
    /// The seed of the resamples and of the shuffled actions
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Fail if the skill on any set is lower than this; the report is written anyway
    #[arg(long, value_name = "SKILL", allow_negative_numbers = true, value_parser = skill)]
    min_skill: Option<f64>,
    /// Also write the scores into the model's manifest, unless they are of frames that were in its training; scores of other splits in
    /// it are kept, and those of another data set are not replaced
    #[arg(long)]
    save_scores: bool,
    /// Also write the report with its figures as one page, report.html
    #[arg(long)]
    html: bool,
    /// Print the scores as JSON instead of a table
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    settings: CommonArgs,
}

/// What to score.
#[derive(Clone, Copy, clap::ValueEnum)]
enum SplitChoice {
    /// The validation split, to choose between models or settings
    Validation,
    /// The test sets, for the final numbers
    Test,
    /// Every window of a data set that holds nothing but test data, such as the published file of a benchmark
    All,
}

impl From<SplitChoice> for ScoredSplit {
    fn from(choice: SplitChoice) -> Self {
        match choice {
            SplitChoice::Validation => Self::Validation,
            SplitChoice::Test => Self::Test,
            SplitChoice::All => Self::WholeSet,
        }
    }
}

/// Reads a skill, which is at most 1.
fn skill(text: &str) -> Result<f64, String> {
    let skill = text
        .parse()
        .ok()
        .filter(|skill: &f64| skill.is_finite() && *skill <= 1.0);
    skill.ok_or_else(|| "a skill is a number of at most 1, as in 0.2".to_owned())
}

/// Reads a factor of brightness.
fn brightness(text: &str) -> Result<f64, String> {
    let factor = text.parse().ok().filter(|factor| BRIGHTNESS.contains(factor));
    factor.ok_or_else(|| {
        let (least, most) = (BRIGHTNESS.start(), BRIGHTNESS.end());
        format!("a brightness is a number from {least} to {most}, as in 0.7; 1 leaves the frames as they are")
    })
}

pub(super) fn run(args: &EvaluateArgs) -> Result<(), CliError> {
    let workspace = Workspace::new(args.settings.start()?);
    let (model_dir, loaded) = workspace.load_model(&args.model)?;
    let twins = args
        .twin
        .iter()
        .map(|twin| Ok(workspace.load_model(twin)?.1))
        .collect::<Result<Vec<Model>, CliError>>()?;
    let out = args
        .out
        .clone()
        .unwrap_or_else(|| PathBuf::from("reports").join(&loaded.manifest.name));
    let dataset = args.dataset.clone().map_or_else(|| trained_on(&loaded), Ok)?;
    let (_, mut dataset) = workspace.open_dataset(&dataset)?;
    if args.brightness != 1.0 {
        dataset = dataset.with_brightness(args.brightness);
    }
    let novel = args
        .novel_dataset
        .iter()
        .map(|novel| Ok(workspace.open_dataset(novel)?.1))
        .collect::<Result<Vec<Dataset>, CliError>>()?;
    let split = ScoredSplit::from(args.split);
    if args.save_scores {
        evaluation::check_saving(&loaded, &dataset, split)?;
    }
    let output = OutputDirectory::create(&out)?;
    let config = EvaluateConfig {
        split,
        max_windows: args.windows,
        nearest_windows: args.nearest_windows as usize,
        bootstrap_samples: args.resamples as usize,
        seed: Seed(args.seed),
        twins: twins.iter().collect(),
        novel: novel.iter().collect(),
        command: command_line(),
        ..EvaluateConfig::default()
    };
    let progress = ProgressLine::new("windows");
    progress.label("evaluating");
    let mut report = evaluation::run(&loaded, &dataset, &config, &|now| {
        let stage = now.stage.name();
        progress.update(now.done as u64, now.total as u64, || format!("{} {stage}", now.split));
    })?;
    progress.finish();
    let figures = evaluation::draw_figures(&loaded, &dataset, &report)?;
    evaluation::write(output.path(), &mut report, &figures)?;
    if args.html {
        output.write(PAGE, evaluation::html_page(&report, &figures).as_bytes())?;
    }
    output.finish()?;
    if args.json {
        print_line(as_json(&report, &out))?;
    } else {
        print_summary(&report, &out, args.html)?;
    }
    if args.save_scores {
        save_scores(&report, &model_dir)?;
    }
    args.min_skill.map_or(Ok(()), |least| require_skill(&report, least))
}

/// Writes the scores into the model's manifest. Errors: `Failed` if they are of frames that were in its training.
fn save_scores(report: &EvaluationReport, model_dir: &Path) -> Result<(), CliError> {
    if report.has_frames_of_training() {
        return Err(CliError::Failed(format!(
            "frames of data set \"{}\" were in the training of model \"{}\", so its scores are not saved; the report is written",
            report.stamp.dataset, report.stamp.model
        )));
    }
    let mut scores = report.headline();
    for skipped in report.sets.iter().filter(|set| set.outcome.scores().is_none()) {
        scores[&skipped.split] = Value::Null;
    }
    Ok(registry::record_metrics(model_dir, scores)?)
}

/// The scores in a table, what they say, and where the report is.
fn print_summary(report: &EvaluationReport, out: &Path, has_page: bool) -> Result<(), CliError> {
    print_scores(&report.headline(), "")?;
    for set in &report.sets {
        let Some(scores) = set.outcome.scores() else { continue };
        let verdicts = [report.verdict(set), scores.verdict_against_unfitted()];
        for verdict in verdicts.into_iter().flatten() {
            print_line(format!("{}: {verdict}", set.split))?;
        }
    }
    if let Some(factor) = report.stamp.brightness {
        print_line(format!(
            "brightness: all frames were multiplied by {factor} and limited to white"
        ))?;
    }
    for set in &report.sets {
        let scores = set.outcome.scores().and_then(|scores| scores.uncertainty.as_ref());
        if let Some(auroc) = scores.and_then(|scores| scores.wrong_origin_auroc) {
            print_line(format!(
                "{}: novelty of poses counted from the trial's start: AUROC {auroc:.3}",
                set.split
            ))?;
        }
    }
    for other in &report.novelty {
        print_line(format!("novelty of {}: AUROC {:.3}", other.dataset, other.auroc))?;
    }
    let file = if has_page { PAGE } else { "report.md" };
    print_line(format!("report: {}", out.join(file).display()))
}

/// What the scores of each set say.
fn verdicts(report: &EvaluationReport) -> impl Iterator<Item = (&str, String)> {
    let sets = report.sets.iter();
    sets.filter_map(|set| Some((set.split.as_str(), report.verdict(set)?)))
}

/// The same for programs, in one line.
fn as_json(report: &EvaluationReport, out: &Path) -> Value {
    json!({
        "model": report.stamp.model,
        "dataset": report.stamp.dataset,
        "brightness": report.stamp.brightness.unwrap_or(1.0),
        "sets": report.headline(),
        "verdicts": verdicts(report).collect::<BTreeMap<_, _>>(),
        "novelty": report.novelty,
        "report": out.join("report.json"),
    })
}

/// Errors: `Failed` with the first set whose skill is lower.
fn require_skill(report: &EvaluationReport, least: f64) -> Result<(), CliError> {
    for set in &report.sets {
        let found = set.outcome.scores().map(|scores| scores.skill.skill.mean);
        if let Some(found) = found.filter(|&found| found < least) {
            return Err(CliError::Failed(format!(
                "the skill on {} is {found:.3}; --min-skill asks for {least} or more",
                set.split
            )));
        }
    }
    Ok(())
}
