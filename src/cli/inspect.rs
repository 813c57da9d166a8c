//! `foreframe inspect`

mod data_set;
mod model;

use std::path::{Path, PathBuf};

use super::error::CliError;
use super::settings::CommonArgs;
use super::workspace::Workspace;
use foreframe_core::error_text::existing;
use foreframe_core::registry;
use foreframe_data::dataset;

/// Describe a model or a data set.
///
/// Of a data set, it shows what to look at before training: rates and gaps, ranges of all channels, the delay from actions to the
/// image's motion, repeated frames, exposure jumps, and warnings with advice.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  foreframe inspect paper
  foreframe inspect mycar --html mycar.html
  foreframe inspect runs/paper/model
  foreframe inspect static-observer --data-dir /var/lib/foreframe")]
pub(super) struct InspectArgs {
    /// The name or directory of a model (or NAME@VERSION), or the name or directory of a data set
    #[arg(value_name = "WHAT")]
    what: String,
    /// Print JSON instead of text
    #[arg(long)]
    json: bool,
    /// Write a page with pictures and charts of the data set to this file, too
    #[arg(long, value_name = "FILE")]
    html: Option<PathBuf>,
    #[command(flatten)]
    settings: CommonArgs,
}

pub(super) fn run(args: &InspectArgs) -> Result<(), CliError> {
    let workspace = Workspace::new(args.settings.start()?);
    let (name, path) = (args.what.as_str(), Path::new(&args.what));
    let models = workspace.model_names()?;
    let is_model = registry::directory_of(name).is_ok_and(|dir| dir.is_some());
    if is_model
        || models
            .iter()
            .any(|model| name.split('@').next() == Some(model.as_str()))
    {
        let (dir, loaded) = workspace.load_model(name)?;
        return match &args.html {
            Some(_) => Err(CliError::Usage(format!(
                "{name:?} is a model; --html draws data sets only"
            ))),
            None => model::describe(&dir, &loaded.manifest, args.json),
        };
    }
    let config = &workspace.config;
    let models_dir = &config.server.models_dir;
    let misnamed = models_dir.join(name);
    if misnamed.join(registry::MANIFEST_FILE).is_file() {
        return workspace.load_model(name).map(drop);
    }
    if let Ok(dir) = workspace.find_dataset(path) {
        return data_set::describe(&dir, &workspace.read_dataset(&dir)?, args.html.as_deref(), args.json);
    }
    let datasets_dir = workspace.datasets_dir();
    Err(CliError::Usage(format!(
        "there is no model or data set {name:?}; in {} there {}; in {} there {}",
        models_dir.display(),
        existing(&models),
        datasets_dir.display(),
        existing(&dataset::list(&datasets_dir)?)
    )))
}
