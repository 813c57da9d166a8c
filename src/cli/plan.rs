//! `foreframe plan`

mod answer;

use std::path::PathBuf;
use std::time::Duration;

use self::answer::{json, print_choice};
use super::error::CliError;
use super::output::OutputDirectory;
use super::process::print_line;
use super::recorded::{ActionsFile, ImagePaths, SeenFrames};
use super::settings::CommonArgs;
use super::workspace::Workspace;
use foreframe_core::frame::{Frame, codec};
use foreframe_core::planning::{
    Goal, PlanChoice, PlanError, PlanSettings, PlannerInput, SolverKind, SolverSettings, plan,
};
use foreframe_core::registry::Model;
use foreframe_core::serving::{PredictionInput, Task};
use foreframe_train::evaluation::figures::fan::{PlanFan, fan_picture};
use foreframe_train::evaluation::figures::montage::{MontageRow, Style, montage};

/// Find the actions that bring the robot to a goal, by what its camera is expected to see.
///
/// Takes the last frames of a directory, or those up to --at N, as `foreframe predict` does, and searches for the plan that reaches
/// the goal best within the time. Prints the plan, its costs and whether it is safe; if no plan is, the plan is to stop.
/// With --out, writes fan.png (the ways of the best plans from above, with what stands in the way), contact-sheet.png (what the
/// camera is predicted to show under each) and plan.json.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  foreframe export --dataset moving-observer --episode 3 --out look
  foreframe plan --model rooms --frames look --actions look/actions.json --goal 0.5,0.2 --out plan
  foreframe plan --model moving-flow --frames look --actions look/actions.json --goal-image a.png")]
pub(super) struct PlanArgs {
    /// The directory of a model, its name, or NAME@VERSION
    #[arg(long)]
    model: String,
    #[command(flatten)]
    seen: SeenFrames,
    /// The robot's states and actions, as for `foreframe predict`; the actions from that frame on are the present plan
    #[arg(long, value_name = "FILE")]
    actions: Option<PathBuf>,
    /// Where the robot should get: metres ahead and to the left, as in 0.5,-0.2
    #[arg(long, value_name = "AHEAD,LEFT", allow_hyphen_values = true, value_parser = place)]
    goal: Option<[f32; 2]>,
    /// Where the robot should look in the end: radians, counter-clockwise from where it looks now
    #[arg(long, value_name = "RADIANS", allow_hyphen_values = true)]
    heading: Option<f32>,
    /// An image of what its camera should show in the end
    #[arg(long, value_name = "FILE")]
    goal_image: Option<PathBuf>,
    /// How plans are chosen: random-shooting, cem or mppi
    #[arg(long, default_value_t = SolverSettings::default().kind)]
    solver: SolverKind,
    /// Plans of an iteration
    #[arg(long, default_value_t = SolverSettings::default().samples)]
    samples: usize,
    /// How often the solver learns from the costs and draws again
    #[arg(long, default_value_t = SolverSettings::default().iterations)]
    iterations: usize,
    /// The same seed draws the same plans
    #[arg(long, default_value_t = SolverSettings::default().seed)]
    seed: u64,
    /// The time for the search, in milliseconds; without it, the search is whole, and the answer is always the same
    #[arg(long, value_name = "MS")]
    budget_ms: Option<u64>,
    /// How many of the best plans are predicted and compared at the end
    #[arg(long, default_value_t = PlanSettings::default().finalists)]
    finalists: usize,
    /// Actions of a plan [default: the model's horizon]
    #[arg(long, value_name = "N")]
    steps: Option<usize>,
    /// Radius of the robot, in metres
    #[arg(long, value_name = "M", default_value_t = PlanSettings::default().radius_m)]
    radius: f32,
    /// The distance that the robot should keep, in metres
    #[arg(long, value_name = "M", default_value_t = PlanSettings::default().margin_m)]
    margin: f32,
    /// Print the answer as JSON
    #[arg(long)]
    json: bool,
    /// A new directory for the files
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    #[command(flatten)]
    settings: CommonArgs,
}

/// The context, and what the search starts from.
struct Asked {
    seen: Vec<Frame>,
    context: Task,
    input: PlannerInput,
}

pub(super) fn run(args: &PlanArgs) -> Result<(), CliError> {
    let workspace = Workspace::new(args.settings.start()?);
    let (_, model) = workspace.load_model(&args.model)?;
    let output = args.out.as_deref().map(OutputDirectory::create).transpose()?;
    let Asked { seen, context, input } = asked(args, &model)?;
    let goal = input.goal.clone();
    let choice = plan(&model, &context, input)?;
    let answer = json(&model.manifest, &choice);
    if let Some(output) = output {
        let png = |frame: &Frame| codec::encode_png(frame).map_err(CliError::failed);
        let fan = fan_picture(&fan(args, &goal, &choice)).map_err(CliError::failed)?;
        output.write("fan.png", &png(&fan)?)?;
        output.write("contact-sheet.png", &png(&sheet(&seen, &choice)?)?)?;
        output.write("plan.json", format!("{answer:#}\n").as_bytes())?;
        output.finish()?;
    }
    if args.json {
        return print_line(answer);
    }
    print_choice(&model.manifest, &choice)?;
    match &args.out {
        Some(out) => print_line(format!("{}: fan.png, contact-sheet.png, plan.json", out.display())),
        None => Ok(()),
    }
}

fn asked(args: &PlanArgs, model: &Model) -> Result<Asked, CliError> {
    let (manifest, spec) = (&model.manifest, model.spec());
    if spec.action_inputs().is_none() {
        let model = manifest.name.clone();
        return Err(PlanError::NoActions { model }.into());
    }
    let mut images = ImagePaths::list(&args.seen)?;
    let last = images.last_of_context(&manifest.name, spec)?;
    let seen = images.read(last + 1 - spec.context..last + 1, &manifest.name, spec)?;
    let goal_image = args
        .goal_image
        .as_ref()
        .map(|path| images.read_one(path, &manifest.name, spec));
    let mut known = PredictionInput::default();
    if let Some(path) = &args.actions {
        let file = ActionsFile::read(path)?;
        file.check_states(path, last, spec)?;
        file.fill_in(&mut known, last, spec);
    }
    let task = Task::rollout(seen.clone(), known.past_states, None, Vec::new(), manifest).map_err(PlanError::from)?;
    Ok(Asked {
        seen,
        context: task,
        input: PlannerInput {
            goal: Goal {
                position_m: args.goal,
                heading_rad: args.heading,
                image: goal_image.transpose()?,
            },
            settings: PlanSettings {
                solver: SolverSettings {
                    kind: args.solver,
                    samples: args.samples,
                    iterations: args.iterations,
                    seed: args.seed,
                    ..SolverSettings::default()
                },
                steps: args.steps,
                budget: args.budget_ms.map(Duration::from_millis),
                finalists: args.finalists,
                radius_m: args.radius,
                margin_m: args.margin,
                ..PlanSettings::default()
            },
            state: known.state,
            camera: None,
            present: known.plan.unwrap_or_default(),
            before: None,
        },
    })
}

fn fan(args: &PlanArgs, goal: &Goal, choice: &PlanChoice) -> PlanFan {
    let all = std::iter::once(&choice.best).chain(&choice.runners_up);
    let ways = all.filter_map(|candidate| candidate.motion.as_ref());
    PlanFan {
        ways_m: ways
            .map(|way| way.iter().map(|[_, ahead, left]| [*ahead, *left]).collect())
            .collect(),
        obstacles_m: choice.obstacles.fixed_m().to_vec(),
        movers_m: choice.obstacles.movers_m().to_vec(),
        goal_m: goal.position_m,
        radius_m: args.radius,
    }
}

/// The context, and a row of predicted frames for each plan.
fn sheet(seen: &[Frame], choice: &PlanChoice) -> Result<Frame, CliError> {
    let all = std::iter::once(&choice.best).chain(&choice.runners_up);
    let plans = all.enumerate().filter_map(|(index, candidate)| {
        let label = match index {
            0 => "best plan".to_owned(),
            _ => format!("plan {index}"),
        };
        Some(MontageRow::in_time(&label, &candidate.rollout.as_ref()?.frames, 1))
    });
    let inputs = MontageRow::in_time("inputs", seen, 1 - seen.len() as i64);
    let rows: Vec<MontageRow> = std::iter::once(inputs).chain(plans).collect();
    let style = Style::for_frames_of(seen.first().map_or(64, Frame::width));
    let small = Style {
        scale: 1,
        grid_lines: 0,
    };
    montage("", &rows, &style)
        .or_else(|_| montage("", &rows, &small))
        .map_err(CliError::failed)
}

fn place(text: &str) -> Result<[f32; 2], String> {
    let parts: Vec<f32> = text.split(',').filter_map(|part| part.trim().parse().ok()).collect();
    <[f32; 2]>::try_from(parts)
        .map_err(|_| "two numbers are needed: metres ahead and to the left, as in 0.5,-0.2".to_owned())
}
