//! Imports that start ffmpeg: it ends with its import, and no decoded frames are written to disk.
#![cfg(target_os = "linux")]

use std::fs;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use foreframe_data::dataset::import::ImportOptions;
use serde_json::{Value, json};

use crate::import::run;
use crate::process::{RunningServer, foreframe, is_alive, signal};
use crate::recordings::{self, contents, has_ffmpeg};
use crate::service::TIMEOUT;

const JOBS: &str = "/v1/jobs";

/// A small file with large frames: 2 MB each when decoded.
fn large_video(path: &Path) {
    let source = "color=black:size=1920x1080:rate=30";
    let status = Command::new("ffmpeg")
        .args(["-v", "error", "-f", "lavfi", "-i", source, "-frames:v", "300"])
        .args(["-c:v", "mpeg4"])
        .arg(path)
        .status();
    assert!(status.unwrap().success());
}

/// The process of ffmpeg (not of ffprobe) that decodes a file.
fn decoder_of(video: &Path) -> Option<u32> {
    let processes = fs::read_dir("/proc").unwrap().flatten();
    let mut ids = processes.filter_map(|entry| entry.file_name().to_str()?.parse::<u32>().ok());
    ids.find(|id| {
        let line = fs::read(format!("/proc/{id}/cmdline")).unwrap_or_default();
        let arguments: Vec<&[u8]> = line.split(|byte| *byte == 0).collect();
        arguments.first().is_some_and(|program| program.ends_with(b"ffmpeg"))
            && arguments.contains(&video.as_os_str().as_encoded_bytes())
    })
}

fn wait_for<T>(mut condition: impl FnMut() -> Option<T>) -> T {
    let deadline = Instant::now() + TIMEOUT;
    loop {
        if let Some(found) = condition() {
            return found;
        }
        assert!(Instant::now() < deadline, "it did not come");
        std::thread::sleep(Duration::from_millis(2));
    }
}

/// Waits until the decoder runs, and stops it there: it would stay as it is until somebody kills it.
fn stopped_decoder(video: &Path) -> u32 {
    let decoder = wait_for(|| decoder_of(video));
    signal("-STOP", decoder);
    decoder
}

fn assert_ends(process: u32) {
    let deadline = Instant::now() + Duration::from_secs(5);
    while is_alive(process) {
        if Instant::now() > deadline {
            signal("-KILL", process);
            panic!("ffmpeg did not end");
        }
        std::thread::sleep(Duration::from_millis(2));
    }
}

/// All bytes below a directory.
/// Bytes of all files; none if there is no directory, which a failed import does not leave.
fn bytes_below(dir: &Path) -> usize {
    if !dir.exists() {
        return 0;
    }
    contents(dir).values().map(Vec::len).sum()
}

fn import_job(source: &str) -> Value {
    json!({"kind": "import", "name": "walk", "source": source, "size": "16x12"})
}

/// A server and its folder of recordings, which holds `large.mp4`.
fn server(dir: &Path) -> RunningServer {
    let recordings = dir.join("recordings");
    fs::create_dir(&recordings).unwrap();
    large_video(&recordings.join("large.mp4"));
    let recordings = format!("import_dir={}", recordings.display());
    RunningServer::start(dir, &["--set", &recordings, "--set", "job_memory_mib=3000"])
}

/// The name of the recording as a job's process gives it to ffmpeg.
fn recording(dir: &Path, name: &str) -> std::path::PathBuf {
    dir.join("recordings").join(name).canonicalize().unwrap()
}

#[test]
fn ffmpeg_ends_with_the_server_that_is_killed() {
    let dir = tempfile::tempdir().unwrap();
    if !has_ffmpeg() {
        return;
    }
    let served = server(dir.path());
    served.ask("POST", JOBS, &import_job("large.mp4"));
    let decoder = stopped_decoder(&recording(dir.path(), "large.mp4"));
    let limits = fs::read_to_string(format!("/proc/{decoder}/limits")).unwrap();
    let memory = limits.lines().find(|line| line.starts_with("Max data size")).unwrap();
    assert!(memory.contains(&(3000u64 << 20).to_string()), "{memory}");
    // Killed with SIGKILL.
    drop(served);
    assert_ends(decoder);
}

#[test]
fn ffmpeg_ends_with_the_process_of_its_job() {
    let dir = tempfile::tempdir().unwrap();
    if !has_ffmpeg() {
        return;
    }
    let served = server(dir.path());
    served.ask("POST", JOBS, &import_job("large.mp4"));
    let decoder = stopped_decoder(&recording(dir.path(), "large.mp4"));
    let stat = fs::read_to_string(format!("/proc/{decoder}/stat")).unwrap();
    let job = stat.rsplit_once(") ").unwrap().1.split(' ').nth(1).unwrap();
    signal("-KILL", job.parse().unwrap());
    assert_ends(decoder);
    // The next attempt reads the video from its beginning.
    let done = served.wait_for_job("job-1", |job| job["state"] == "succeeded");
    assert_eq!(done["result"]["frames"], 300, "{done}");
}

#[test]
fn a_cancelled_import_leaves_neither_ffmpeg_nor_frames() {
    let dir = tempfile::tempdir().unwrap();
    if !has_ffmpeg() {
        return;
    }
    let served = server(dir.path());
    let other = dir.path().join("recordings/other.mp4");
    recordings::video(&other, 40);
    served.ask("POST", JOBS, &import_job("large.mp4"));
    let decoder = stopped_decoder(&recording(dir.path(), "large.mp4"));
    let data = dir.path().join("data/datasets");
    assert!(bytes_below(&data) < 1 << 20, "{:?}", contents(&data).keys());
    served.ask("POST", &format!("{JOBS}/job-1/cancel"), &Value::Null);
    assert_ends(decoder);
    served.wait_for_job("job-1", |job| job["state"] == "cancelled");
    assert!(bytes_below(&data) < 1 << 20, "{:?}", contents(&data).keys());
    // Another recording under the same name has its own frames.
    served.ask("POST", JOBS, &import_job("other.mp4"));
    served.wait_for_job("job-2", |job| job["state"] == "succeeded");
    let options = ImportOptions {
        frame_width_px: 16,
        frame_height_px: 12,
        ..ImportOptions::default()
    };
    let alone = run(&other, &dir.path().join("alone"), options).unwrap().info;
    let walk = served.ask("GET", "/v1/datasets/walk", &Value::Null);
    assert_eq!(walk["content_hash"], json!(alone.content_hash), "{walk}");
}

#[test]
fn ctrl_c_ends_ffmpeg_and_leaves_no_frames() {
    let dir = tempfile::tempdir().unwrap();
    if !has_ffmpeg() {
        return;
    }
    let video = dir.path().join("large.mp4");
    large_video(&video);
    let mut command = foreframe(dir.path());
    command.arg("import").arg(&video).args(["--out", "set"]);
    let mut import = command.stderr(Stdio::null()).spawn().unwrap();
    let decoder = stopped_decoder(&video);
    signal("-INT", import.id());
    assert_ends(decoder);
    assert_eq!(import.wait().unwrap().code(), Some(130));
    assert!(bytes_below(&dir.path().join("set")) < 1 << 20);
}

#[test]
fn a_portrait_video_keeps_its_sides() {
    let dir = tempfile::tempdir().unwrap();
    if !has_ffmpeg() {
        return;
    }
    let (video, turned) = (dir.path().join("drive.mp4"), dir.path().join("turned.mp4"));
    recordings::video(&video, 10);
    let mut ffmpeg = Command::new("ffmpeg");
    ffmpeg.args(["-v", "error", "-i"]).arg(&video);
    ffmpeg.args(["-c", "copy", "-metadata:s:v:0", "rotate=90"]).arg(&turned);
    assert!(ffmpeg.status().unwrap().success());
    let (width, height) = recordings::SIZE;
    let import = |source: &Path, out: &str, size: (u32, u32)| {
        let options = ImportOptions {
            frame_width_px: size.0,
            frame_height_px: size.1,
            ..ImportOptions::default()
        };
        let out = dir.path().join(out);
        run(source, &out, options).unwrap();
        foreframe_data::dataset::Dataset::open(&out)
            .unwrap()
            .pixels(0)
            .unwrap()
            .to_vec()
    };
    let upright = import(&video, "upright", (width, height));
    let side = import(&turned, "side", (height, width));
    // Turned by a quarter: the first row becomes the last column, or the first one.
    let (width, height) = (width as usize, height as usize);
    let column = |at: usize| (0..width).map(|row| side[row * height + at]).collect::<Vec<u8>>();
    let mut backwards = upright[..width].to_vec();
    backwards.reverse();
    assert!(
        column(height - 1) == upright[..width] || column(0) == backwards,
        "the pixels of a turned video are out of order"
    );
}
