//! `foreframe inspect`

use std::path::Path;

use super::settings::CommonArgs;
use super::workspace::Workspace;
use super::{CliError, print_line};
use crate::dataset::{self, Dataset, DatasetInfo};
use crate::error_text::{comma_separated, existing};
use crate::nn::{Architecture, ChannelScale, ModelSpec, costs};
use crate::registry::{self, Manifest};

/// Describe a model or a data set.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  foreframe inspect paper
  foreframe inspect runs/paper/model
  foreframe inspect static-observer --data-dir /var/lib/foreframe")]
pub(super) struct InspectArgs {
    /// The name or directory of a model (or NAME@VERSION), or the name or directory of a data set
    #[arg(value_name = "WHAT")]
    what: String,
    #[command(flatten)]
    settings: CommonArgs,
}

pub(super) fn run(args: &InspectArgs) -> Result<(), CliError> {
    let workspace = Workspace::new(args.settings.start()?);
    let (name, path) = (args.what.as_str(), Path::new(&args.what));
    let models = workspace.model_names()?;
    let is_model = registry::directory_of(name).is_ok_and(|dir| dir.is_some());
    if is_model || models.iter().any(|model| name.split('@').next() == Some(model)) {
        let (dir, loaded) = workspace.load_model(name)?;
        return describe_model(&dir, &loaded.manifest);
    }
    let config = workspace.config();
    let models_dir = &config.server.models_dir;
    let misnamed = models_dir.join(name);
    if misnamed.join(registry::MANIFEST_FILE).is_file() {
        return workspace.load_model(name).map(drop);
    }
    if let Ok(dir) = workspace.find_dataset(path) {
        return describe_dataset(&dir);
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

fn describe_model(dir: &Path, manifest: &Manifest) -> Result<(), CliError> {
    let spec = &manifest.spec;
    print_line(format!(
        "{} ({} version {})",
        dir.display(),
        manifest.name,
        manifest.version
    ))?;
    print_line(format!(
        "  takes       {} frames of {}×{} px, gray, {} s apart{}",
        spec.context,
        spec.frame_width_px,
        spec.frame_height_px,
        spec.frame_period_s,
        conditions(spec)
    ))?;
    print_line(format!("  predicts    the {} frames that follow", spec.horizon))?;
    print_line(format!("  network     {}", network(spec)))?;
    print_costs(manifest)?;
    print_line(format!(
        "  trained on  {} windows of {} (content {})",
        manifest.dataset.windows, manifest.dataset.name, manifest.dataset.content_hash
    ))?;
    print_line(format!("  seed        {}", manifest.seed.0))?;
    print_line(format!("  made by     {}", manifest.command))?;
    print_line(format!("  weights     SHA-256 {}", manifest.weights_sha256))?;
    let metrics = serde_json::to_string_pretty(&manifest.metrics).map_err(CliError::failed)?;
    print_line(format!("  metrics     {}", metrics.replace('\n', "\n              ")))
}

/// The architecture and its sizes.
fn network(spec: &ModelSpec) -> String {
    let inverted = if spec.preprocess.invert {
        "inverted"
    } else {
        "not inverted"
    };
    let conditioning = spec.conditioning;
    match spec.architecture {
        Architecture::Dense => format!(
            "dense {} → LSTM {} → dense {}; conditioning {conditioning}, reconstruction {}, {inverted}",
            spec.features, spec.hidden, spec.features, spec.reconstruction
        ),
        Architecture::Flow => {
            let layers = spec.flow_layers();
            let camera = if spec.camera.is_some() { "known" } else { "unknown" };
            format!(
                "flow: {} channels, {} encoder and {} decoder blocks; conditioning {conditioning}, camera {camera}, {inverted}",
                layers.channels, layers.encoder_blocks, layers.decoder_blocks
            )
        }
    }
}

/// The model's cost and, for the same frames, that of the networks that the paper compares itself with.
fn print_costs(manifest: &Manifest) -> Result<(), CliError> {
    let own = manifest.multiply_adds_per_frame;
    print_line(format!("  parameters  {}", manifest.parameters))?;
    print_line(format!(
        "  cost        {own} multiply–adds for each predicted frame; on the same frames:"
    ))?;
    for (name, cost) in [
        ("ConvLSTM (Shi et al. 2015)", costs::conv_lstm(&manifest.spec)),
        ("CDNA (Finn et al. 2016)", costs::cdna(&manifest.spec)),
    ] {
        print_line(format!(
            "              {name} needs {:.0} million, {:.0} times as many, and has {:.2} million parameters",
            cost.multiply_adds_per_frame as f64 / 1e6,
            cost.multiply_adds_per_frame as f64 / own as f64,
            cost.parameters as f64 / 1e6
        ))?;
    }
    Ok(())
}

fn conditions(spec: &ModelSpec) -> String {
    let list = |what: &str, channels: &[ChannelScale]| format!("; {what} [{}]", comma_separated(channels));
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
    print_line(format!("{} ({})", dir.display(), info.name))?;
    print_line(format!(
        "  frames      {} of {}×{} px, {} s apart",
        info.frame_count, info.frame_width_px, info.frame_height_px, info.frame_period_s
    ))?;
    print_line(format!("  episodes    {}", info.episode_count))?;
    print_line(format!("  action      [{}]", comma_separated(&info.action_channels)))?;
    print_line(format!("  state       [{}]", comma_separated(&info.state_channels)))?;
    print_line(format!("  masks       {}", if info.has_masks { "yes" } else { "no" }))?;
    print_line(format!("  camera      {}", camera(info)))?;
    print_line(format!(
        "  scenario    {}",
        info.scenario.as_deref().unwrap_or("none (recorded)")
    ))?;
    print_line(format!("  content     SHA-256 {}", info.content_hash))
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
