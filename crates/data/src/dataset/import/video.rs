//! Video files, decoded by the programs `ffmpeg` and `ffprobe`. Frames are decoded when they are needed, one after the other;
//! none is written to a file.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::atomic::AtomicBool;
use std::sync::{Mutex, PoisonError};

use rayon::prelude::*;

use super::files::stem;
use super::recording::{ImageSource, Record, Recording, ResizeImage, WantedImage};
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
    let ListedFrames { times_s, damage } = frames_of(video, cancelled)?;
    let mut skipped = SkippedList::default();
    if let Some(damage) = damage {
        damage.leave_out(options.skip_bad, &mut skipped)?;
    }
    let record = |(index, &timestamp_s): (usize, &f64)| Record {
        timestamp_s,
        image: index,
        place: format!("{} frame {index}", video.display()),
        ..Record::default()
    };
    let records = times_s.iter().enumerate().map(record).collect();
    let places = (0..times_s.len()).map(|frame| (0, frame)).collect();
    let images = VideoFrames::new(vec![(video.to_owned(), times_s.len())], places);
    Ok(Recording {
        skipped,
        ..Recording::of_images(stem(video, "video"), records, images)
    })
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
    let mut times_s = Vec::new();
    let complaint = probe(
        video,
        "frame=pts_time,best_effort_timestamp_time",
        cancelled,
        |fields| {
            let time = number(fields, "pts_time").or_else(|| number(fields, "best_effort_timestamp_time"));
            let place = || format!("{} frame {}", video.display(), times_s.len());
            times_s.push(time.ok_or_else(|| ImportError::record(place(), "the frame has no time"))?);
            Ok(())
        },
    )?;
    if times_s.is_empty() {
        return Err(ImportError::record(
            video.display().to_string(),
            "it holds no video stream",
        ));
    }
    let damage = (!complaint.is_empty()).then(|| {
        let (count, complaint) = (times_s.len(), without_sender(&complaint));
        let reason = format!("the video is damaged; {count} frames can be read: {complaint}");
        ImportError::record(video.display().to_string(), reason)
    });
    Ok(ListedFrames { times_s, damage })
}

/// Passes each entry of the first video stream on, as `name=value|name=value`. Returns what ffprobe says is wrong with the video.
fn probe(
    video: &Path,
    entries: &str,
    cancelled: &AtomicBool,
    mut take: impl FnMut(&str) -> Result<(), ImportError>,
) -> Result<String, ImportError> {
    let failed = |error| failure("ffprobe", video, error);
    let mut command = Command::new("ffprobe");
    command.args(ALLOWED).args(["-v", "error", "-select_streams", "v:0"]);
    command.args(["-of", "compact=print_section=0", "-show_entries", entries]);
    let mut output = ProgramOutput::start(command.arg(argument(video))).map_err(failed)?;
    while let Some(line) = output.line(cancelled).map_err(failed)? {
        if !line.is_empty() {
            take(&line)?;
        }
    }
    output.finish(cancelled).map_err(failed)
}

/// A number among the fields of an entry.
fn number(fields: &str, name: &str) -> Option<f64> {
    let mut fields = fields.split('|').filter_map(|field| field.split_once('='));
    let (_, value) = fields.find(|(found, _)| *found == name)?;
    value.parse().ok().filter(|value: &f64| value.is_finite())
}

/// A path that ffmpeg cannot take for an option or a protocol.
fn argument(video: &Path) -> PathBuf {
    if video.is_absolute() {
        video.to_owned()
    } else {
        Path::new(".").join(video)
    }
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
        ProgramError::Failed(reason) => ImportError::record(
            video.display().to_string(),
            format!("{program} cannot read the video: {}", without_sender(&reason)),
        ),
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
        wanted: &[WantedImage<'_>],
        resize: ResizeImage<'_>,
        cancelled: &AtomicBool,
    ) -> Vec<Result<Frame, ImportError>> {
        let mut resized = Vec::with_capacity(wanted.len());
        for some in wanted.chunks(DECODED_FRAMES) {
            let decoded: Vec<_> = some.iter().map(|wanted| self.read(wanted, cancelled)).collect();
            let resize =
                |(decoded, wanted): (Result<Frame, ImportError>, &WantedImage<'_>)| resize(&decoded?, wanted.place);
            resized.par_extend(decoded.into_par_iter().zip(some).map(resize));
        }
        resized
    }

    fn read(&self, wanted: &WantedImage<'_>, cancelled: &AtomicBool) -> Result<Frame, ImportError> {
        let (video, frame) = self.places[wanted.image];
        let (path, frames) = &self.videos[video];
        let mut stream = self.stream.lock().unwrap_or_else(PoisonError::into_inner);
        let stream = match &mut *stream {
            Some(open) if open.video == video && open.can_give(frame) => open,
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

    /// Whether a frame is the last one or has not come yet.
    fn can_give(&self, frame: usize) -> bool {
        self.next <= frame || (self.next == frame + 1 && self.last.is_some())
    }

    /// Frame `wanted`, which can be given, of a video that announced `frames` frames. Errors: `Record`, `Program`, `Stopped`.
    fn frame(
        &mut self,
        wanted: usize,
        frames: usize,
        path: &Path,
        cancelled: &AtomicBool,
    ) -> Result<Frame, ImportError> {
        if let Some(last) = self.last.as_ref().filter(|_| wanted < self.next) {
            return Ok(last.clone());
        }
        let Some(output) = &mut self.output else {
            return Err(ImportError::record(
                format!("{} frame {wanted}", path.display()),
                &self.fault,
            ));
        };
        loop {
            match read_pgm(output, cancelled) {
                Ok(Some(frame)) => {
                    self.next += 1;
                    if self.next > wanted {
                        self.last = Some(frame.clone());
                        return Ok(frame);
                    }
                }
                Err(ProgramError::Cancelled) => return Err(ImportError::Stopped),
                ended => {
                    let result = match (ended, self.output.take()) {
                        (Ok(_), Some(output)) => output.finish(cancelled).map(drop),
                        (ended, _) => ended.map(drop),
                    };
                    self.fault = match result {
                        Err(ProgramError::Cancelled) => return Err(ImportError::Stopped),
                        Err(error) => format!("ffmpeg cannot read the video: {}", without_sender(&error.to_string())),
                        Ok(()) => format!("the video ends here; it announces {frames} frames"),
                    };
                    let place = format!("{} frame {}", path.display(), self.next);
                    return Err(ImportError::record(place, &self.fault));
                }
            }
        }
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
            let wanted: Vec<_> = images.map(|image| WantedImage { image, place: "" }).collect();
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
