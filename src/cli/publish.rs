//! `foreframe publish`

use std::path::{Path, PathBuf};

use super::error::CliError;
use super::process::print_line;
use super::settings::{CommonArgs, with_checked_directories};
use super::workspace::{Workspace, block_on};
use foreframe_core::registry::{self, MANIFEST_FILE};

/// The directory of the model in a run's directory.
const RUN_MODEL: &str = "model";

/// Give a trained model to the server, as the next version of its name.
///
/// The model is checked and copied into the data directory. The new version becomes active: a running server that uses the same
/// data directory loads it within seconds, any other server at its next start. Streams that are open keep the version that they
/// started with.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  foreframe publish runs/paper
  foreframe publish runs/moving-2 --name moving
  foreframe publish runs/moving-2 --name moving --no-activate --data-dir /var/lib/foreframe")]
pub(super) struct PublishArgs {
    /// The directory of a training run, or of a model
    #[arg(value_name = "DIR")]
    dir: PathBuf,
    /// The name to publish it under: 1 to 64 of a–z, 0–9 and '-' [default: the name that it was trained with]
    #[arg(long)]
    name: Option<String>,
    /// Publish the version, but leave the active version as it is
    #[arg(long)]
    no_activate: bool,
    #[command(flatten)]
    settings: CommonArgs,
}

pub(super) fn run(args: &PublishArgs) -> Result<(), CliError> {
    let loaded = args.settings.load()?;
    let workspace = Workspace::new(with_checked_directories(loaded)?);
    let model_dir = model_directory(&args.dir)?;
    let name = match &args.name {
        Some(name) => registry::model_name(name)?,
        None => registry::manifest::read(&model_dir)?.name,
    };
    let version = block_on(async {
        let versions = workspace.versions().await?;
        Ok(versions.publish(&name, &model_dir, !args.no_activate).await?)
    })?;
    if args.no_activate {
        print_line(format!(
            "published {name}@{version}; `foreframe models activate {name}@{version}{}` makes it the active version",
            args.settings.repeated()
        ))
    } else {
        print_line(format!("published {name}@{version}; it is the active version"))
    }
}

/// The model in a directory, which is that of a model or of a finished training run.
fn model_directory(dir: &Path) -> Result<PathBuf, CliError> {
    let of_run = dir.join(RUN_MODEL);
    let found = [dir, &of_run].into_iter().find(|dir| dir.join(MANIFEST_FILE).is_file());
    found.map(Path::to_owned).ok_or_else(|| {
        CliError::Usage(format!(
            "{} holds no model ({MANIFEST_FILE} is missing); name the directory of a finished training run, as in runs/paper",
            dir.display()
        ))
    })
}
