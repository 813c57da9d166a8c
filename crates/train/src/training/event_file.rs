//! Event files as `TensorBoard` reads them, in a run's directory: scalars and pictures, each at a step of a stage.

mod message;
mod record;

use std::fs::{self, File};
use std::io::{ErrorKind, Write as _};
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

use self::message::{EventMessage, SummaryValue};
use super::TrainError;
use super::checkpoint::{CheckpointPosition, io_failed};
use super::observer::TrainingStage;
use foreframe_core::files::write_atomically;
use foreframe_core::frame::{Frame, codec};

/// By this, `TensorBoard` knows its files; the time in seconds since 1970 follows, so that their names are in the order of time.
const NAME: &str = "events.out.tfevents.";

/// A file to which events are appended.
pub(super) struct EventFile {
    path: PathBuf,
    file: File,
}

impl EventFile {
    /// A new file for a training that goes on after `reached`. What earlier files hold of later steps is removed from them, since
    /// these steps are made again. Errors: `Io`.
    pub(super) fn open(run_dir: &Path, reached: CheckpointPosition) -> Result<Self, TrainError> {
        for path in event_files(run_dir)? {
            keep_until(&path, reached)?;
        }
        let (path, file) = create(run_dir)?;
        let mut made = Self { path, file };
        made.append(&EventMessage::version(unix_s()))?;
        Ok(made)
    }

    /// Adds numbers, each under a name. Errors: `Io`.
    pub(super) fn scalars(
        &mut self,
        stage: TrainingStage,
        step: usize,
        values: &[(&str, f64)],
    ) -> Result<(), TrainError> {
        let values = values
            .iter()
            .map(|(name, value)| SummaryValue::scalar(&tag(stage, name), *value));
        self.append(&EventMessage::summary(unix_s(), step, values))
    }

    /// Adds a picture. Errors: `Io`, `Frame`.
    pub(super) fn picture(
        &mut self,
        stage: TrainingStage,
        step: usize,
        name: &str,
        picture: &Frame,
    ) -> Result<(), TrainError> {
        let png = codec::encode_png(picture)?;
        let value = SummaryValue::png(&tag(stage, name), picture.width(), picture.height(), &png);
        self.append(&EventMessage::summary(unix_s(), step, [value]))
    }

    /// Writes an event at once, so that a reader sees it and a killed process loses nothing.
    fn append(&mut self, event: &EventMessage) -> Result<(), TrainError> {
        let record = record::framed(event.bytes());
        self.file.write_all(&record).map_err(io_failed("write", &self.path))
    }
}

/// The name of a curve: the losses of the stages measure different things.
fn tag(stage: TrainingStage, name: &str) -> String {
    format!("{stage}/{name}")
}

/// The position of an event; `None` if it belongs to no stage.
fn position(event: &EventMessage) -> Option<CheckpointPosition> {
    let (stage, _) = event.tag()?.split_once('/')?;
    let stage = [TrainingStage::Pretrain, TrainingStage::Sequence]
        .into_iter()
        .find(|known| known.to_string() == stage)?;
    let step = event.step()?;
    Some(CheckpointPosition { stage, step })
}

/// Removes the events after a position, and a record that was not written to its end.
fn keep_until(path: &Path, reached: CheckpointPosition) -> Result<(), TrainError> {
    let bytes = fs::read(path).map_err(io_failed("read", path))?;
    let events = record::contents(&bytes).map(EventMessage::of_bytes);
    let kept: Vec<EventMessage> = events
        .filter(|event| position(event).is_none_or(|at| at <= reached))
        .collect();
    if kept.iter().all(|event| position(event).is_none()) {
        return fs::remove_file(path).map_err(io_failed("delete", path));
    }
    let kept: Vec<u8> = kept.iter().flat_map(|event| record::framed(event.bytes())).collect();
    if kept == bytes {
        return Ok(());
    }
    write_atomically(path, &kept).map_err(io_failed("write", path))
}

/// The event files of a run, the oldest first. Errors: `Io`.
fn event_files(run_dir: &Path) -> Result<Vec<PathBuf>, TrainError> {
    let failed = || io_failed("read", run_dir);
    let mut paths = Vec::new();
    for entry in fs::read_dir(run_dir).map_err(failed())? {
        let path = entry.map_err(failed())?.path();
        if path
            .file_name()
            .is_some_and(|name| name.as_encoded_bytes().starts_with(NAME.as_bytes()))
        {
            paths.push(path);
        }
    }
    paths.sort();
    Ok(paths)
}

/// A new file, whose name comes after those of the others. Errors: `Io`.
fn create(run_dir: &Path) -> Result<(PathBuf, File), TrainError> {
    let now_s = unix_s() as u64;
    // A training that was stopped and resumed within a second has taken the first name.
    for number in 0..=u32::MAX {
        let path = run_dir.join(format!("{NAME}{now_s:010}.foreframe.{number:03}"));
        match File::create_new(&path) {
            Ok(file) => return Ok((path, file)),
            Err(error) if error.kind() == ErrorKind::AlreadyExists => {}
            Err(error) => return Err(io_failed("write", &path)(error)),
        }
    }
    Err(io_failed("write", run_dir)(ErrorKind::AlreadyExists.into()))
}

/// The time that `TensorBoard` shows; nothing else depends on it.
fn unix_s() -> f64 {
    let since_1970 = SystemTime::now().duration_since(UNIX_EPOCH);
    // A clock before 1970 gives 0.
    since_1970.map_or(0.0, |time| time.as_secs_f64())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(stage: TrainingStage, step: usize) -> CheckpointPosition {
        CheckpointPosition { stage, step }
    }

    /// The tags and steps of all files, in their order.
    fn written(run_dir: &Path) -> Vec<(String, usize)> {
        let bytes = event_files(run_dir)
            .unwrap()
            .into_iter()
            .map(|path| fs::read(path).unwrap());
        let bytes: Vec<_> = bytes.collect();
        let events = bytes
            .iter()
            .flat_map(|bytes| record::contents(bytes))
            .map(EventMessage::of_bytes);
        let tagged = events.filter_map(|event| Some((event.tag()?.to_owned(), event.step()?)));
        tagged.collect()
    }

    #[test]
    fn a_resumed_training_repeats_no_step() {
        let dir = tempfile::tempdir().unwrap();
        let (codec, network) = (TrainingStage::Pretrain, TrainingStage::Sequence);
        let mut first = EventFile::open(dir.path(), at(codec, 0)).unwrap();
        for step in [100, 200] {
            first.scalars(codec, step, &[("loss", 0.5)]).unwrap();
        }
        for step in [50, 100, 150] {
            first
                .scalars(network, step, &[("loss", 0.25), ("learning rate", 1e-3)])
                .unwrap();
        }
        let picture = Frame::new(4, 2, vec![9; 8]).unwrap();
        first.picture(network, 150, "prediction", &picture).unwrap();
        // The process was killed while it wrote.
        first.file.write_all(&[7; 5]).unwrap();
        let mut second = EventFile::open(dir.path(), at(network, 100)).unwrap();
        second.scalars(network, 150, &[("loss", 0.2)]).unwrap();
        let expected = [
            ("pretrain/loss", 100),
            ("pretrain/loss", 200),
            ("sequence/loss", 50),
            ("sequence/loss", 100),
            ("sequence/loss", 150),
        ];
        assert_eq!(written(dir.path()), expected.map(|(tag, step)| (tag.to_owned(), step)));
        assert_eq!(event_files(dir.path()).unwrap().len(), 2);
        EventFile::open(dir.path(), at(codec, 0)).unwrap();
        assert_eq!(written(dir.path()), []);
        assert_eq!(
            event_files(dir.path()).unwrap().len(),
            1,
            "files without events are deleted"
        );
    }
}
