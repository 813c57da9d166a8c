//! Video files, decoded by the programs `ffmpeg` and `ffprobe`. Frames are decoded when they are needed, one after the other;
//! none is written to a file.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::atomic::AtomicBool;
use std::sync::{Mutex, PoisonError};

use rayon::prelude::*;

use super::files::stem;
use super::recording::{ImageSource, Record, Recording, ResizeImage};
use super::skipped::SkippedList;
use super::{ImportError, ImportOptions};
use crate::dataset::program::{ProgramError, ProgramOutput};
use foreframe_core::frame::{Frame, MAX_SIDE_PX};

/// The containers and protocols that are read. Without such lists, ffmpeg takes a playlist for a video, and reads the files that it
/// names.
const ALLOWED: [&str; 4] = ["-protocol_whitelist", "file", "-format_whitelist", "mov,matroska,avi"];
/// Frames that are decoded before they are resized together.
const DECODED_FRAMES: usize = 8;

/// Lists the frames of a video with their times. Errors: `Option`, `Program`, `Record`, `Stopped`.
pub(super) fn open(video: &Path, options: &ImportOptions, cancelled: &AtomicBool) -> Result<Recording, ImportError> {
    if options.csv.is_some() || !options.actions.is_empty() || !options.states.is_empty() {
        return Err(ImportError::Option(
            "actions and states cannot be joined to a video yet; extract its frames to a folder and give a CSV with --csv"
                .to_owned(),
        ));
    }
    options.names_no_values("a video")?;
    let ListedFrames { times_s, damage } = frames_of(video, cancelled)?;
    let mut skipped = SkippedList::default();
    damage.map_or(Ok(()), |damage| damage.leave_out(options.skip_bad, &mut skipped))?;
    let count = times_s.len();
    let record = |(frame, timestamp_s): (usize, f64)| Record {
        timestamp_s,
        place: place(video, frame),
        ..Record::default()
    };
    let records = times_s.into_iter().enumerate().map(record).collect();
    let places = (0..count).map(|frame| (0, frame)).collect();
    let images = VideoFrames::new(vec![(video.to_owned(), count)], places);
    Ok(Recording {
        skipped,
        ..Recording::new(stem(video, "video"), records, images)
    })
}

fn place(video: &Path, frame: usize) -> String {
    format!("{} frame {frame}", video.display())
}

/// The frames of a video.
pub(super) struct ListedFrames {
    /// The presentation time of every frame, in seconds.
    pub(super) times_s: Vec<f64>,
    /// What is wrong with the video; frames can be missing.
    pub(super) damage: Option<ImportError>,
}

/// Lists the frames by decoding the video: not every packet of a file becomes a frame. Errors: `Program`, `Record`, `Stopped`.
pub(super) fn frames_of(video: &Path, cancelled: &AtomicBool) -> Result<ListedFrames, ImportError> {
    let failed = |error| failure("ffprobe", video, error);
    let mut command = Command::new("ffprobe");
    command.args(ALLOWED).args(["-v", "error", "-select_streams", "v:0"]);
    command.args(["-of", "compact=print_section=0", "-show_entries"]);
    command
        .arg("frame=pts_time,best_effort_timestamp_time")
        .arg(argument(video));
    let mut output = ProgramOutput::start(&mut command).map_err(failed)?;
    let mut times_s = Vec::new();
    // Each line is one frame, as in `pts_time=0.1|best_effort_timestamp_time=0.1`.
    while let Some(line) = output.line(cancelled).map_err(failed)? {
        if line.is_empty() {
            continue;
        }
        let time = number(&line, "pts_time").or_else(|| number(&line, "best_effort_timestamp_time"));
        let wrong = || ImportError::record(place(video, times_s.len()), "the frame has no time");
        times_s.push(time.ok_or_else(wrong)?);
    }
    let complaint = output.finish(cancelled).map_err(failed)?;
    if times_s.is_empty() {
        return Err(ImportError::record(video.display(), "it holds no video stream"));
    }
    let damage = (!complaint.is_empty()).then(|| {
        let (count, complaint) = (times_s.len(), without_sender(&complaint));
        let reason = format!("the video is damaged; {count} frames can be read: {complaint}");
        ImportError::record(video.display(), reason)
    });
    Ok(ListedFrames { times_s, damage })
}

/// A number among the fields of an entry.
fn number(fields: &str, name: &str) -> Option<f64> {
    let mut fields = fields.split('|').filter_map(|field| field.split_once('='));
    let (_, value) = fields.find(|(found, _)| *found == name)?;
    value.parse().ok().filter(|value: &f64| value.is_finite())
}

/// A path that ffmpeg cannot take for an option or a protocol; an absolute one stays as it is.
fn argument(video: &Path) -> PathBuf {
    Path::new(".").join(video)
}

/// A message of ffmpeg or ffprobe without the part of the program that wrote it, as in `[matroska,webm @ 0x55fc6ae96800]`.
fn without_sender(message: &str) -> &str {
    let sent = message.strip_prefix('[').and_then(|rest| rest.split_once("] "));
    sent.map_or(message, |(_, message)| message)
}

fn failure(program: &str, video: &Path, error: ProgramError) -> ImportError {
    match error {
        ProgramError::Missing => ImportError::Program(format!(
            "{program} is not installed; it reads videos (Debian: apt-get install ffmpeg). Or extract the frames to a folder"
        )),
        ProgramError::Start(_) => ImportError::Program(format!("{program}: {error}")),
        ProgramError::Cancelled => ImportError::Stopped,
        ProgramError::Failed(reason) => {
            let reason = without_sender(&reason);
            ImportError::record(video.display(), format!("{program} cannot read the video: {reason}"))
        }
    }
}

/// Frames of videos. They are decoded in the order in which they are wanted; going back starts the video again.
pub(super) struct VideoFrames {
    /// Each video and its number of frames.
    videos: Vec<(PathBuf, usize)>,
    /// Video and frame of each image.
    places: Vec<(usize, usize)>,
    stream: Mutex<Option<FrameStream>>,
}

impl VideoFrames {
    pub(super) fn new(videos: Vec<(PathBuf, usize)>, places: Vec<(usize, usize)>) -> Self {
        Self {
            videos,
            places,
            stream: Mutex::new(None),
        }
    }
}

impl ImageSource for VideoFrames {
    /// Decodes the frames one after the other and resizes some of them together.
    fn read_all(
        &self,
        wanted: &[&Record],
        resize: ResizeImage<'_>,
        cancelled: &AtomicBool,
    ) -> Vec<Result<Frame, ImportError>> {
        let mut resized = Vec::with_capacity(wanted.len());
        for some in wanted.chunks(DECODED_FRAMES) {
            let decoded: Vec<_> = some.iter().map(|wanted| self.read(wanted, cancelled)).collect();
            let resize = |(decoded, wanted): (Result<Frame, _>, &&Record)| resize(&decoded?, &wanted.place);
            resized.par_extend(decoded.into_par_iter().zip(some).map(resize));
        }
        resized
    }

    fn read(&self, wanted: &Record, cancelled: &AtomicBool) -> Result<Frame, ImportError> {
        let (video, frame) = self.places[wanted.image];
        let (path, frames) = &self.videos[video];
        let mut stream = self.stream.lock().unwrap_or_else(PoisonError::into_inner);
        let stream = match &mut *stream {
            // The frame comes later or is the last one that came.
            Some(open) if open.video == video && open.next <= frame + 1 => open,
            other => other.insert(FrameStream::start(video, path)?),
        };
        stream.frame(frame, *frames, path, cancelled)
    }
}

/// A video that is being decoded.
struct FrameStream {
    video: usize,
    /// The frame that comes next.
    next: usize,
    /// The frame before it, for a recording that shows a frame several times.
    last: Option<Frame>,
    /// `None` after the end.
    output: Option<ProgramOutput>,
    /// Why no more frames come.
    fault: String,
}

impl FrameStream {
    /// Errors: `Program`.
    fn start(video: usize, path: &Path) -> Result<Self, ImportError> {
        let mut command = Command::new("ffmpeg");
        command
            .args(["-v", "error", "-nostdin", "-xerror"])
            .args(ALLOWED)
            .arg("-i");
        command.arg(argument(path));
        // Each frame comes as a PGM image, which states its size.
        command.args(["-map", "0:v:0", "-fps_mode", "passthrough", "-pix_fmt", "gray"]);
        command.args(["-c:v", "pgm", "-f", "image2pipe", "pipe:1"]);
        let output = ProgramOutput::start(&mut command).map_err(|error| failure("ffmpeg", path, error))?;
        Ok(Self {
            video,
            next: 0,
            last: None,
            output: Some(output),
            fault: String::new(),
        })
    }

    /// Frame `wanted`, which is the last one or comes later, of a video that announced `frames` frames. Errors: `Record`, `Program`,
    /// `Stopped`.
    fn frame(
        &mut self,
        wanted: usize,
        frames: usize,
        path: &Path,
        cancelled: &AtomicBool,
    ) -> Result<Frame, ImportError> {
        while self.next <= wanted {
            let Some(output) = &mut self.output else {
                return Err(ImportError::record(place(path, wanted), &self.fault));
            };
            let ended = match read_pgm(output, cancelled) {
                Ok(Some(frame)) => {
                    (self.next, self.last) = (self.next + 1, Some(frame));
                    continue;
                }
                Ok(None) => Ok(()),
                Err(error) => Err(error),
            };
            let output = self.output.take();
            self.fault = match ended.and_then(|()| output.map_or(Ok(String::new()), |output| output.finish(cancelled)))
            {
                Err(ProgramError::Cancelled) => return Err(ImportError::Stopped),
                Err(error) => format!("ffmpeg cannot read the video: {}", without_sender(&error.to_string())),
                Ok(_) => format!("the video ends here; it announces {frames} frames"),
            };
            return Err(ImportError::record(place(path, self.next), &self.fault));
        }
        Ok(self
            .last
            .clone()
            .expect("a video at a frame before its first one is a bug"))
    }
}

/// Reads an image `P5 WIDTH HEIGHT 255` with its pixels; `None` at the end of the output. Errors: `Failed`, `Cancelled`.
fn read_pgm(output: &mut ProgramOutput, cancelled: &AtomicBool) -> Result<Option<Frame>, ProgramError> {
    let wrong = |what: &str| ProgramError::Failed(format!("its output is no PGM image: {what}"));
    let Some(magic) = output.line(cancelled)? else {
        return Ok(None);
    };
    let mut header = || Ok::<_, ProgramError>(output.line(cancelled)?.unwrap_or_default());
    let (size, maximum) = (header()?, header()?);
    let sides = size.split_once(' ');
    let sides = sides.and_then(|(width, height)| Some((width.parse::<u32>().ok()?, height.parse::<u32>().ok()?)));
    let (Some((width, height)), "P5", "255") = (sides, magic.as_str(), maximum.as_str()) else {
        return Err(wrong("its header is not P5, two sides and 255"));
    };
    if width.max(height) > MAX_SIDE_PX {
        return Err(ProgramError::Failed(format!(
            "its frames are {width}×{height} px; each side may be {MAX_SIDE_PX} px at most"
        )));
    }
    let mut pixels = vec![0; width as usize * height as usize];
    if output.read(&mut pixels, cancelled)? < pixels.len() {
        return Err(wrong("it was cut off"));
    }
    Frame::new(width, height, pixels)
        .map(Some)
        .map_err(|error| wrong(&error.to_string()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_repeated_frame_does_not_start_the_video_again() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("walk.mkv");
        let mut command = Command::new("ffmpeg");
        command.args(["-v", "error", "-f", "lavfi", "-i", "testsrc=size=16x12:rate=5"]);
        let Ok(status) = command.args(["-frames:v", "3", "-c:v", "mpeg4"]).arg(&path).status() else {
            eprintln!("skipped: ffmpeg is not installed");
            return;
        };
        assert!(status.success());
        let places = [0, 0, 1, 1, 2, 2].map(|frame| (0, frame));
        let frames = VideoFrames::new(vec![(path.clone(), 3)], places.to_vec());
        let read = |images: std::ops::Range<usize>| -> Vec<Vec<u8>> {
            let of = |image| Record {
                image,
                ..Record::default()
            };
            let records: Vec<Record> = images.map(of).collect();
            let wanted: Vec<&Record> = records.iter().collect();
            let whole: ResizeImage<'_> = &|frame, _| Ok(frame.clone());
            let read = frames.read_all(&wanted, whole, &AtomicBool::new(false));
            read.into_iter().map(|frame| frame.unwrap().pixels().to_vec()).collect()
        };
        let mut all = read(0..1);
        // Starting it again would fail.
        std::fs::remove_file(&path).unwrap();
        all.extend(read(1..6));
        assert!(all[0] == all[1] && all[2] == all[3] && all[4] == all[5]);
        assert!(all[1] != all[2] && all[3] != all[4]);
    }
}
