//! `foreframe export`

use std::ops::Range;
use std::path::PathBuf;

use clap::value_parser;
use serde_json::json;

use super::output::OutputDirectory;
use super::settings::CommonArgs;
use super::workspace::Workspace;
use super::{CliError, print_line};
use crate::dataset::{Dataset, Episode};
use crate::evaluation::figures::animation::enlarged_gif;
use crate::frame::{Frame, codec};

/// Write an episode's frames as PNG, its actions and states as JSON, and a GIF to look at.
///
/// `foreframe predict` reads such a directory: frames in order, with an action and a state for each frame.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  foreframe export --dataset moving-observer --episode 3 --out look
  foreframe export --dataset static-observer --first 5 --count 10 --out part")]
pub(super) struct ExportArgs {
    /// The directory of a data set, or its name in `DATA_DIR/datasets`
    #[arg(long, value_name = "DATASET")]
    dataset: PathBuf,
    /// The episode's number, counted from 0
    #[arg(long, default_value_t = 0)]
    episode: usize,
    /// A new directory for the files
    #[arg(long, value_name = "DIR")]
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

pub(super) fn run(args: &ExportArgs) -> Result<(), CliError> {
    let workspace = Workspace::new(args.settings.start()?);
    let (dir, dataset) = workspace.open_dataset(&args.dataset)?;
    let episode = dataset
        .episodes()
        .iter()
        .find(|episode| episode.index == args.episode)
        .ok_or_else(|| {
            CliError::Usage(format!(
                "--episode is {}; {} has {} episodes, counted from 0",
                args.episode,
                dir.display(),
                dataset.episodes().len()
            ))
        })?;
    let range = selected(args, episode)?;
    let output = OutputDirectory::create(&args.out)?;
    write(&output, &dataset, range.clone())?;
    output.finish()?;
    print_line(format!(
        "{}: {} frames, episode.gif, actions.json",
        args.out.display(),
        range.len()
    ))
}

/// The frames to write, counted over the whole data set.
fn selected(args: &ExportArgs, episode: &Episode) -> Result<Range<usize>, CliError> {
    if args.first >= episode.frame_count {
        return Err(CliError::Usage(format!(
            "--first is {}; episode {} has {} frames, counted from 0",
            args.first, args.episode, episode.frame_count
        )));
    }
    let count = args.count.map_or(usize::MAX, |count| count as usize);
    let end = episode.frame_count.min(args.first.saturating_add(count));
    Ok(episode.first_frame + args.first..episode.first_frame + end)
}

fn write(output: &OutputDirectory, dataset: &Dataset, range: Range<usize>) -> Result<(), CliError> {
    let info = dataset.info();
    let mut frames = Vec::with_capacity(range.len());
    for (index, frame) in range.clone().enumerate() {
        let pixels = dataset.pixels(frame).to_vec();
        let frame = Frame::new(info.frame_width_px, info.frame_height_px, pixels).map_err(CliError::failed)?;
        let png = codec::encode_png(&frame).map_err(CliError::failed)?;
        output.write(&format!("frame-{index:03}.png"), &png)?;
        frames.push(frame);
    }
    let delay_ms = (info.frame_period_s * 1000.0).round() as u32;
    let gif = enlarged_gif(&frames, delay_ms).map_err(CliError::failed)?;
    output.write("episode.gif", &gif)?;
    let actions: Vec<&[f32]> = range.clone().map(|frame| dataset.action(frame)).collect();
    let states: Vec<&[f32]> = range.map(|frame| dataset.state(frame)).collect();
    let text = json!({ "states": states, "actions": actions }).to_string();
    output.write("actions.json", text.as_bytes())
}
