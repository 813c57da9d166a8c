//! `foreframe restore`

use std::path::PathBuf;

use super::error::CliError;
use super::process::print_line;
use super::settings::CommonArgs;
use foreframe_jobs::store::restore;

/// Restore a backup into a new data directory.
///
/// Every file is compared with the hash in the backup. A server refuses a data directory whose restore did not finish.
#[derive(clap::Args)]
#[command(after_help = "Example:
  foreframe restore /mnt/backups/monday --data-dir /var/lib/foreframe")]
pub(super) struct RestoreArgs {
    /// The directory of the backup
    #[arg(value_name = "DIR")]
    dir: PathBuf,
    #[command(flatten)]
    settings: CommonArgs,
}

pub(super) fn run(args: &RestoreArgs) -> Result<(), CliError> {
    let config = args.settings.start()?;
    let index = restore(&args.dir, &config.server.store())?;
    print_line(format!(
        "{} files with {} bytes are restored to {}",
        index.files.len(),
        index.total_bytes(),
        config.server.data_dir.display()
    ))?;
    if !index.has_database {
        print_line("the backup holds no database: restore that of PostgreSQL with its own tools")?;
    }
    Ok(())
}
