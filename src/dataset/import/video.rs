//! Video files, decoded by the programs `ffmpeg` and `ffprobe`.

use std::fs::File;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::Mutex;

use serde_json::Value;

use super::recording::{DECODED, Images, PixelType, RawImages, Record, Recording};
use super::{ImportError, ImportOptions};

/// The containers that are read. Without such a list, ffmpeg takes a playlist for a video, and reads the files that it names.
const CONTAINERS: [&str; 4] = ["-format_whitelist", "mov,matroska,avi", "-protocol_whitelist", "file"];

/// Decodes a video into a file of gray frames and lists them with their times. Errors: `Program`, `Io`, `Record`.
pub(super) fn open(video: &Path, out: &Path, options: &ImportOptions) -> Result<Recording, ImportError> {
    if options.csv.is_some() || !options.actions.is_empty() || !options.states.is_empty() {
        return Err(ImportError::Option(
            "actions and states cannot be joined to a video yet; extract its frames to a folder and give a CSV with --csv"
                .to_owned(),
        ));
    }
    let (width_px, height_px) = frame_size(video)?;
    let times_s = frame_times(video)?;
    let decoded = out.join(DECODED);
    decode(video, &decoded)?;
    let file = File::open(&decoded).map_err(ImportError::io("read", &decoded))?;
    let frame_bytes = u64::from(width_px) * u64::from(height_px);
    let frames = file.metadata().map_err(ImportError::io("read", &decoded))?.len() / frame_bytes.max(1);
    if frames != times_s.len() as u64 {
        return Err(ImportError::record(
            format!("{} frame {frames}", video.display()),
            format!("the video ends here; it announces {} frames", times_s.len()),
        ));
    }
    let record = |(index, &timestamp_s): (usize, &f64)| Record {
        timestamp_s,
        session: String::new(),
        action: Vec::new(),
        state: Vec::new(),
        image: index,
        place: format!("{} frame {index}", video.display()),
    };
    Ok(Recording {
        name: video
            .file_stem()
            .map_or_else(|| "video".to_owned(), |name| name.to_string_lossy().into_owned()),
        action_channels: Vec::new(),
        state_channels: Vec::new(),
        camera: None,
        records: times_s.iter().enumerate().map(record).collect(),
        images: Images::Raw(RawImages {
            path: decoded,
            file: Mutex::new(file),
            width_px,
            height_px,
            offsets: (0..frames).map(|frame| frame * frame_bytes).collect(),
            pixel: PixelType::U8,
        }),
        skipped: Vec::new(),
    })
}

/// The file for the decoded frames of one of many videos.
pub(super) fn decoded_path(out: &Path, number: usize) -> PathBuf {
    out.join(format!("{number}-{DECODED}"))
}

/// Removes the decoded frames of a finished import.
pub(super) fn clean_up(out: &Path) {
    for entry in std::fs::read_dir(out).into_iter().flatten().flatten() {
        if entry.file_name().to_string_lossy().ends_with(DECODED) {
            // Nothing is lost if the file stays.
            let _ = std::fs::remove_file(entry.path());
        }
    }
}

/// Width and height of the first video stream.
pub(super) fn frame_size(video: &Path) -> Result<(u32, u32), ImportError> {
    let found = probe(video, "stream=width,height")?;
    let stream = &found["streams"][0];
    let side = |name: &str| stream[name].as_u64().and_then(|side| u32::try_from(side).ok());
    side("width")
        .zip(side("height"))
        .ok_or_else(|| ImportError::record(video.display().to_string(), "it holds no video stream"))
}

/// The presentation time of every frame, in seconds.
fn frame_times(video: &Path) -> Result<Vec<f64>, ImportError> {
    let found = probe(video, "frame=pts_time,best_effort_timestamp_time")?;
    let frames = found["frames"].as_array().map(Vec::as_slice).unwrap_or_default();
    let time = |(index, frame): (usize, &Value)| {
        let text = frame["pts_time"]
            .as_str()
            .or(frame["best_effort_timestamp_time"].as_str());
        text.and_then(|text| text.parse().ok())
            .ok_or_else(|| ImportError::record(format!("{} frame {index}", video.display()), "the frame has no time"))
    };
    frames.iter().enumerate().map(time).collect()
}

/// The presentation times of all frames in seconds, in order, without decoding them. Errors: `Program`, `Record`.
pub(super) fn packet_times(video: &Path) -> Result<Vec<f64>, ImportError> {
    let found = probe(video, "packet=pts_time")?;
    let packets = found["packets"].as_array().map(Vec::as_slice).unwrap_or_default();
    let time = |packet: &Value| packet["pts_time"].as_str()?.parse::<f64>().ok();
    let mut times_s: Vec<f64> = packets.iter().filter_map(time).collect();
    times_s.sort_by(f64::total_cmp);
    Ok(times_s)
}

fn probe(video: &Path, entries: &str) -> Result<Value, ImportError> {
    let mut command = Command::new("ffprobe");
    command
        .args(CONTAINERS)
        .args([
            "-v",
            "error",
            "-select_streams",
            "v:0",
            "-of",
            "json",
            "-show_entries",
            entries,
        ])
        .arg(argument(video));
    let output = run(command, "ffprobe", video)?;
    serde_json::from_slice(&output)
        .map_err(|error| ImportError::Program(format!("ffprobe's answer on {} is not JSON: {error}", video.display())))
}

/// Writes all frames as 8-bit gray, one after the other.
pub(super) fn decode(video: &Path, decoded: &Path) -> Result<(), ImportError> {
    let mut command = Command::new("ffmpeg");
    command
        .args(["-v", "error", "-nostdin", "-y", "-xerror"])
        .args(CONTAINERS)
        .arg("-i")
        .arg(argument(video))
        .args([
            "-map",
            "0:v:0",
            "-fps_mode",
            "passthrough",
            "-pix_fmt",
            "gray",
            "-f",
            "rawvideo",
        ])
        .arg(decoded);
    run(command, "ffmpeg", video).map(drop)
}

/// A path that ffmpeg cannot take for an option or a protocol.
fn argument(video: &Path) -> PathBuf {
    if video.is_absolute() {
        video.to_owned()
    } else {
        Path::new(".").join(video)
    }
}

fn run(mut command: Command, program: &str, video: &Path) -> Result<Vec<u8>, ImportError> {
    let output = command.stdin(Stdio::null()).output().map_err(|error| {
        ImportError::Program(match error.kind() {
            std::io::ErrorKind::NotFound => format!(
                "{program} is not installed; it reads videos (Debian: apt-get install ffmpeg). Or extract the frames to a folder"
            ),
            _ => format!("{program} could not be started: {error}"),
        })
    })?;
    if output.status.success() {
        return Ok(output.stdout);
    }
    let reason = String::from_utf8_lossy(&output.stderr);
    let first = reason.lines().next().unwrap_or("it gave no reason");
    Err(ImportError::Record {
        place: video.display().to_string(),
        reason: format!("{program} cannot read the video: {first}"),
    })
}
