//! The records of a recording before they are brought to one frame rate.

use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

use rayon::prelude::*;

use super::error::ImportError;
use super::skipped::SkippedList;
use foreframe_core::frame::Frame;
use foreframe_core::frame::warp::CameraModel;
use foreframe_core::types::Channel;

/// One recorded image with its time, action and state.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Record {
    pub(super) timestamp_s: f64,
    /// Records of different sessions are never in one episode.
    pub(super) session: String,
    /// Whether something was left out just before it, so that it begins an episode.
    pub(super) begins_episode: bool,
    pub(super) action: Vec<f32>,
    pub(super) state: Vec<f32>,
    /// Which of [`Recording::images`] it is; [`Recording::new`] sets it.
    pub(super) image: usize,
    /// File and line, frame or position, for messages.
    pub(super) place: String,
}

/// Whether two records can be in one episode: nothing between them was left out.
pub(super) fn is_next(before: &Record, now: &Record) -> bool {
    before.session == now.session && !now.begins_episode
}

/// Whether any two records can be in one episode.
pub(super) fn any_follow(records: &[Record]) -> bool {
    records.windows(2).any(|pair| is_next(&pair[0], &pair[1]))
}

/// Everything that a source holds, in the order of time.
pub(super) struct Recording {
    pub(super) name: String,
    pub(super) action_channels: Vec<Channel>,
    pub(super) state_channels: Vec<Channel>,
    /// How the camera projects the resized images, where the source says it.
    pub(super) camera: Option<CameraModel>,
    pub(super) records: Vec<Record>,
    pub(super) images: Box<dyn ImageSource>,
    pub(super) skipped: SkippedList,
    /// What is there but was not asked for, in sentences for the user.
    pub(super) notes: Vec<String>,
}

impl Recording {
    /// Images without actions and states, one for each record.
    pub(super) fn new(name: String, mut records: Vec<Record>, images: impl ImageSource + 'static) -> Self {
        for (image, record) in records.iter_mut().enumerate() {
            record.image = image;
        }
        Self {
            name,
            action_channels: Vec::new(),
            state_channels: Vec::new(),
            camera: None,
            records,
            images: Box::new(images),
            skipped: SkippedList::default(),
            notes: Vec::new(),
        }
    }
}

/// Where the images of a recording are.
pub(super) trait ImageSource: Send + Sync {
    /// Decodes the images of records as gray and passes each to `resize`, in parallel. They are wanted in the order of the recording. Errors, for
    /// each image: `Image`, `Io`, `Record`, `Program`, `Stopped`, and those of `resize`.
    fn read_all(
        &self,
        wanted: &[&Record],
        resize: ResizeImage<'_>,
        cancelled: &AtomicBool,
    ) -> Vec<Result<Frame, ImportError>> {
        let resized = |wanted: &&Record| {
            if cancelled.load(Ordering::Relaxed) {
                return Err(ImportError::Stopped);
            }
            resize(&self.read(wanted, cancelled)?, &wanted.place)
        };
        wanted.par_iter().map(resized).collect()
    }

    /// The file of an image that has one of its own.
    fn file(&self, _wanted: &Record) -> Option<&Path> {
        None
    }

    /// Decodes one image as gray. Errors: as [`Self::read_all`].
    fn read(&self, wanted: &Record, cancelled: &AtomicBool) -> Result<Frame, ImportError>;
}

/// Resizes an image; the second argument is its place.
pub(super) type ResizeImage<'a> = &'a (dyn Fn(&Frame, &str) -> Result<Frame, ImportError> + Sync);

/// Seconds per unit of a time column, by its name's ending.
pub(super) fn seconds_per_unit(name: &str) -> f64 {
    let mut units = [("_ms", 1e-3), ("_us", 1e-6), ("_ns", 1e-9)].into_iter();
    units
        .find(|(ending, _)| name.ends_with(ending))
        .map_or(1.0, |(_, unit_s)| unit_s)
}
