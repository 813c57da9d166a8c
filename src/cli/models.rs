//! `foreframe models`

use std::path::PathBuf;

use serde::Serialize;

use super::error::CliError;
use super::process::print_line;
use super::settings::{CommonArgs, with_checked_directories};
use super::workspace::{Workspace, block_on, split_version};
use foreframe_core::registry;
use foreframe_core::types::ModelName;
use foreframe_jobs::versions::Versions;

/// List, activate and remove versions of models.
///
/// A model has the version that came with the program, in the models directory, and the versions that training jobs and
/// `foreframe publish` added, in the data directory. Servers answer with the active version.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  foreframe models list
  foreframe models activate moving@1
  foreframe models remove moving@2")]
pub(super) struct ModelsArgs {
    #[command(subcommand)]
    action: ModelsCommand,
    #[command(flatten)]
    settings: CommonArgs,
}

#[derive(clap::Subcommand)]
enum ModelsCommand {
    /// List every version of every model, which one is active, and its directory
    #[command(
        after_help = "Examples:\n  foreframe models list --data-dir /var/lib/foreframe\n  foreframe models list --json"
    )]
    List {
        /// Print JSON instead of text
        #[arg(long)]
        json: bool,
    },
    /// Make a version the active one: running servers of the same store load it within seconds
    #[command(after_help = "Example:\n  foreframe models activate moving@1")]
    Activate {
        /// The version, as NAME@VERSION
        #[arg(value_name = "NAME@VERSION")]
        version: String,
    },
    /// Delete a published version, or all published versions of a model
    #[command(after_help = "Examples:\n  foreframe models remove moving@2\n  foreframe models remove moving")]
    Remove {
        /// One version that is not active (NAME@VERSION), or all published versions of a model (NAME)
        #[arg(value_name = "NAME[@VERSION]")]
        model: String,
    },
}

pub(super) fn run(args: &ModelsArgs) -> Result<(), CliError> {
    let loaded = args.settings.load()?;
    let workspace = Workspace::new(with_checked_directories(loaded)?);
    if let (ModelsCommand::List { json }, false) = (&args.action, workspace.config.server.store().exists()) {
        // Nothing was published, and a list makes no database.
        return print_list(&workspace, shipped(&workspace)?, *json);
    }
    block_on(async {
        let versions = workspace.versions().await?;
        match &args.action {
            ModelsCommand::List { json } => list(&workspace, &versions, *json).await,
            ModelsCommand::Activate { version } => activate(&versions, version).await,
            ModelsCommand::Remove { model } => remove(&versions, model).await,
        }
    })
}

/// A version in the list.
#[derive(Serialize)]
struct ListedVersion {
    name: ModelName,
    version: u32,
    /// Whether servers answer with it.
    active: bool,
    /// Whether it came with the program.
    shipped: bool,
    directory: PathBuf,
}

async fn list(workspace: &Workspace, versions: &Versions, is_json: bool) -> Result<(), CliError> {
    let server = &workspace.config.server;
    let mut listed = Vec::new();
    for (name, numbers) in versions.all().await? {
        let active = versions.active(&name).await?;
        for version in numbers {
            let shipped = versions.shipped(&name) == Some(version);
            let directory = if shipped {
                server.models_dir.join(&name)
            } else {
                server.data_dir.join("models").join(&name).join(version.to_string())
            };
            listed.push(ListedVersion {
                name: name.clone(),
                version,
                active: active == Some(version),
                shipped,
                directory,
            });
        }
    }
    print_list(workspace, listed, is_json)
}

/// The versions that came with the program.
fn shipped(workspace: &Workspace) -> Result<Vec<ListedVersion>, CliError> {
    let models_dir = &workspace.config.server.models_dir;
    let mut listed = Vec::new();
    for (name, _) in registry::list(models_dir)? {
        let manifest = registry::find(models_dir, &name).and_then(|dir| registry::manifest::read(&dir));
        // A manifest that cannot be read is no version, as for a server.
        listed.extend(manifest.ok().map(|manifest| ListedVersion {
            directory: models_dir.join(&name),
            name,
            version: manifest.version,
            active: true,
            shipped: true,
        }));
    }
    Ok(listed)
}

fn print_list(workspace: &Workspace, listed: Vec<ListedVersion>, is_json: bool) -> Result<(), CliError> {
    let server = &workspace.config.server;
    if is_json {
        return print_line(serde_json::to_string_pretty(&listed).map_err(CliError::failed)?);
    }
    if listed.is_empty() {
        print_line(format!(
            "there is no model in {} and none was published; `foreframe publish DIR` adds one",
            server.models_dir.display()
        ))?;
    }
    for model in listed {
        let label = format!("{}@{}", model.name, model.version);
        let state = if model.active { "active" } else { "" };
        print_line(format!("{label:24} {state:6} {}", model.directory.display()))?;
    }
    for (path, error) in registry::misnamed(&server.models_dir)? {
        print_line(format!("not used: {}: {error}", path.display()))?;
    }
    Ok(())
}

async fn activate(versions: &Versions, model: &str) -> Result<(), CliError> {
    let (name, Some(version)) = split_version(model)? else {
        return Err(CliError::Usage(format!(
            "{model:?} names no version; write NAME@VERSION, as in {model}@1; `foreframe models list` lists them"
        )));
    };
    versions.choose(&name, version).await?;
    print_line(format!("{name}@{version} is the active version"))
}

async fn remove(versions: &Versions, model: &str) -> Result<(), CliError> {
    let (name, version) = split_version(model)?;
    let removed = versions.remove(&name, version).await?;
    for version in &removed {
        print_line(format!("removed {name}@{version}"))?;
    }
    if version.is_some() {
        return Ok(());
    }
    match versions.active(&name).await? {
        Some(shipped) => print_line(format!("{name}@{shipped} is the active version")),
        None => print_line(format!(
            "no version of {name} is left; a running server answers with it until it is restarted"
        )),
    }
}
