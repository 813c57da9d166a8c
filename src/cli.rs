//! The command line: one file a subcommand. Exit code 2 for what was asked wrongly, 1 for what went wrong.

mod collect;
mod evaluate;
mod export;
mod inspect;
mod interrupt;
mod predict;
mod progress;
mod serve;
mod train;
mod worker;

use std::fmt::Display;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::{Parser, Subcommand};

use crate::registry::{self, LoadedModel, RegistryError};
use crate::telemetry;
use crate::training::TrainError;

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
    Collect(collect::Args),
    /// Train a model on a data set
    Train(train::Args),
    /// Measure a model on held-out trials: report, figures, GIF
    Evaluate(evaluate::Args),
    /// Predict the frames that follow those in a directory
    Predict(predict::Args),
    /// Serve models over HTTP and WebSocket (the default)
    Serve(serve::Args),
    /// Work on jobs without serving
    Worker(worker::Args),
    /// Describe a model or a data set
    Inspect(inspect::Args),
    /// Write an episode's frames as PNG, its actions as JSON and a GIF to look at
    Export(export::Args),
}

/// What a subcommand fails with.
enum CliError {
    /// It was asked wrongly.
    Usage(String),
    /// It went wrong.
    Failed(String),
    /// It was interrupted; what was finished is kept.
    Interrupted(String),
}

impl CliError {
    fn failed(error: impl Display) -> Self {
        Self::Failed(error.to_string())
    }

    fn io(action: &str, path: &Path, source: &std::io::Error) -> Self {
        Self::Failed(format!("could not {action} {}: {source}", path.display()))
    }
}

impl From<TrainError> for CliError {
    fn from(error: TrainError) -> Self {
        match error {
            TrainError::UnknownPreset(_) | TrainError::Config(_) => Self::Usage(error.to_string()),
            other => Self::failed(other),
        }
    }
}

impl From<RegistryError> for CliError {
    fn from(error: RegistryError) -> Self {
        match error {
            RegistryError::Unknown { .. } | RegistryError::Name(_) => Self::Usage(error.to_string()),
            other => Self::failed(other),
        }
    }
}

/// Runs the program with the process's arguments and says how it ended.
#[must_use]
pub fn main() -> ExitCode {
    telemetry::init();
    let result = match Cli::parse().command {
        Some(Command::Collect(args)) => collect::run(args),
        Some(Command::Train(args)) => train::run(&args),
        Some(Command::Evaluate(args)) => evaluate::run(&args),
        Some(Command::Predict(args)) => predict::run(&args),
        Some(Command::Serve(args)) => serve::run(&args),
        Some(Command::Worker(args)) => worker::run(&args),
        Some(Command::Inspect(args)) => inspect::run(&args),
        Some(Command::Export(args)) => export::run(&args),
        None => serve::run(&serve::Args::default()),
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(CliError::Usage(message)) => stop(&format!("error: {message}"), 2),
        Err(CliError::Failed(message)) => stop(&format!("error: {message}"), 1),
        Err(CliError::Interrupted(message)) => stop(&message, 130),
    }
}

fn stop(message: &str, code: u8) -> ExitCode {
    // Nothing is left to do if even standard error is closed.
    let _ = writeln!(std::io::stderr(), "{message}");
    ExitCode::from(code)
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
    let given = Path::new(model);
    let dir = if given.join(registry::MANIFEST_FILE).is_file() {
        given.to_owned()
    } else {
        registry::find(models_dir, model)?
    };
    let loaded = registry::load(&dir)?;
    Ok((dir, loaded))
}
