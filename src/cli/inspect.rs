//! `foreframe inspect`

use std::path::{Path, PathBuf};

use super::{CliError, DATASETS_DIR, say};
use crate::dataset::{self, Dataset, DatasetInfo};
use crate::nn::{ChannelScale, ModelSpec, costs};
use crate::registry::{self, Manifest};
use crate::wording::{listed, those};

/// Describe a model or a data set.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  foreframe inspect paper
  foreframe inspect static-observer")]
pub(super) struct InspectArgs {
    /// A model's name or directory, or a data set's name or directory
    what: String,
    /// Where models are looked for by name
    #[arg(long, value_name = "DIR", default_value = "models")]
    models: PathBuf,
}

pub(super) fn run(args: &InspectArgs) -> Result<(), CliError> {
    let (models, datasets) = (args.models.as_path(), Path::new(DATASETS_DIR));
    if let Ok(dir) = registry::locate(models, &args.what) {
        return describe_model(&dir, &registry::load(&dir)?.manifest);
    }
    if let Ok(dir) = dataset::find(datasets, Path::new(&args.what)) {
        return describe_dataset(&dir);
    }
    let names: Vec<String> = registry::list(models)?.into_iter().map(|(name, _)| name).collect();
    Err(CliError::Usage(format!(
        "there is no model or data set {:?}; in {} there {}; in {DATASETS_DIR} there {}",
        args.what,
        models.display(),
        those(&names),
        those(&dataset::list(datasets)?)
    )))
}

fn describe_model(dir: &Path, manifest: &Manifest) -> Result<(), CliError> {
    let spec = &manifest.spec;
    say(format!(
        "{} ({} version {})",
        dir.display(),
        manifest.name,
        manifest.version
    ))?;
    say(format!(
        "  takes       {} frames of {}×{} px, gray, {} s apart{}",
        spec.context,
        spec.frame_width_px,
        spec.frame_height_px,
        spec.frame_period_s,
        conditions(spec)
    ))?;
    say(format!("  predicts    the {} frames that follow", spec.horizon))?;
    say(format!(
        "  network     dense {} → LSTM {} → dense {}; conditioning {}, reconstruction {}, {}",
        spec.features,
        spec.hidden,
        spec.features,
        spec.conditioning,
        spec.reconstruction,
        if spec.preprocess.invert {
            "inverted"
        } else {
            "not inverted"
        },
    ))?;
    say_costs(manifest)?;
    say(format!(
        "  trained on  {} windows of {} (content {})",
        manifest.dataset.windows, manifest.dataset.name, manifest.dataset.content_hash
    ))?;
    say(format!("  seed        {}", manifest.seed.0))?;
    say(format!("  made by     {}", manifest.command))?;
    say(format!("  weights     SHA-256 {}", manifest.weights_sha256))?;
    let metrics = serde_json::to_string_pretty(&manifest.metrics).map_err(CliError::failed)?;
    say(format!("  metrics     {}", metrics.replace('\n', "\n              ")))
}

/// The model's cost and, for the same frames, that of the networks which the paper sets itself against.
fn say_costs(manifest: &Manifest) -> Result<(), CliError> {
    let own = manifest.multiply_adds_per_frame;
    say(format!("  parameters  {}", manifest.parameters))?;
    say(format!(
        "  cost        {own} multiply–adds a predicted frame; on the same frames"
    ))?;
    for (name, cost) in [
        ("ConvLSTM (Shi et al. 2015)", costs::conv_lstm(&manifest.spec)),
        ("CDNA (Finn et al. 2016)", costs::cdna(&manifest.spec)),
    ] {
        say(format!(
            "              {name} takes {:.0} million, {:.0} times as many, with {:.2} million parameters",
            cost.multiply_adds_per_frame as f64 / 1e6,
            cost.multiply_adds_per_frame as f64 / own as f64,
            cost.parameters as f64 / 1e6
        ))?;
    }
    Ok(())
}

fn conditions(spec: &ModelSpec) -> String {
    let list = |what: &str, channels: &[ChannelScale]| format!("; {what} [{}]", listed(channels));
    let mut text = String::new();
    if spec.state_inputs().is_some() {
        text += &list("the state", &spec.states);
    }
    if spec.action_inputs().is_some() {
        text += &list("future actions", &spec.actions);
    }
    text
}

fn describe_dataset(dir: &Path) -> Result<(), CliError> {
    let dataset = Dataset::open(dir)?;
    let info = dataset.info();
    say(format!("{} ({})", dir.display(), info.name))?;
    say(format!(
        "  frames      {} of {}×{} px, {} s apart",
        info.frame_count, info.frame_width_px, info.frame_height_px, info.frame_period_s
    ))?;
    say(format!("  episodes    {}", info.episode_count))?;
    say(format!("  action      [{}]", listed(&info.action_channels)))?;
    say(format!("  state       [{}]", listed(&info.state_channels)))?;
    say(format!("  masks       {}", if info.has_masks { "yes" } else { "no" }))?;
    say(format!("  camera      {}", camera(info)))?;
    say(format!(
        "  scenario    {}",
        info.scenario.as_deref().unwrap_or("none: recorded")
    ))?;
    say(format!("  content     SHA-256 {}", info.content_hash))
}

fn camera(info: &DatasetInfo) -> String {
    info.camera.map_or_else(
        || "not described".to_owned(),
        |camera| {
            format!(
                "pinhole, {:.1}° wide, tilted down {:.1}°",
                camera.horizontal_fov_rad.to_degrees(),
                camera.tilt_down_rad.to_degrees()
            )
        },
    )
}
