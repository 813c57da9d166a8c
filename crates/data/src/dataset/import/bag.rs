//! Bags of ROS 2: MCAP files, and what `ros2 bag record` writes.
//!
//! One pass over the bag's files (`rosbag2`, `mcap`, `sqlite` with `database`) notes where the images are and the values of
//! everything else (`index`, with `messages`, `cdr` and `pixels`); `choice` picks the topics, `join` gives each image its action
//! and state. The images themselves are read later, one by one.

mod camera;
mod cdr;
mod choice;
mod compression;
#[cfg(feature = "databases")]
mod database;
mod index;
mod join;
mod json;
pub mod live;
mod mcap;
mod messages;
mod pixels;
mod rosbag2;
#[cfg(feature = "databases")]
mod sqlite;

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use self::choice::ChosenValues;
use self::index::{BagIndex, MessageFile, Position};
use self::messages::RosType;
use super::files::{extension, stem};
use super::recording::{ImageSource, Record, Recording};
use super::{ImportError, ImportOptions};
use foreframe_core::frame::{Frame, codec};

/// Whether a source is a bag: a file, or a directory of rosbag2.
pub(super) fn is_bag(source: &Path) -> bool {
    rosbag2::is_bag(source)
}

/// The images of a bag, by their position in its files.
struct BagImages {
    files: Vec<Arc<dyn MessageFile>>,
    /// File and position of each.
    positions: Vec<(usize, Position)>,
    kind: RosType,
}

/// Passes every message of a file to the index.
fn scan(path: &Path, index: &mut BagIndex<'_>) -> Result<(), ImportError> {
    match extension(path).as_str() {
        #[cfg(feature = "databases")]
        "db3" => sqlite::scan(path, index),
        #[cfg(not(feature = "databases"))]
        "db3" => Err(ImportError::Option(format!(
            "{} is an SQLite database, which is read with the feature \"server\" only",
            path.display()
        ))),
        _ => mcap::scan(path, index),
    }
}

/// Reads everything of a bag but its pixels. Errors: `Option`, `Io`, `Record`, `Stopped`.
pub(super) fn open(source: &Path, options: &ImportOptions, cancelled: &AtomicBool) -> Result<Recording, ImportError> {
    let mut index = BagIndex::new(source, options, cancelled);
    for path in rosbag2::files(source)? {
        scan(&path, &mut index)?;
    }
    let mut skipped = std::mem::take(&mut index.skipped);
    let chosen = choice::choose(&index, options)?;
    let mut used = vec![chosen.image];
    used.extend(chosen.actions.iter().chain(&chosen.states).map(|values| values.topic));
    for (position, topic) in used.iter().enumerate() {
        if used[..position].iter().any(|earlier| std::ptr::eq(*earlier, *topic)) {
            continue;
        }
        if let Some(fault) = topic.faults.first().filter(|_| !options.skip_bad) {
            return Err(ImportError::record(&fault.place, &fault.reason));
        }
        skipped.append(topic.faults.clone());
    }
    let joined = join::join(&index, &chosen)?;
    skipped.append(joined.skipped);
    let channels = |values: &[ChosenValues<'_>]| values.iter().flat_map(|values| values.channels.clone()).collect();
    let camera = |projection| camera::model(projection, &chosen.image.name, options);
    let kind = chosen.image.kind;
    Ok(Recording {
        action_channels: channels(&chosen.actions),
        state_channels: channels(&chosen.states),
        camera: chosen.projection.and_then(camera),
        skipped,
        ..Recording::new(
            stem(source, "bag"),
            joined.records,
            BagImages {
                files: index.files,
                positions: joined.positions,
                kind,
            },
        )
    })
}

impl ImageSource for BagImages {
    fn read(&self, wanted: &Record, _cancelled: &AtomicBool) -> Result<Frame, ImportError> {
        let Record { image, place, .. } = wanted;
        let (file, position) = self.positions[*image];
        let message = self.files[file].message(position)?;
        let wrong = |reason: String| ImportError::record(place, reason);
        let message = compression::message(&message).map_err(wrong)?;
        if self.kind == RosType::Image {
            let (_, image) = messages::image(&message).map_err(wrong)?;
            return image.gray().map_err(wrong);
        }
        let (_, _, bytes) = messages::compressed_image(&message).map_err(wrong)?;
        codec::decode(bytes).map_err(ImportError::image(place, "its image"))
    }
}
