//! `foreframe config`

use super::settings::Settings;
use super::{CliError, say};

/// Print every setting with what it means, its range, and where its value comes from.
///
/// The output is a configuration file: edit it and pass it with --config. Flags go over the environment (`FOREFRAME_BIND`,
/// `FOREFRAME_MAX_STREAMS`, …), that over the file, that over the defaults. Passwords in URLs are not shown.
#[derive(clap::Args)]
#[command(after_help = "Example: FOREFRAME_MAX_STREAMS=8 foreframe config --set drain_ms=2000 > mine.toml")]
pub(super) struct ConfigArgs {
    #[command(flatten)]
    settings: Settings,
}

pub(super) fn run(args: &ConfigArgs) -> Result<(), CliError> {
    say(args.settings.load()?.to_toml().trim_end())
}
