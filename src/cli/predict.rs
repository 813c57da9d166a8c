//! `foreframe predict`

use std::path::{Path, PathBuf};

use serde::Deserialize;

use super::{CliError, load_model, say};
use crate::evaluation::figures::montage;
use crate::files::write_atomically;
use crate::frame::{Frame, codec};
use crate::nn::ModelSpec;
use crate::registry::LoadedModel;
use crate::serving::{self, PredictionInput};
use crate::types::{Action, RobotState};

/// Predict the frames that follow those in a directory.
///
/// Takes the first frames of the directory, in the order of their names, as many as the model's context; if there are more,
/// they are the truth that the prediction is shown over. Writes predicted-1.png and so on, contact-sheet.png and
/// prediction.gif.
#[derive(clap::Args)]
#[command(
    after_help = "The actions file is JSON, one entry a frame from the directory's first on:
  {\"states\": [[…], …], \"actions\": [[…], …]}
The action of a frame acts from it to the next. A model that is told the state takes that of the last frame it sees.

Example: foreframe export --dataset data/moving-observer --episode 3 --out look
         foreframe predict --model moving --frames look --actions look/actions.json --out seen"
)]
pub(super) struct Args {
    /// A model's name or directory
    #[arg(long)]
    model: String,
    /// A directory of PNG or JPEG frames
    #[arg(long, value_name = "DIR")]
    frames: PathBuf,
    /// What the robot did and will do; needed by models that are told actions
    #[arg(long, value_name = "FILE")]
    actions: Option<PathBuf>,
    /// The directory to write into
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Where models are looked for by name
    #[arg(long, value_name = "DIR", default_value = "models")]
    models: PathBuf,
}

/// The actions file.
#[derive(Default, Deserialize)]
#[serde(deny_unknown_fields)]
struct Trace {
    #[serde(default)]
    states: Vec<RobotState>,
    actions: Vec<Action>,
}

pub(super) fn run(args: &Args) -> Result<(), CliError> {
    let (_, loaded) = load_model(&args.model, &args.models)?;
    let spec = loaded.model.spec();
    let frames = read_frames(&args.frames)?;
    if frames.len() < spec.context {
        return Err(CliError::Failed(format!(
            "{} holds {} frames; model {:?} takes {}",
            args.frames.display(),
            frames.len(),
            loaded.manifest.name,
            spec.context
        )));
    }
    let (seen, truth) = frames.split_at(spec.context);
    let input = input(spec, seen, args.actions.as_deref())?;
    let predicted = serving::predict(&loaded, &[&input])
        .map_err(CliError::failed)?
        .remove(0);
    write(&args.out, &loaded, seen, &predicted, truth)?;
    say(format!(
        "{}: {} predicted frames, contact-sheet.png, prediction.gif",
        args.out.display(),
        predicted.len()
    ))
}

fn input(spec: &ModelSpec, seen: &[Frame], actions: Option<&Path>) -> Result<PredictionInput, CliError> {
    let trace = actions.map(read_trace).transpose()?.unwrap_or_default();
    let last = spec.context - 1;
    let future: Vec<Action> = trace.actions.iter().skip(last).take(spec.horizon).cloned().collect();
    Ok(PredictionInput {
        frames: seen.to_vec(),
        actions: trace.actions.iter().take(spec.context).cloned().collect(),
        state: trace.states.get(last).cloned(),
        future_actions: (spec.action_inputs().is_some() && actions.is_some()).then_some(future),
    })
}

fn read_trace(path: &Path) -> Result<Trace, CliError> {
    let bytes = std::fs::read(path).map_err(|error| CliError::io("read", path, &error))?;
    serde_json::from_slice(&bytes).map_err(|error| {
        CliError::Failed(format!(
            "{} is no actions file ({error}); see foreframe predict --help",
            path.display()
        ))
    })
}

/// The images of a directory, in the order of their names.
fn read_frames(dir: &Path) -> Result<Vec<Frame>, CliError> {
    let unreadable = |error| CliError::io("read", dir, &error);
    let mut paths = std::fs::read_dir(dir)
        .map_err(unreadable)?
        .map(|entry| entry.map(|entry| entry.path()))
        .collect::<Result<Vec<_>, _>>()
        .map_err(unreadable)?;
    paths.retain(|path| {
        let extension = path.extension().unwrap_or_default().to_ascii_lowercase();
        ["png", "jpg", "jpeg"].iter().any(|known| extension == *known)
    });
    paths.sort();
    paths
        .iter()
        .map(|path| {
            let bytes = std::fs::read(path).map_err(|error| CliError::io("read", path, &error))?;
            codec::decode(&bytes).map_err(|error| CliError::Failed(format!("{}: {error}", path.display())))
        })
        .collect()
}

fn write(
    out: &Path,
    loaded: &LoadedModel,
    seen: &[Frame],
    predicted: &[Frame],
    truth: &[Frame],
) -> Result<(), CliError> {
    std::fs::create_dir_all(out).map_err(|error| CliError::io("make", out, &error))?;
    let save = |name: String, bytes: &[u8]| {
        let path = out.join(name);
        write_atomically(&path, bytes).map_err(|error| CliError::io("write", &path, &error))
    };
    for (index, frame) in predicted.iter().enumerate() {
        save(
            format!("predicted-{}.png", index + 1),
            &codec::encode_png(frame).map_err(CliError::failed)?,
        )?;
    }
    let sheet = montage::prediction_sheet(seen, predicted, truth).map_err(CliError::failed)?;
    save(
        "contact-sheet.png".to_owned(),
        &codec::encode_png(&sheet).map_err(CliError::failed)?,
    )?;
    let delay_ms = (loaded.model.spec().frame_period_s * 1000.0).round() as u32;
    let film: Vec<Frame> = seen.iter().chain(predicted).cloned().collect();
    save(
        "prediction.gif".to_owned(),
        &codec::encode_gif(&film, delay_ms).map_err(CliError::failed)?,
    )
}
