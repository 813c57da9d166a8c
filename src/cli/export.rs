//! `foreframe export`

use std::path::{Path, PathBuf};

use clap::value_parser;
use serde_json::json;

use super::{CliError, open_dataset, say};
use crate::evaluation::{self, figures::animation::enlarged_gif};
use crate::files::write_atomically;
use crate::frame::{Frame, codec};

/// Write an episode's frames as PNG, its actions as JSON and a GIF to look at.
///
/// The directory then serves `foreframe predict`: frames in order, and the actions that were taken from each on.
#[derive(clap::Args)]
#[command(after_help = "Example: foreframe export --dataset moving-observer --episode 3 --out look")]
pub(super) struct ExportArgs {
    /// The data set's directory, or its name in data/datasets
    #[arg(long, value_name = "DATASET")]
    dataset: PathBuf,
    /// The episode's number
    #[arg(long, default_value_t = 0)]
    episode: usize,
    /// A new directory to write into
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// The first frame of the episode that is written
    #[arg(long, default_value_t = 0)]
    first: usize,
    /// How many frames are written [default: all that follow]
    #[arg(long, value_parser = value_parser!(u32).range(1..))]
    count: Option<u32>,
}

pub(super) fn run(args: &ExportArgs) -> Result<(), CliError> {
    let (dir, dataset) = open_dataset(&args.dataset)?;
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
    if args.first >= episode.frame_count {
        return Err(CliError::Usage(format!(
            "--first is {}; episode {} has {} frames, counted from 0",
            args.first, args.episode, episode.frame_count
        )));
    }
    let end = episode.frame_count.min(
        args.count
            .map_or(usize::MAX, |count| args.first.saturating_add(count as usize)),
    );
    let range = episode.first_frame + args.first..episode.first_frame + end;
    evaluation::prepare(&args.out)?;
    let info = dataset.info();
    let frames = range
        .clone()
        .map(|frame| {
            Frame::new(
                info.frame_width_px,
                info.frame_height_px,
                dataset.pixels(frame).to_vec(),
            )
        })
        .collect::<Result<Vec<_>, _>>()
        .map_err(CliError::failed)?;
    for (index, frame) in frames.iter().enumerate() {
        let png = codec::encode_png(frame).map_err(CliError::failed)?;
        write(&args.out.join(format!("frame-{index:03}.png")), &png)?;
    }
    let delay_ms = (info.frame_period_s * 1000.0).round() as u32;
    write(
        &args.out.join("episode.gif"),
        &enlarged_gif(&frames, delay_ms).map_err(CliError::failed)?,
    )?;
    let actions: Vec<&[f32]> = range.clone().map(|frame| dataset.action(frame)).collect();
    let states: Vec<&[f32]> = range.map(|frame| dataset.state(frame)).collect();
    let text = json!({ "states": states, "actions": actions }).to_string();
    write(&args.out.join("actions.json"), text.as_bytes())?;
    say(format!(
        "{}: {} frames, episode.gif, actions.json",
        args.out.display(),
        frames.len()
    ))
}

fn write(path: &Path, bytes: &[u8]) -> Result<(), CliError> {
    write_atomically(path, bytes).map_err(|error| CliError::io("write", path, &error))
}
