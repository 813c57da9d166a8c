//! `foreframe backup` and `foreframe restore`

use std::path::PathBuf;

use super::error::CliError;
use super::process::print_line;
use super::settings::{CommonArgs, open_store, with_checked_directories};
use super::workspace::block_on;
use foreframe_jobs::store::restore;

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

pub(super) fn run_restore(args: &RestoreArgs) -> Result<(), CliError> {
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
