//! `foreframe inspect`

use std::path::{Path, PathBuf};

use super::{CliError, load_model, say};
use crate::dataset::Dataset;
use crate::nn::ModelSpec;
use crate::registry::Manifest;
use crate::types::Channel;

/// Describe a model or a data set.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  foreframe inspect paper
  foreframe inspect data/static-observer")]
pub(super) struct Args {
    /// A model's name or directory, or a data set's directory
    what: String,
    /// Where models are looked for by name
    #[arg(long, value_name = "DIR", default_value = "models")]
    models: PathBuf,
}

pub(super) fn run(args: &Args) -> Result<(), CliError> {
    let dir = Path::new(&args.what);
    if dir.join("meta").is_dir() {
        return describe_dataset(dir);
    }
    let (dir, loaded) = load_model(&args.what, &args.models)?;
    describe_model(&dir, &loaded.manifest)
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
    say(format!("  parameters  {}", manifest.parameters))?;
    say(format!(
        "  cost        {} multiply–adds a predicted frame",
        manifest.multiply_adds_per_frame
    ))?;
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

fn conditions(spec: &ModelSpec) -> String {
    let list = |what: &str, channels: &[crate::nn::ChannelScale]| {
        let names: Vec<String> = channels.iter().map(|c| label(&c.name, &c.unit)).collect();
        format!("; {what} [{}]", names.join(", "))
    };
    let mut text = String::new();
    if spec.state_inputs().is_some() {
        text += &list("the state", &spec.states);
    }
    if spec.action_inputs().is_some() {
        text += &list("future actions", &spec.actions);
    }
    text
}

fn label(name: &str, unit: &str) -> String {
    if unit.is_empty() {
        name.to_owned()
    } else {
        format!("{name} {unit}")
    }
}

fn describe_dataset(dir: &Path) -> Result<(), CliError> {
    let dataset = Dataset::open(dir).map_err(CliError::failed)?;
    let info = dataset.info();
    let list = |channels: &[Channel]| {
        channels
            .iter()
            .map(|c| label(&c.name, &c.unit))
            .collect::<Vec<_>>()
            .join(", ")
    };
    say(format!("{} ({})", dir.display(), info.name))?;
    say(format!(
        "  frames      {} of {}×{} px, {} s apart",
        info.frame_count, info.frame_width_px, info.frame_height_px, info.frame_period_s
    ))?;
    say(format!("  episodes    {}", info.episode_count))?;
    say(format!("  action      [{}]", list(&info.action_channels)))?;
    say(format!("  state       [{}]", list(&info.state_channels)))?;
    say(format!("  masks       {}", if info.has_masks { "yes" } else { "no" }))?;
    say(format!(
        "  scenario    {}",
        info.scenario.as_deref().unwrap_or("none: recorded")
    ))?;
    say(format!("  content     SHA-256 {}", info.content_hash))
}
