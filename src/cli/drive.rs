//! `foreframe drive`

use std::path::PathBuf;
use std::time::Duration;

use super::error::CliError;
use super::interrupt;
use super::output::OutputDirectory;
use super::process::print_line;
use super::progress::ProgressLine;
use super::settings::CommonArgs;
use super::table::aligned;
use super::workspace::Workspace;
use foreframe_core::registry::Model;
use foreframe_core::types::Seed;
use foreframe_sim::{RoomSet, Scenario};
use foreframe_train::evaluation::drive::{self, DriveScore, DriveSettings, DriverKind, DriverScores};
use foreframe_train::evaluation::figures::episode_animation::episode_gif;

/// Let robots drive to goals in the simulator, with several drivers in the same episodes.
///
/// The drivers: pid drives straight to the goal and sees nothing. stop does the same, but stands while the model sees something on
/// its way. plan follows the plan that the model finds, anew at every frame. velocity does the same, but expects movers to go on as
/// fast as they went, and remembers those that left the picture for 2.5 s. visible plans as velocity, but knows the true place and
/// speed of each robot in the picture, and remembers none; places knows those of all robots. simulator plans with the simulator
/// itself as the model: the upper limit.
///
/// Goals can be reached on a straight line, but for the other robots. All drivers know where the goal is. The table has means over
/// the episodes with 95 % bootstrap intervals; "per km" is the number of all collisions divided by the total distance. Of the
/// collisions, (standing) are those in which the robot stood or turned on the spot, (unseen) those with a robot that its camera had
/// not shown in the two seconds before. Episodes run side by side on all cores.
///
/// After Ctrl-C, the table has the episodes that are finished. Drivers then have different numbers of episodes (column "episodes"),
/// and no GIFs are drawn.
///
/// With --out, writes drive.json (the scores and all episodes) and three GIFs for each driver: its best, its median and its worst
/// episode, as in pid-best.gif. Those with a success come first, then those with fewer collisions, then the shorter ones. A GIF shows the
/// camera's picture with the plan on the floor, and the room from above; of an episode of more than half a minute, its end. These
/// episodes are driven once more for that; with --budget-ms they may differ from those of the scores.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  foreframe drive --scenario crowded --episodes 50 --driver pid,simulator
  foreframe drive --scenario crossing --rooms varied --model rooms --driver stop,velocity,plan --json
  foreframe drive --scenario crossing --model rooms --driver stop,plan --out drive")]
pub(super) struct DriveArgs {
    /// The scenario: moving-observer, crowded or crossing
    #[arg(long, default_value_t = DriveSettings::default().scenario)]
    scenario: Scenario,
    /// Each episode in a room of its own from that set: varied, new-materials or new-cameras [default: the same room]
    #[arg(long, value_name = "SET")]
    rooms: Option<RoomSet>,
    /// Number of episodes
    #[arg(long, default_value_t = DriveSettings::default().episodes as u32, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    episodes: u32,
    /// The same seed gives the same episodes and goals
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// The drivers: pid, stop, velocity, visible, places, plan, simulator
    #[arg(long = "driver", value_delimiter = ',', required = true)]
    drivers: Vec<DriverKind>,
    /// For the drivers stop, velocity, visible, places and plan: the directory of a model, its name, or NAME@VERSION
    #[arg(long)]
    model: Option<String>,
    /// Longest time of an episode, in seconds
    #[arg(long, value_name = "S", default_value_t = DriveSettings::default().duration_s)]
    duration: f64,
    /// The time for each plan of the drivers velocity, visible, places and plan, in milliseconds; without it, searches are whole, and a drive can be repeated
    #[arg(long, value_name = "MS", value_parser = clap::value_parser!(u64).range(1..=10_000))]
    budget_ms: Option<u64>,
    /// Print the scores and all episodes as JSON
    #[arg(long)]
    json: bool,
    /// A new directory for the GIFs and the scores
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    #[command(flatten)]
    settings: CommonArgs,
}

pub(super) fn run(args: &DriveArgs) -> Result<(), CliError> {
    let workspace = Workspace::new(args.settings.start()?);
    let model = args
        .model
        .as_ref()
        .map(|model| workspace.load_model(model))
        .transpose()?;
    let model = model.as_ref().map(|(_, model)| model);
    let output = args.out.as_deref().map(OutputDirectory::create).transpose()?;
    let settings = DriveSettings {
        scenario: args.scenario,
        rooms: args.rooms,
        episodes: args.episodes as usize,
        seed: Seed(args.seed),
        drivers: args.drivers.clone(),
        duration_s: args.duration,
        budget: args.budget_ms.map(Duration::from_millis),
    };
    let is_stopped = interrupt::flag()?;
    let (progress, total) = (ProgressLine::new("episodes"), u64::from(args.episodes));
    let on_episode = |driver: DriverKind, done: usize| {
        progress.update(done as u64, total, || driver.name().to_owned());
    };
    let scores = drive::run(model, &settings, &is_stopped, &on_episode);
    progress.finish();
    let scores = scores?;
    let finished: usize = scores.iter().map(|of_driver| of_driver.episodes.len()).sum();
    let asked = settings.episodes * settings.drivers.len();
    let is_whole = finished == asked;
    if args.json {
        print_line(serde_json::to_string(&scores).map_err(CliError::failed)?)?;
    } else {
        print_table(&scores)?;
    }
    let drawn = if is_whole { &scores[..] } else { &[] };
    let files = output
        .map(|output| write_files(output, model, &settings, (&scores, drawn)))
        .transpose()?;
    match (&args.out, files) {
        (Some(out), Some(files)) if !args.json => print_line(format!("{}: {}", out.display(), files.join(", ")))?,
        _ => {}
    }
    if is_whole {
        return Ok(());
    }
    Err(CliError::Interrupted(format!(
        "stopped; {finished} of {asked} episodes are finished"
    )))
}

/// Writes the scores, and the GIFs of the drivers that are `drawn`; returns the names of the files.
fn write_files(
    output: OutputDirectory,
    model: Option<&Model>,
    settings: &DriveSettings,
    (scores, drawn): (&[DriverScores], &[DriverScores]),
) -> Result<Vec<String>, CliError> {
    let text = serde_json::to_string_pretty(scores).map_err(CliError::failed)?;
    let mut files = vec!["drive.json".to_owned()];
    output.write("drive.json", format!("{text}\n").as_bytes())?;
    for of_driver in drawn {
        for (rank, episode) in of_driver.examples() {
            let file = format!("{}-{rank}.gif", of_driver.driver.name());
            output.write(&file, &episode_gif(model, settings, of_driver.driver, episode)?)?;
            files.push(file);
        }
    }
    output.finish()?;
    Ok(files)
}

fn print_table(scores: &[DriverScores]) -> Result<(), CliError> {
    let header = [
        "driver",
        "episodes",
        "success",
        "collisions",
        "per km",
        "(standing)",
        "(unseen)",
        "time s",
        "SPL",
        "closest m",
        "stops",
        "choice ms (p50, p95)",
    ];
    let rows: Vec<[String; 12]> = scores.iter().map(row).collect();
    for line in aligned(header, &rows) {
        print_line(line)?;
    }
    if scores.iter().any(|of_driver| !of_driver.intervals_are_reliable) {
        print_line("the intervals of so few episodes are not to be trusted")?;
    }
    Ok(())
}

fn row(scores: &DriverScores) -> [String; 12] {
    let [median, late] = scores.planning_ms;
    [
        scores.driver.name().to_owned(),
        scores.episodes.len().to_string(),
        text(&scores.success),
        text(&scores.collisions),
        format!("{:.0}", scores.collisions_per_km.mean),
        format!("{:.2}", scores.while_standing.mean),
        format!("{:.2}", scores.unseen.mean),
        text(&scores.time_s),
        text(&scores.spl),
        text(&scores.closest_m),
        text(&scores.stops),
        format!("{median:.1}, {late:.1}"),
    ]
}

fn text(score: &DriveScore) -> String {
    // Without a sign of a zero.
    let rounded = |value: f64| format!("{:.2}", (100.0 * value).round() / 100.0 + 0.0);
    match score.interval {
        None => rounded(score.mean),
        Some(interval) => format!(
            "{} ({} … {})",
            rounded(score.mean),
            rounded(interval.low),
            rounded(interval.high)
        ),
    }
}
