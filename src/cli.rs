//! The command line, one file for each subcommand, or for two that belong together. Exit code 2: the command cannot be
//! carried out as it was given. Exit code 1: it failed. Exit code 130: it was interrupted.
//!
//! Subcommands do not use each other. What they share is, in the order in which it may use each other: `error`, `new_key`, `next_step`,
//! `process` and `progress`, `interrupt`, `table`, `scores`, `settings`, `output`, `recorded`, `admin_address`, `workspace`.

mod adapt;
mod admin_address;
mod backup;
mod bridge;
mod calibrate;
mod collect;
mod completions;
mod config;
mod drive;
mod error;
mod evaluate;
mod export;
mod healthcheck;
mod import;
mod inspect;
mod interrupt;
mod jobs;
mod keys;
mod models;
mod new_key;
mod next_step;
mod output;
mod plan;
mod predict;
mod process;
mod progress;
mod publish;
mod recorded;
mod scores;
mod serve;
mod settings;
mod sweep_table;
mod table;
mod train;
mod worker;
mod workspace;

use std::ffi::OsString;
use std::io::Write;
use std::process::ExitCode;

use clap::{Parser, Subcommand};

use self::error::CliError;
use crate::program;
use foreframe_core::error_text::printable;
use foreframe_data::dataset::silence_caught_panics;

/// Predicts the next camera frames of a robot from its frames, its state and its actions.
///
/// Without a command, it serves the models in ./models, like `foreframe serve`, and takes the options of that.
#[derive(Parser)]
#[command(name = "foreframe", version, arg_required_else_help = false)]
#[command(after_help = "Examples:
  foreframe --port 9000                          # serve the shipped models at http://127.0.0.1:9000
  foreframe collect --trials 200                 # simulate a small data set
  foreframe train --preset static                # train a model on it
  foreframe predict --help                       # how to predict from image files")]
struct Cli {
    #[command(subcommand)]
    command: Option<Command>,
}

// A command's help is the documentation of its arguments.
#[derive(Subcommand)]
enum Command {
    Collect(collect::CollectArgs),
    Import(import::ImportArgs),
    Train(train::TrainArgs),
    Adapt(adapt::AdaptArgs),
    Evaluate(evaluate::EvaluateArgs),
    Calibrate(calibrate::CalibrateArgs),
    Predict(predict::PredictArgs),
    Plan(plan::PlanArgs),
    Drive(drive::DriveArgs),
    Bridge(bridge::BridgeArgs),
    Serve(serve::ServeArgs),
    Publish(publish::PublishArgs),
    Models(models::ModelsArgs),
    Keys(keys::KeysArgs),
    Jobs(jobs::JobsArgs),
    Backup(backup::BackupArgs),
    Restore(backup::RestoreArgs),
    Config(config::ConfigArgs),
    Healthcheck(healthcheck::HealthcheckArgs),
    Completions(completions::CompletionsArgs),
    Worker(worker::WorkerArgs),
    /// Run one job for a server or worker, which starts this command
    #[command(hide = true)]
    RunJob,
    Inspect(inspect::InspectArgs),
    Export(export::ExportArgs),
}

/// Runs the program with the arguments of the process and returns its exit code.
#[must_use]
pub fn main() -> ExitCode {
    silence_caught_panics();
    program::announce();
    let arguments = with_command(std::env::args_os().collect());
    let Err(error) = run(Cli::parse_from(arguments).command) else {
        return ExitCode::SUCCESS;
    };
    let Some((sentence, code)) = error.report() else {
        return ExitCode::SUCCESS;
    };
    // If standard error is closed, there is nowhere left to report to.
    let _ = writeln!(std::io::stderr(), "{}", printable(&sentence));
    code
}

/// The arguments with the default command where they begin with one of its options, as in `foreframe --port 9000`.
fn with_command(mut arguments: Vec<OsString>) -> Vec<OsString> {
    let is_own = |option: &str| ["--help", "-h", "--version", "-V"].contains(&option);
    let first = arguments.get(1).and_then(|argument| argument.to_str());
    if first.is_some_and(|first| first.starts_with('-') && !is_own(first)) {
        arguments.insert(1, "serve".into());
    }
    arguments
}

fn run(command: Option<Command>) -> Result<(), CliError> {
    match command.unwrap_or_else(|| Command::Serve(serve::ServeArgs::default())) {
        Command::Collect(args) => collect::run(&args),
        Command::Import(args) => import::run(args),
        Command::Train(args) => train::run(&args),
        Command::Adapt(args) => adapt::run(&args),
        Command::Evaluate(args) => evaluate::run(&args),
        Command::Calibrate(args) => calibrate::run(&args),
        Command::Predict(args) => predict::run(&args),
        Command::Plan(args) => plan::run(&args),
        Command::Drive(args) => drive::run(&args),
        Command::Bridge(args) => bridge::run(args),
        Command::Serve(args) => serve::run(&args),
        Command::Publish(args) => publish::run(&args),
        Command::Models(args) => models::run(&args),
        Command::Worker(args) => worker::run(&args),
        Command::Keys(args) => keys::run(&args),
        Command::Jobs(args) => jobs::run(&args),
        Command::Completions(args) => completions::run(&args),
        Command::Backup(args) => backup::run(&args),
        Command::Restore(args) => backup::run_restore(&args),
        Command::Config(args) => config::run(&args),
        Command::Healthcheck(args) => healthcheck::run(&args),
        Command::RunJob => worker::run_job(),
        Command::Inspect(args) => inspect::run(&args),
        Command::Export(args) => export::run(&args),
    }
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory as _;

    use super::*;

    /// Every command's help, as users read it.
    fn help_texts(command: &mut clap::Command) -> Vec<(String, String)> {
        let mut texts = vec![(command.get_name().to_owned(), command.render_long_help().to_string())];
        let subcommands = command
            .get_subcommands_mut()
            .filter(|command| command.get_name() != "help");
        texts.extend(subcommands.flat_map(help_texts));
        texts
    }

    #[test]
    fn every_example_in_the_help_is_understood() {
        let mut command = Cli::command();
        command.build();
        for (name, text) in help_texts(&mut command) {
            // A setting of the environment may stand before the command, and a comment or a redirection behind it.
            if name == "run-job" {
                // Only servers and workers start it.
                continue;
            }
            let start = |line: &str| {
                line.trim_start()
                    .trim_start_matches("FOREFRAME_MAX_STREAMS=8 ")
                    .to_owned()
            };
            let examples: Vec<String> = text
                .lines()
                .map(start)
                .filter(|line| line.starts_with("foreframe "))
                .collect();
            assert!(!examples.is_empty(), "the help of {name} has no example");
            for example in examples {
                let words = example.split([' ', '#', '>']).take_while(|word| !word.is_empty());
                let parsed = Cli::try_parse_from(with_command(words.clone().map(OsString::from).collect()));
                if let Err(error) = parsed
                    && error.kind() != clap::error::ErrorKind::DisplayHelp
                {
                    panic!("{name}: {example}: {error}");
                }
            }
        }
    }

    #[test]
    fn every_flag_has_the_name_of_its_setting() {
        let settings = crate::config::LoadedConfig::from_layers([]).unwrap().to_toml();
        let mut command = Cli::command();
        command.build();
        let serve = command.find_subcommand("serve").unwrap();
        let flags = serve.get_arguments().filter_map(clap::Arg::get_long);
        for flag in flags.filter(|flag| !["config", "set", "help", "version"].contains(flag)) {
            let key = flag.replace('-', "_");
            let is_listed = settings
                .lines()
                .any(|line| line.starts_with(&format!("{key} = ")) || line == format!("# {key} is not set"));
            assert!(is_listed, "--{flag} has no setting {key}");
        }
    }
}
