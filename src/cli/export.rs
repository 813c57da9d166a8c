//! `foreframe export`

use std::ops::Range;
use std::path::{Path, PathBuf};

use clap::value_parser;
use serde_json::json;

use super::error::CliError;
use super::next_step::{name_from, shell_path};
use super::output::OutputDirectory;
use super::process::print_line;
use super::settings::CommonArgs;
use super::workspace::Workspace;
use foreframe_core::frame::codec;
use foreframe_core::types::Channel;
use foreframe_data::dataset::export::{
    ACTION_TOPIC, IMAGE_TOPIC, STATE_TOPIC, to_lerobot_images, to_lerobot_videos, to_mcap, to_mp4,
};
use foreframe_data::dataset::{Dataset, Episode};
use foreframe_train::evaluation::figures::animation::enlarged_gif;

/// Write an episode as images or MP4, or a data set for LeRobot or ROS 2.
///
/// Without --to, it writes an episode's frames as PNG, its actions and states as JSON, and a GIF to look at. `foreframe predict`
/// reads such a directory: frames in order, with an action and a state for each frame.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  foreframe export --dataset moving-observer --episode 3 --out look
  foreframe export --dataset static-observer --first 5 --count 10 --out part
  foreframe export --dataset mycar --to lerobot --videos --robot-type donkeycar --out mycar-lerobot
  foreframe export --dataset mycar --to mcap --out mycar.mcap
  foreframe export --dataset mycar --to mp4 --episode 2 --out look.mp4")]
pub(super) struct ExportArgs {
    /// The directory of a data set, or its name in `DATA_DIR/datasets`
    #[arg(long, value_name = "DATASET")]
    dataset: PathBuf,
    /// What to write: png (an episode's images), mp4 (an episode as video, with ffmpeg), lerobot (the data set, version 3), or
    /// mcap (a bag of ROS 2 with all episodes, or one)
    #[arg(long, value_enum, default_value_t = ExportFormat::Png)]
    to: ExportFormat,
    /// With --to lerobot: store the frames as H.264 videos (needs ffmpeg; without masks) instead of PNG images
    #[arg(long)]
    videos: bool,
    /// With --to lerobot: the robot, as LeRobot names it [default: turtlebot for simulated data, else unknown]
    #[arg(long, value_name = "NAME")]
    robot_type: Option<String>,
    /// The episode's number, counted from 0 [default: 0; with --to mcap, all]
    #[arg(long)]
    episode: Option<usize>,
    /// A new directory for the files; with --to mp4 or mcap, a new file
    #[arg(long, value_name = "PATH")]
    out: PathBuf,
    /// The first frame of the episode to write, counted from 0
    #[arg(long, default_value_t = 0)]
    first: usize,
    /// How many frames to write [default: all that follow]
    #[arg(long, value_parser = value_parser!(u32).range(1..))]
    count: Option<u32>,
    #[command(flatten)]
    settings: CommonArgs,
}

/// What an export writes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum ExportFormat {
    Png,
    Mp4,
    Lerobot,
    Mcap,
}

pub(super) fn run(args: &ExportArgs) -> Result<(), CliError> {
    let is_part = args.episode.is_some() || args.first > 0 || args.count.is_some();
    if args.to == ExportFormat::Lerobot && is_part {
        return Err(CliError::Usage(
            "--to lerobot writes the whole data set; leave out --episode, --first and --count".to_owned(),
        ));
    }
    for (option, is_given) in [("--videos", args.videos), ("--robot-type", args.robot_type.is_some())] {
        if args.to != ExportFormat::Lerobot && is_given {
            return Err(CliError::Usage(format!("{option} goes with --to lerobot only")));
        }
    }
    let workspace = Workspace::new(args.settings.start()?);
    let (dir, dataset) = workspace.open_dataset(&args.dataset)?;
    match args.to {
        ExportFormat::Lerobot => write_lerobot(args, &dataset),
        ExportFormat::Mcap if !is_part => {
            let episodes: Vec<_> = dataset.episodes().iter().map(Episode::frames).collect();
            write_mcap(args, &dataset, &episodes, &workspace.datasets_dir())
        }
        ExportFormat::Mcap => write_mcap(
            args,
            &dataset,
            &[selected(args, &dir, &dataset)?],
            &workspace.datasets_dir(),
        ),
        ExportFormat::Mp4 => write_mp4(args, &dataset, selected(args, &dir, &dataset)?),
        ExportFormat::Png => write_png(args, &dataset, selected(args, &dir, &dataset)?),
    }
}

/// The frames to write, counted over the whole data set.
fn selected(args: &ExportArgs, dir: &Path, dataset: &Dataset) -> Result<Range<usize>, CliError> {
    let number = args.episode.unwrap_or(0);
    let find = |episode: &&Episode| episode.index == number;
    let episode = dataset.episodes().iter().find(find).ok_or_else(|| {
        CliError::Usage(format!(
            "--episode is {number}; {} has {} episodes, counted from 0",
            dir.display(),
            dataset.episodes().len()
        ))
    })?;
    if args.first >= episode.frame_count {
        return Err(CliError::Usage(format!(
            "--first is {}; episode {number} has {} frames, counted from 0",
            args.first, episode.frame_count
        )));
    }
    let count = args.count.map_or(usize::MAX, |count| count as usize);
    let end = episode.frame_count.min(args.first.saturating_add(count));
    Ok(episode.first_frame + args.first..episode.first_frame + end)
}

fn write_lerobot(args: &ExportArgs, dataset: &Dataset) -> Result<(), CliError> {
    let output = OutputDirectory::create(&args.out)?;
    if args.videos {
        to_lerobot_videos(dataset, output.path(), args.robot_type.as_deref())?;
    } else {
        to_lerobot_images(dataset, output.path(), args.robot_type.as_deref())?;
    }
    output.finish()?;
    let info = dataset.info();
    print_line(format!(
        "{}: {} episodes, {} frames, LeRobot v3.0 with {}",
        args.out.display(),
        info.episode_count,
        info.frame_count,
        if args.videos { "videos" } else { "images" }
    ))
}

fn refuse_existing(args: &ExportArgs) -> Result<(), CliError> {
    if args.out.exists() {
        return Err(CliError::Usage(format!(
            "{} exists; name a new file",
            args.out.display()
        )));
    }
    Ok(())
}

fn write_mcap(
    args: &ExportArgs,
    dataset: &Dataset,
    episodes: &[Range<usize>],
    datasets_dir: &Path,
) -> Result<(), CliError> {
    refuse_existing(args)?;
    if args.out.extension().is_none_or(|extension| extension != "mcap") {
        return Err(CliError::Usage(format!(
            "--out is {}; name a file that ends with .mcap",
            args.out.display()
        )));
    }
    to_mcap(dataset, episodes, &args.out)?;
    let (info, out) = (dataset.info(), args.out.display());
    let frames: usize = episodes.iter().map(ExactSizeIterator::len).sum();
    print_line(format!("{out}: {} episodes, {frames} frames", episodes.len()))?;
    let topic = |topic, channels: &[Channel]| if channels.is_empty() { "none" } else { topic };
    let action = topic(ACTION_TOPIC, &info.action_channels);
    let state = topic(STATE_TOPIC, &info.state_channels);
    let (width, height) = (info.frame_width_px, info.frame_height_px);
    let command = format!(
        "foreframe import {} --name {} --image {IMAGE_TOPIC} --size {width}x{height} --action {action} --state {state}{}",
        shell_path(&args.out),
        unused_name(&args.out, datasets_dir),
        args.settings.repeated()
    );
    print_line(format!("to import it again: {command}"))
}

/// A name for the data set that an import of the file makes: that of the file, with a number if there is one.
fn unused_name(file: &Path, datasets_dir: &Path) -> String {
    let stem = name_from(&file.file_stem().unwrap_or_default().to_string_lossy(), "recording");
    let mut names = std::iter::once(stem.clone()).chain((2..).map(|number| format!("{stem}-{number}")));
    names.find(|name| !datasets_dir.join(name).exists()).unwrap_or(stem)
}

fn write_mp4(args: &ExportArgs, dataset: &Dataset, range: Range<usize>) -> Result<(), CliError> {
    refuse_existing(args)?;
    let frames = range.len();
    to_mp4(dataset, range, &args.out)?;
    print_line(format!("{}: {frames} frames", args.out.display()))
}

fn write_png(args: &ExportArgs, dataset: &Dataset, range: Range<usize>) -> Result<(), CliError> {
    let output = OutputDirectory::create(&args.out)?;
    let mut frames = Vec::with_capacity(range.len());
    for (index, frame) in range.clone().enumerate() {
        let frame = dataset.frame(frame)?;
        let png = codec::encode_png(&frame).map_err(CliError::failed)?;
        output.write(&format!("frame-{index:03}.png"), &png)?;
        frames.push(frame);
    }
    let gif = enlarged_gif(&frames, dataset.info().frame_period_s).map_err(CliError::failed)?;
    output.write("episode.gif", &gif)?;
    let actions: Vec<&[f32]> = range.clone().map(|frame| dataset.action(frame)).collect();
    let states: Vec<&[f32]> = range.map(|frame| dataset.state(frame)).collect();
    let text = json!({ "states": states, "actions": actions }).to_string();
    output.write("actions.json", text.as_bytes())?;
    output.finish()?;
    print_line(format!(
        "{}: {} frames, episode.gif, actions.json",
        args.out.display(),
        frames.len()
    ))
}
