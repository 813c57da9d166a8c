//! A model, as text or JSON.

use std::path::Path;

use crate::cli::error::CliError;
use crate::cli::process::print_line;
use crate::cli::scores::print_scores;
use foreframe_core::error_text::comma_separated;
use foreframe_core::nn::{Architecture, ChannelScale, ModelSpec, costs};
use foreframe_core::registry::Manifest;

/// Prints what a model takes, predicts, costs and comes from.
pub(super) fn describe(dir: &Path, manifest: &Manifest, as_json: bool) -> Result<(), CliError> {
    if as_json {
        return print_line(serde_json::to_string_pretty(manifest).map_err(CliError::failed)?);
    }
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
    print_line("  scores")?;
    print_scores(&manifest.metrics, "    ")
}

/// The architecture and its sizes.
fn network(spec: &ModelSpec) -> String {
    let inverted = if spec.preprocess.invert {
        "inverted"
    } else {
        "not inverted"
    };
    let conditioning = spec.conditioning;
    match &spec.architecture {
        Architecture::Dense(dense) => format!(
            "dense {} → LSTM {} → dense {}; conditioning {conditioning}, reconstruction {}, {inverted}",
            dense.features, dense.hidden, dense.features, dense.reconstruction
        ),
        Architecture::Flow(flow) => {
            let layers = &flow.layers;
            let camera = if flow.camera.is_some() { "known" } else { "unknown" };
            let form = match (layers.depth, layers.recurrent) {
                (true, _) if layers.memory => "flow with depth and memory",
                (true, _) => "flow with depth",
                (false, true) => "recurrent flow",
                (false, false) => "flow",
            };
            format!(
                "{form}: {} channels, {} encoder and {} decoder blocks; conditioning {conditioning}, camera {camera}, {inverted}",
                layers.channels, layers.encoder_blocks, layers.decoder_blocks
            )
        }
        Architecture::Sprites(sizes) => format!(
            "two sprites: {} channels, {} encoder blocks; {inverted}",
            sizes.channels, sizes.encoder_blocks
        ),
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
