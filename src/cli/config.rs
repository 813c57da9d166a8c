//! `foreframe config`

use super::error::CliError;
use super::process::print_line;
use super::settings::ServerArgs;

/// Print every setting with its meaning, its range, and where its value comes from.
///
/// The output is a configuration file: edit it and pass it with --config. Flags replace the environment (`FOREFRAME_BIND`,
/// `FOREFRAME_MAX_STREAMS`, …), the environment replaces the file, and the file replaces the defaults. Passwords in URLs are
/// hidden.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  foreframe config
  foreframe config --set drain_ms=2000 > foreframe.toml
  FOREFRAME_MAX_STREAMS=8 foreframe config")]
pub(super) struct ConfigArgs {
    /// Print JSON instead of a configuration file
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    settings: ServerArgs,
}

pub(super) fn run(args: &ConfigArgs) -> Result<(), CliError> {
    let loaded = args.settings.load()?;
    loaded.choose_computation()?;
    if args.json {
        return print_line(serde_json::to_string_pretty(&loaded.to_json()).map_err(CliError::failed)?);
    }
    print_line(loaded.to_toml().trim_end())
}
