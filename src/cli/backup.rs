//! `foreframe backup`

use std::path::PathBuf;

use super::error::CliError;
use super::process::print_line;
use super::settings::{CommonArgs, open_store, with_checked_directories};
use super::workspace::block_on;

/// Copy the data directory and its database into a new directory, also while a server runs.
///
/// The backup holds the models, data sets, runs, reports and API keys (as hashes), and the database in one consistent state. It
/// does not hold a PostgreSQL database (database-url) nor a shared object store (objects-url): back those up with their own
/// tools, the database first.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  foreframe backup /mnt/backups/monday
  foreframe backup /mnt/backups/monday --data-dir /var/lib/foreframe")]
pub(super) struct BackupArgs {
    /// The directory to make; it must not exist, or be empty
    #[arg(value_name = "DIR")]
    dir: PathBuf,
    #[command(flatten)]
    settings: CommonArgs,
}

pub(super) fn run(args: &BackupArgs) -> Result<(), CliError> {
    let config = with_checked_directories(args.settings.load()?)?;
    if !config.server.store().exists() {
        return Err(CliError::Usage(format!(
            "there is nothing to back up in {}; name the data directory with --data-dir",
            config.server.data_dir.display()
        )));
    }
    let (index, are_shared) = block_on(async {
        let store = open_store(&config).await?;
        Ok((store.back_up(&args.dir).await?, store.objects().are_shared()))
    })?;
    print_line(format!(
        "{} files with {} bytes are in {}",
        index.files.len(),
        index.total_bytes(),
        args.dir.display()
    ))?;
    if !index.has_database {
        print_line("the PostgreSQL database is not in the backup: back it up with pg_dump before the files")?;
    }
    if are_shared {
        print_line(
            "the files of objects_url are not in the backup, except for local copies: back up that store itself",
        )?;
    }
    Ok(())
}
