//! Frames of videos: which of a file's packets are frames, and what damage is noticed.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use foreframe_data::dataset::Dataset;
use foreframe_data::dataset::import::ImportOptions;

use crate::import::{run, small};
use crate::recordings::{contents, has_ffmpeg, lerobot_videos, video};

/// Frames of the data sets, in one episode.
const FRAMES: usize = 25;

/// A video from which the first frames were cut without decoding it: their packets are in the file, but are not shown.
fn trimmed_video(dir: &Path) -> PathBuf {
    let (whole, trimmed) = (dir.join("whole.mp4"), dir.join("trimmed.mp4"));
    video(&whole, 80);
    let mut command = Command::new("ffmpeg");
    command.args(["-v", "error", "-ss", "0.9", "-i"]).arg(&whole);
    assert!(command.args(["-c", "copy"]).arg(&trimmed).status().unwrap().success());
    trimmed
}

/// A data set of `LeRobot` whose video is replaced.
fn set_with(dir: &Path, video: &Path) -> PathBuf {
    let set = dir.join("set");
    lerobot_videos(&set, FRAMES as u32);
    let files = contents(&set).into_keys();
    let own: Vec<PathBuf> = files
        .filter(|path| path.extension().is_some_and(|ending| ending == "mp4"))
        .collect();
    assert_eq!(own.len(), 1);
    fs::copy(video, set.join(&own[0])).unwrap();
    set
}

fn pixels(out: &Path, frames: usize) -> Vec<u8> {
    let set = Dataset::open(out).unwrap();
    (0..frames)
        .flat_map(|frame| set.pixels(frame).unwrap().into_owned())
        .collect()
}

#[test]
fn frames_that_a_trimmed_video_does_not_show_are_not_counted() {
    if !has_ffmpeg() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let trimmed = trimmed_video(dir.path());
    let set = set_with(dir.path(), &trimmed);
    let (of_set, of_video) = (dir.path().join("of-set"), dir.path().join("of-video"));
    assert_eq!(run(&set, &of_set, small()).unwrap().info.frame_count, FRAMES);
    run(&trimmed, &of_video, small()).unwrap();
    assert!(pixels(&of_set, FRAMES) == pixels(&of_video, FRAMES), "other frames");
}

#[test]
fn a_video_that_was_cut_off_is_refused_or_listed() {
    if !has_ffmpeg() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let whole = dir.path().join("whole.mkv");
    video(&whole, 80);
    let bytes = fs::read(&whole).unwrap();
    let cut = dir.path().join("cut.mkv");
    fs::write(&cut, &bytes[..bytes.len() / 2]).unwrap();
    let out = dir.path().join("out");
    let error = run(&cut, &out, small()).unwrap_err().to_string();
    assert!(error.contains("cut.mkv: the video is damaged"), "{error}");
    let skipping = ImportOptions {
        skip_bad: true,
        ..small()
    };
    let read = run(&cut, &out, skipping).unwrap();
    assert!((20..80).contains(&read.info.frame_count), "{}", read.info.frame_count);
    assert_eq!(read.skipped.len(), 1, "{:?}", read.skipped);
}
