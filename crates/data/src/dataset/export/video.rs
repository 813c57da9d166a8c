//! Encodes frames as H.264 with the program `ffmpeg`.

use std::io::Write as _;
use std::ops::Range;
use std::path::Path;
use std::process::{Child, Command, Stdio};

use crate::dataset::program::{ProgramError, spawn};
use crate::dataset::store::files::write_whole;
use crate::dataset::{Dataset, DatasetError};

/// Writes frames, counted over the whole data set, as an MP4 file; one frame takes the data set's frame period.
/// Errors: `Program`, `Io`.
pub fn to_mp4(dataset: &Dataset, frames: Range<usize>, path: &Path) -> Result<(), DatasetError> {
    write_whole(path, "partial.mp4", |partial| {
        encode(dataset, frames, start(dataset, partial)?)
    })
}

fn start(dataset: &Dataset, path: &Path) -> Result<Child, DatasetError> {
    let info = dataset.info();
    let mut command = Command::new("ffmpeg");
    command
        .args([
            "-v", "error", "-nostdin", "-y", "-f", "rawvideo", "-pix_fmt", "gray", "-s",
        ])
        .arg(format!("{}x{}", info.frame_width_px, info.frame_height_px))
        .arg("-r")
        .arg((1.0 / info.frame_period_s).to_string())
        .args(["-i", "-", "-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-c:v", "libx264"])
        // A key frame every other frame, so that single frames can be read quickly.
        .args(["-crf", "12", "-g", "2", "-pix_fmt", "yuv420p"])
        .arg(Path::new(".").join(path))
        .stdin(Stdio::piped())
        .stdout(Stdio::null())
        .stderr(Stdio::piped());
    spawn(&mut command).map_err(|error| {
        DatasetError::Program(match error {
            ProgramError::Missing => {
                "ffmpeg is not installed; it writes videos (Debian: apt-get install ffmpeg)".to_owned()
            }
            _ => format!("ffmpeg: {error}"),
        })
    })
}

fn encode(dataset: &Dataset, mut frames: Range<usize>, mut encoder: Child) -> Result<(), DatasetError> {
    let failed = |reason: String| DatasetError::Program(format!("ffmpeg could not write the video: {reason}"));
    let sent = encoder.stdin.take().map_or(Ok(()), |mut input| {
        frames.try_for_each(|frame| {
            let pixels = dataset.pixels(frame)?;
            input.write_all(&pixels).map_err(|error| failed(error.to_string()))
        })
    });
    let output = encoder.wait_with_output().map_err(|error| failed(error.to_string()))?;
    if !output.status.success() {
        let text = String::from_utf8_lossy(&output.stderr);
        return Err(failed(text.lines().next().unwrap_or("it gave no reason").to_owned()));
    }
    sent
}
