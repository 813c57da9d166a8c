//! The command line: one file a subcommand. Exit code 2 for what was asked wrongly, 1 for what went wrong.

mod collect;
mod config;
mod error;
mod evaluate;
mod export;
mod healthcheck;
mod import;
mod inspect;
mod interrupt;
mod keys;
mod predict;
mod progress;
mod run_job;
mod serve;
mod settings;
mod train;
mod worker;

use std::fmt::Display;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::{Parser, Subcommand};

use self::error::CliError;
use crate::dataset::{self, Dataset};
use crate::registry::{self, LoadedModel};
use crate::telemetry::{self, LogFormat};

/// Where data sets are kept: also the server's jobs find them there.
const DATASETS_DIR: &str = "data/datasets";

/// Sees a few moments ahead for robots: predicts the camera frames to come from frames, actions and state.
///
/// Without a command it serves the models in ./models.
#[derive(Parser)]
#[command(name = "foreframe", version, arg_required_else_help = false)]
struct Cli {
    #[command(subcommand)]
    command: Option<Command>,
}

#[derive(Subcommand)]
enum Command {
    /// Simulate trials and store their frames, actions and states
    Collect(collect::CollectArgs),
    /// Turn a recording of a real robot into a data set
    Import(import::ImportArgs),
    /// Train a model on a data set
    Train(train::TrainArgs),
    /// Measure a model on held-out trials: report, figures, GIF
    Evaluate(evaluate::EvaluateArgs),
    /// Predict the frames that follow those in a directory
    Predict(predict::PredictArgs),
    /// Serve models over HTTP and WebSocket (the default)
    Serve(serve::ServeArgs),
    /// Make, list and revoke API keys
    Keys(keys::KeysArgs),
    /// Print every setting with where it comes from
    Config(config::ConfigArgs),
    /// Ask a running server whether it is ready
    Healthcheck(healthcheck::HealthcheckArgs),
    /// Work on jobs without serving
    Worker(worker::WorkerArgs),
    /// Run one job for a server or worker, which starts this command
    #[command(hide = true)]
    RunJob,
    /// Describe a model or a data set
    Inspect(inspect::InspectArgs),
    /// Write an episode's frames as PNG, its actions as JSON and a GIF to look at
    Export(export::ExportArgs),
}

/// Runs the program with the process's arguments and says how it ended.
#[must_use]
pub fn main() -> ExitCode {
    let Err(error) = run(Cli::parse().command) else {
        return ExitCode::SUCCESS;
    };
    let (sentence, code) = error.told();
    // Nothing is left to do if even standard error is closed.
    let _ = writeln!(std::io::stderr(), "{sentence}");
    code
}

fn run(command: Option<Command>) -> Result<(), CliError> {
    let command = command.unwrap_or_else(|| Command::Serve(serve::ServeArgs::default()));
    // The logs of those that run long have settings.
    let _telemetry = match &command {
        Command::Serve(_) | Command::Worker(_) => None,
        _ => Some(telemetry::init(LogFormat::Text, None)?),
    };
    match command {
        Command::Collect(args) => collect::run(args),
        Command::Import(args) => import::run(args),
        Command::Train(args) => train::run(&args),
        Command::Evaluate(args) => evaluate::run(&args),
        Command::Predict(args) => predict::run(&args),
        Command::Serve(args) => serve::run(&args),
        Command::Worker(args) => worker::run(&args),
        Command::Keys(args) => keys::run(&args),
        Command::Config(args) => config::run(&args),
        Command::Healthcheck(args) => healthcheck::run(&args),
        Command::RunJob => run_job::run(),
        Command::Inspect(args) => inspect::run(&args),
        Command::Export(args) => export::run(&args),
    }
}

/// Writes a line of the command's answer to standard output.
fn say(line: impl Display) -> Result<(), CliError> {
    writeln!(std::io::stdout(), "{line}")
        .map_err(|error| CliError::Failed(format!("could not write the answer: {error}")))
}

/// The command line as it was given, for stamps.
fn command_line() -> String {
    std::env::args()
        .enumerate()
        .map(|(index, argument)| match index {
            0 => "foreframe".to_owned(),
            _ if argument.contains([' ', '"', '\'']) => format!("'{}'", argument.replace('\'', r"'\''")),
            _ => argument,
        })
        .collect::<Vec<_>>()
        .join(" ")
}

/// Loads a model by the directory it stands in, or by its name in the models' directory.
fn load_model(model: &str, models_dir: &Path) -> Result<(PathBuf, LoadedModel), CliError> {
    let dir = registry::locate(models_dir, model)?;
    let loaded = registry::load(&dir)?;
    Ok((dir, loaded))
}

/// Reads a data set by the directory it stands in, or by its name in [`DATASETS_DIR`].
fn open_dataset(dataset: &Path) -> Result<(PathBuf, Dataset), CliError> {
    let dir = dataset::find(Path::new(DATASETS_DIR), dataset)?;
    let dataset = Dataset::open(&dir)?;
    Ok((dir, dataset))
}
