//! `foreframe predict`

mod trust;

use std::path::PathBuf;

use self::trust::print_trust;
use super::error::CliError;
use super::output::OutputDirectory;
use super::process::print_line;
use super::recorded::{ActionsFile, ImagePaths, SeenFrames};
use super::settings::CommonArgs;
use super::workspace::Workspace;
use foreframe_core::error_text;
use foreframe_core::frame::{Frame, FrameError, codec};
use foreframe_core::nn::ModelSpec;
use foreframe_core::serving::{self, PredictionInput};
use foreframe_core::types::ModelName;
use foreframe_train::evaluation::figures::{animation, montage};

/// Predict the frames that follow the images in a directory.
///
/// Takes the last frames of the directory, as many as the model needs, and predicts what follows. File names are sorted in
/// natural order: 2.png comes before 10.png. With --at N it predicts what follows frame N instead, and shows the true frames
/// after N beside the prediction, and the actual errors. Writes predicted-1.png and so on, contact-sheet.png and prediction.gif.
#[derive(clap::Args)]
#[command(
    after_help = "The actions file is JSON. Entry i belongs to image i; there may be more actions than images:
  {\"states\": [[…], …], \"actions\": [[…], …]}
The action of a frame acts from that frame to the next one. To predict 5 frames after frame N
(the last frame, or that of --at), the file needs actions up to N + 4. So without --at, add the
planned actions at the end. The model takes the state at frame N.

Examples:
  foreframe predict --model paper --frames images --out predicted
  foreframe predict --model static --frames photos --resize crop --out predicted

  foreframe export --dataset moving-observer --episode 3 --out look
  foreframe predict --model moving --frames look --actions look/actions.json --at 9 --out seen"
)]
pub(super) struct PredictArgs {
    /// The directory of a model, its name, or NAME@VERSION
    #[arg(long)]
    model: String,
    #[command(flatten)]
    seen: SeenFrames,
    /// The robot's states and actions; needed by models that take them
    #[arg(long, value_name = "FILE")]
    actions: Option<PathBuf>,
    /// How many frames to predict; more than the model's horizon are beyond what it was trained for [default: the horizon]
    #[arg(long, value_name = "N")]
    steps: Option<usize>,
    /// A new directory for the files
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    #[command(flatten)]
    settings: CommonArgs,
}

/// What the model sees, and what followed where that is known.
struct Selected {
    /// The number of the last frame that the model sees.
    last: usize,
    seen: Vec<Frame>,
    truth: Vec<Frame>,
}

pub(super) fn run(args: &PredictArgs) -> Result<(), CliError> {
    let workspace = Workspace::new(args.settings.start()?);
    let (_, loaded) = workspace.load_model(&args.model)?;
    let spec = loaded.spec();
    let most = workspace.config.server.max_steps.max(spec.horizon);
    let steps = args.steps.unwrap_or(spec.horizon);
    if !(1..=most).contains(&steps) {
        return Err(CliError::Usage(format!(
            "--steps is {steps}; it must be 1 to {most} (setting max_steps)"
        )));
    }
    let asked = ModelSpec {
        horizon: steps,
        ..spec.clone()
    };
    let name = &loaded.manifest.name;
    let selected = select(args, name, &asked)?;
    let input = input(args, name, &asked, &selected)?;
    let rollout = serving::predict(&loaded, &[&input])?.remove(0);
    let output = OutputDirectory::create(&args.out)?;
    write(&output, spec, &selected, &rollout.frames)?;
    output.finish()?;
    for warning in input.warnings(&loaded.manifest).map_err(CliError::failed)? {
        print_line(format!("warning: {warning}"))?;
    }
    print_trust(&rollout, &selected.truth, spec.horizon)?;
    print_line(format!(
        "{}: {steps} frames predicted after frame {}, contact-sheet.png, prediction.gif",
        args.out.display(),
        selected.last
    ))
}

/// Reads the frames up to the last that the model sees, and the true frames after it. `spec` has the frames to predict as its
/// horizon.
fn select(args: &PredictArgs, name: &ModelName, spec: &ModelSpec) -> Result<Selected, CliError> {
    let mut images = ImagePaths::list(&args.seen)?;
    let count = images.count();
    let last = images.last_of_context(name, spec)?;
    let end = count.min(last + 1 + spec.horizon);
    Ok(Selected {
        last,
        seen: images.read(last + 1 - spec.context..last + 1, name, spec)?,
        truth: images.read(last + 1..end, name, spec)?,
    })
}

/// `spec` has the frames to predict as its horizon.
fn input(
    args: &PredictArgs,
    name: &ModelName,
    spec: &ModelSpec,
    selected: &Selected,
) -> Result<PredictionInput, CliError> {
    let mut input = PredictionInput {
        frames: selected.seen.clone(),
        steps: Some(spec.horizon),
        ..PredictionInput::default()
    };
    if let Some(path) = &args.actions {
        let file = ActionsFile::read(path)?;
        file.check(path, selected.last, spec)?;
        file.fill_in(&mut input, selected.last, spec);
    } else if spec.action_inputs().is_some() && !spec.sees_speeds() {
        return Err(CliError::Usage(format!(
            "--actions is missing; model {name:?} takes {}",
            error_text::comma_separated(&spec.actions)
        )));
    }
    Ok(input)
}

fn write(output: &OutputDirectory, spec: &ModelSpec, selected: &Selected, predicted: &[Frame]) -> Result<(), CliError> {
    let png = |frame: &Frame| codec::encode_png(frame).map_err(CliError::failed);
    for (index, frame) in predicted.iter().enumerate() {
        output.write(&format!("predicted-{}.png", index + 1), &png(frame)?)?;
    }
    output.write("contact-sheet.png", &png(&contact_sheet(selected, predicted)?)?)?;
    let film: Vec<Frame> = selected.seen.iter().chain(predicted).cloned().collect();
    output.write(
        "prediction.gif",
        &animation::enlarged_gif(&film, spec.frame_period_s).map_err(CliError::failed)?,
    )
}

/// The frames next to the last one seen, as many on each side as fit into an image.
fn contact_sheet(selected: &Selected, predicted: &[Frame]) -> Result<Frame, CliError> {
    let mut count = selected.seen.len().max(predicted.len());
    loop {
        let seen = &selected.seen[selected.seen.len().saturating_sub(count)..];
        let sheet = montage::prediction_sheet(seen, first(predicted, count), first(&selected.truth, count));
        match sheet {
            Err(FrameError::Size { .. }) if count > 1 => count /= 2,
            other => return other.map_err(CliError::failed),
        }
    }
}

fn first(frames: &[Frame], count: usize) -> &[Frame] {
    frames.get(..count).unwrap_or(frames)
}
