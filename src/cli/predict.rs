//! `foreframe predict`

use std::path::{Path, PathBuf};

use serde::Deserialize;

use super::{CliError, load_model, say};
use crate::error_text;
use crate::evaluation::{self, figures::animation, figures::montage};
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

Example: foreframe export --dataset moving-observer --episode 3 --out look
         foreframe predict --model moving --frames look --actions look/actions.json --out seen"
)]
pub(super) struct PredictArgs {
    /// A model's name or directory
    #[arg(long)]
    model: String,
    /// A directory of PNG or JPEG frames
    #[arg(long, value_name = "DIR")]
    frames: PathBuf,
    /// What the robot did and will do; needed by models that are told actions
    #[arg(long, value_name = "FILE")]
    actions: Option<PathBuf>,
    /// A new directory to write into
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Where models are looked for by name
    #[arg(long, value_name = "DIR", default_value = "models")]
    models: PathBuf,
}

/// The actions file.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct ActionsFile {
    #[serde(default)]
    states: Vec<RobotState>,
    actions: Vec<Action>,
}

pub(super) fn run(args: &PredictArgs) -> Result<(), CliError> {
    let (_, loaded) = load_model(&args.model, &args.models)?;
    let (name, spec) = (&loaded.manifest.name, loaded.model.spec());
    let frames = read_frames(&args.frames, name, spec)?;
    if frames.len() < spec.context {
        return Err(CliError::Usage(format!(
            "{} holds {} PNG or JPEG frames; model {name:?} takes {}",
            args.frames.display(),
            frames.len(),
            spec.context
        )));
    }
    let (seen, truth) = frames.split_at(spec.context);
    let mut input = PredictionInput {
        frames: seen.to_vec(),
        ..PredictionInput::default()
    };
    if let Some(path) = &args.actions {
        read_trace(path)?.enter(&mut input, path, name, spec)?;
    } else if spec.action_inputs().is_some() {
        return Err(CliError::Usage(format!(
            "--actions is missing; model {name:?} takes {}",
            error_text::comma_separated(&spec.actions)
        )));
    }
    let predicted = serving::predict(&loaded, &[&input])?.remove(0);
    evaluation::prepare(&args.out)?;
    write(&args.out, &loaded, seen, &predicted, truth)?;
    say(format!(
        "{}: {} predicted frames, contact-sheet.png, prediction.gif",
        args.out.display(),
        predicted.len()
    ))
}

impl ActionsFile {
    /// Takes what the model is told: the state of the last frame seen, and the actions from there on.
    fn enter(self, input: &mut PredictionInput, path: &Path, model: &str, spec: &ModelSpec) -> Result<(), CliError> {
        let last = spec.context - 1;
        let needed = [
            (
                "actions",
                self.actions.len(),
                spec.action_inputs().map(|_| last + spec.horizon),
            ),
            ("states", self.states.len(), spec.state_inputs().map(|_| spec.context)),
        ];
        for (what, found, needed) in needed {
            if let Some(needed) = needed.filter(|&needed| found < needed) {
                return Err(CliError::Usage(format!(
                    "{} holds {found} {what}; model {model:?} sees {} frames and predicts {}, which takes {needed}",
                    path.display(),
                    spec.context,
                    spec.horizon
                )));
            }
        }
        input.state = self.states.into_iter().nth(last);
        let future = self.actions.into_iter().skip(last).take(spec.horizon);
        input.future_actions = spec.action_inputs().map(|_| future.collect());
        Ok(())
    }
}

fn read_trace(path: &Path) -> Result<ActionsFile, CliError> {
    let bytes = std::fs::read(path).map_err(|error| CliError::io("read", path, &error))?;
    serde_json::from_slice(&bytes).map_err(|error| {
        CliError::Usage(format!(
            "{} is no actions file: {error}; it is JSON of finite numbers, \
             {{\"states\": [[…], …], \"actions\": [[…], …]}}",
            path.display()
        ))
    })
}

/// The images of a directory, in the order of their names, all of the model's size.
fn read_frames(dir: &Path, model: &str, spec: &ModelSpec) -> Result<Vec<Frame>, CliError> {
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
    paths.iter().map(|path| read_frame(path, model, spec)).collect()
}

fn read_frame(path: &Path, model: &str, spec: &ModelSpec) -> Result<Frame, CliError> {
    let bytes = std::fs::read(path).map_err(|error| CliError::io("read", path, &error))?;
    let frame = codec::decode(&bytes)
        .map_err(|error| CliError::Failed(format!("{}: {}", path.display(), error_text::with_causes(&error))))?;
    if (frame.width(), frame.height()) != (spec.frame_width_px, spec.frame_height_px) {
        return Err(CliError::Usage(format!(
            "{} is {}×{} px; model {model:?} takes {}×{}",
            path.display(),
            frame.width(),
            frame.height(),
            spec.frame_width_px,
            spec.frame_height_px
        )));
    }
    Ok(frame)
}

fn write(
    out: &Path,
    loaded: &LoadedModel,
    seen: &[Frame],
    predicted: &[Frame],
    truth: &[Frame],
) -> Result<(), CliError> {
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
        &animation::enlarged_gif(&film, delay_ms).map_err(CliError::failed)?,
    )
}
