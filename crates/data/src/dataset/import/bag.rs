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
mod mcap;
mod messages;
mod pixels;
mod rosbag2;
#[cfg(feature = "databases")]
mod sqlite;

use std::path::Path;
use std::sync::atomic::AtomicBool;

use self::index::{BagIndex, Content, Position};
use self::mcap::McapFile;
use self::messages::RosType;
#[cfg(feature = "databases")]
use self::sqlite::SqliteFile;
use super::files::{extension, stem};
use super::recording::{ImageSource, Recording, WantedImage};
use super::{ImportError, ImportOptions};
use foreframe_core::frame::{Frame, codec};

/// Whether a source is a bag: a file, or a directory of rosbag2.
pub(super) fn is_bag(source: &Path) -> bool {
    rosbag2::is_bag(source)
}

/// The images of a bag, by their position in its files.
struct BagImages {
    files: Vec<BagFile>,
    /// File and position of each.
    positions: Vec<(usize, Position)>,
    kind: RosType,
}

/// A file of messages.
enum BagFile {
    Mcap(McapFile),
    #[cfg(feature = "databases")]
    Sqlite(SqliteFile),
}

impl BagFile {
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

    fn open(path: &Path) -> Result<Self, ImportError> {
        match extension(path).as_str() {
            #[cfg(feature = "databases")]
            "db3" => SqliteFile::open(path).map(Self::Sqlite),
            _ => McapFile::open(path).map(Self::Mcap),
        }
    }

    fn message(&self, position: Position) -> Result<Vec<u8>, ImportError> {
        match self {
            Self::Mcap(file) => file.message(position),
            #[cfg(feature = "databases")]
            Self::Sqlite(file) => file.message(position),
        }
    }
}

/// Reads everything of a bag but its pixels. Errors: `Option`, `Io`, `Record`, `Stopped`.
pub(super) fn open(source: &Path, options: &ImportOptions, cancelled: &AtomicBool) -> Result<Recording, ImportError> {
    let mut index = BagIndex::new(source, options, cancelled);
    let paths = rosbag2::files(source)?;
    for path in &paths {
        index.file(path.clone());
        BagFile::scan(path, &mut index)?;
    }
    let chosen = choice::choose(&index, options)?;
    let used = chosen.actions.iter().chain(&chosen.states).map(|values| values.topic);
    let used: Vec<usize> = [chosen.image].into_iter().chain(used).collect();
    let mut skipped = std::mem::take(&mut index.skipped);
    for topic in used {
        let faults = std::mem::take(&mut index.topics[topic].faults);
        match faults.first().filter(|_| !options.skip_bad) {
            Some(fault) => return Err(ImportError::record(&fault.place, &fault.reason)),
            None => skipped.append(faults),
        }
    }
    let joined = join::join(&index, &chosen)?;
    skipped.append(joined.skipped);
    let topic = &index.topics[chosen.image];
    let positions = match &topic.content {
        Content::Images(entries) => joined
            .images
            .iter()
            .map(|&image| (entries[image].file, entries[image].position)),
        _ => return Err(ImportError::Option(format!("{} holds no images", topic.name))),
    };
    let channels = |values: &[choice::ChosenValues]| values.iter().flat_map(|values| values.channels.clone()).collect();
    let images = BagImages {
        files: paths.iter().map(|path| BagFile::open(path)).collect::<Result<_, _>>()?,
        positions: positions.collect(),
        kind: topic.kind,
    };
    let camera = chosen.projection.as_ref();
    Ok(Recording {
        action_channels: channels(&chosen.actions),
        state_channels: channels(&chosen.states),
        camera: camera.and_then(|projection| camera::model(projection, &topic.name, options)),
        skipped,
        ..Recording::of_images(stem(source, "bag"), joined.records, images)
    })
}

impl ImageSource for BagImages {
    fn read(&self, wanted: &WantedImage<'_>, _cancelled: &AtomicBool) -> Result<Frame, ImportError> {
        let WantedImage { image, place } = *wanted;
        let (file, position) = self.positions[image];
        let message = self.files[file].message(position)?;
        let wrong = |error: &dyn std::fmt::Display| ImportError::record(place, error.to_string());
        let message = compression::message(&message).map_err(|error| wrong(&error))?;
        if self.kind == RosType::Image {
            let (_, image) = messages::image(&message).map_err(|error| wrong(&error))?;
            return image.gray().map_err(|error| wrong(&error));
        }
        let (_, _, bytes) = messages::compressed_image(&message).map_err(|error| wrong(&error))?;
        codec::decode(bytes).map_err(ImportError::image(place, "its image"))
    }
}
