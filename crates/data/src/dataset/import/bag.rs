//! Bags of ROS 2: MCAP files, and what `ros2 bag record` writes.
//!
//! One pass over the bag's files (`rosbag2`, `mcap`, `sqlite` with `database`) collects where the images are and the values of
//! everything else (`collector`, with `messages`, `cdr` and `pixels`); `choice` picks the topics, `join` gives each image its action
//! and state. The images themselves are read later, one by one.

mod camera;
mod cdr;
mod choice;
mod collector;
mod compression;
#[cfg(feature = "databases")]
mod database;
mod join;
mod mcap;
mod messages;
mod pixels;
mod rosbag2;
#[cfg(feature = "databases")]
mod sqlite;

use std::path::Path;
use std::sync::atomic::AtomicBool;

use self::collector::{Collector, Content, Position};
use self::mcap::McapFile;
use self::messages::RosType;
#[cfg(feature = "databases")]
use self::sqlite::SqliteFile;
use super::recording::{Images, Recording};
use super::{ImportError, ImportOptions, extension};
use foreframe_core::frame::{Frame, codec};

/// Whether a source is a bag: a file, or a directory of rosbag2.
pub(super) fn is_bag(source: &Path) -> bool {
    rosbag2::is_bag(source)
}

/// The images of a bag, by their position in its files.
pub(super) struct BagImages {
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
    fn scan(path: &Path, collector: &mut Collector<'_>) -> Result<(), ImportError> {
        match extension(path).as_str() {
            #[cfg(feature = "databases")]
            "db3" => sqlite::scan(path, collector),
            #[cfg(not(feature = "databases"))]
            "db3" => Err(ImportError::Option(format!(
                "{} is an SQLite database, which is read with the feature \"server\" only",
                path.display()
            ))),
            _ => mcap::scan(path, collector),
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
    let mut collector = Collector::new(source, options, cancelled);
    let paths = rosbag2::files(source)?;
    for path in &paths {
        collector.file(path.clone());
        BagFile::scan(path, &mut collector)?;
    }
    let chosen = choice::choose(&collector, options)?;
    let used = chosen.actions.iter().chain(&chosen.states).map(|values| values.topic);
    let used: Vec<usize> = [chosen.image].into_iter().chain(used).collect();
    let mut skipped = std::mem::take(&mut collector.skipped);
    for topic in used {
        let faults = std::mem::take(&mut collector.topics[topic].faults);
        match faults.first().filter(|_| !options.skip_bad) {
            Some(fault) => return Err(ImportError::record(&fault.place, &fault.reason)),
            None => skipped.append(faults),
        }
    }
    let joined = join::join(&collector, &chosen)?;
    skipped.append(joined.skipped);
    let topic = &collector.topics[chosen.image];
    let positions = match &topic.content {
        Content::Images(entries) => joined
            .images
            .iter()
            .map(|&image| (entries[image].file, entries[image].position)),
        _ => return Err(ImportError::Option(format!("{} holds no images", topic.name))),
    };
    let channels = |values: &[choice::ChosenValues]| values.iter().flat_map(|values| values.channels.clone()).collect();
    Ok(Recording {
        name: source
            .file_stem()
            .map_or_else(|| "bag".to_owned(), |name| name.to_string_lossy().into_owned()),
        action_channels: channels(&chosen.actions),
        state_channels: channels(&chosen.states),
        camera: chosen
            .projection
            .and_then(|projection| camera::model(&projection, &topic.name, options)),
        records: joined.records,
        images: Images::Bag(BagImages {
            files: paths.iter().map(|path| BagFile::open(path)).collect::<Result<_, _>>()?,
            positions: positions.collect(),
            kind: topic.kind,
        }),
        skipped,
    })
}

impl BagImages {
    /// Reads an image in gray. Errors: `Io`, `Record`, `Image`.
    pub(super) fn read(&self, image: usize, place: &str) -> Result<Frame, ImportError> {
        let (file, position) = self.positions[image];
        let message = self.files[file].message(position)?;
        let wrong = |error: &dyn std::fmt::Display| ImportError::record(place, error.to_string());
        let message = compression::message(&message).map_err(|error| wrong(&error))?;
        if self.kind == RosType::Image {
            let (_, image) = messages::image(&message).map_err(|error| wrong(&error))?;
            return image.gray().map_err(|error| wrong(&error));
        }
        let (_, _, bytes) = messages::compressed_image(&message).map_err(|error| wrong(&error))?;
        codec::decode(bytes).map_err(|source| ImportError::Image {
            place: place.to_owned(),
            path: "its image".into(),
            source,
        })
    }
}
