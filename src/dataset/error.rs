//! Why a data set was refused.

use std::path::PathBuf;

use crate::frame::FrameError;
use crate::sim::SimError;

/// Why a data set could not be made, read or sampled: what was wrong and what would be right.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum DatasetError {
    /// The parts of an episode don't hold the same number of frames.
    #[error("episode {episode}: {part} has {found} values; {frames} frames take {expected}")]
    PartLength {
        /// Position of the episode.
        episode: usize,
        /// `pixels`, `mask`, `action` or `state`.
        part: &'static str,
        /// Frames of the episode, one for each timestamp.
        frames: usize,
        /// Values found.
        found: usize,
        /// Values needed.
        expected: usize,
    },
    /// An action, state or timestamp was NaN or infinite.
    #[error("episode {episode}, frame {frame}: {part} is {value}; every number must be finite")]
    NotFinite {
        /// Position of the episode.
        episode: usize,
        /// Frame within the episode.
        frame: usize,
        /// `action`, `state` or `timestamp`.
        part: &'static str,
        /// The value found.
        value: f64,
    },
    /// Time stands still or runs back within an episode.
    #[error("episode {episode}, frame {frame}: its timestamp is not after the one before; timestamps must grow")]
    TimeOrder {
        /// Position of the episode.
        episode: usize,
        /// Frame within the episode.
        frame: usize,
    },
    /// Some episodes have masks and others not.
    #[error("episode {episode}: masks must be there for every episode or for none")]
    MixedMasks {
        /// Position of the first episode that differs.
        episode: usize,
    },
    /// No frames at all.
    #[error("the data set \"{name}\" has no frames; at least one episode with one frame is needed")]
    Empty {
        /// The data set's name.
        name: String,
    },
    /// The description of the data set can't be right.
    #[error("{0}")]
    Description(String),
    /// Its frames have another size than what uses them.
    #[error("the data set \"{name}\" has frames of {width}×{height} px; {wanted_width}×{wanted_height} px are needed")]
    FrameSize {
        /// The data set's name.
        name: String,
        /// Width in pixels.
        width: u32,
        /// Height in pixels.
        height: u32,
        /// Width needed.
        wanted_width: u32,
        /// Height needed.
        wanted_height: u32,
    },
    /// Its actions or states have another number of components than what uses them.
    #[error("the data set \"{name}\" has {kind}s of {found} components ({names}); {wanted} are needed")]
    Channels {
        /// The data set's name.
        name: String,
        /// `action` or `state`.
        kind: &'static str,
        /// Components there are.
        found: usize,
        /// Their names and units.
        names: String,
        /// Components needed.
        wanted: usize,
    },
    /// A window or stride of no frames.
    #[error("{what} is 0; it must be at least 1")]
    Zero {
        /// The value, as the user knows it.
        what: &'static str,
    },
    /// No episode is long enough.
    #[error(
        "a window of {window} frames ({context} seen, {horizon} to come) is longer than every episode of the {split} \
         split; the longest runs {longest} frames without a gap"
    )]
    WindowTooLong {
        /// Frames of the window.
        window: usize,
        /// Frames seen.
        context: usize,
        /// Frames to come.
        horizon: usize,
        /// The split asked for.
        split: &'static str,
        /// The longest stretch in it.
        longest: usize,
    },
    /// Fewer windows than asked for.
    #[error(
        "data.windows is {asked}, but the {split} split has only {available}; ask for fewer (data.windows=all takes what there is) or collect more"
    )]
    TooFewWindows {
        /// Windows asked for.
        asked: usize,
        /// The split asked.
        split: &'static str,
        /// Windows there are.
        available: usize,
    },
    /// A file could not be read or written.
    #[error("could not {action} {path}", path = path.display())]
    Io {
        /// `read`, `write`, …
        action: &'static str,
        /// The file or directory.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// A file is not what its place says.
    #[error("{path} is damaged or not a Foreframe data set's file: {reason}", path = path.display())]
    Corrupt {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// A frame in a file is no image of the right size.
    #[error("{path}, row {row}: {column} is damaged", path = path.display())]
    CorruptFrame {
        /// The file.
        path: PathBuf,
        /// The column of images.
        column: &'static str,
        /// Row in it.
        row: usize,
        /// What is wrong with the image.
        source: FrameError,
    },
    /// A frame could not be compressed.
    #[error("a frame could not be stored")]
    Encode(#[source] FrameError),
    /// A table could not be built.
    #[error("a table of the data set could not be built")]
    Build(#[source] parquet::errors::ParquetError),
    /// A file is not the one that was collected.
    #[error(
        "{path} has the sha256 {found}, but {expected} was recorded when it was made; restore the file or collect the \
         data set anew",
        path = path.display()
    )]
    HashDiffers {
        /// The file.
        path: PathBuf,
        /// Hash recorded.
        expected: String,
        /// Hash found.
        found: String,
    },
    /// There is no data set of that name.
    #[error(
        "there is no data set {name:?} in {dir}; there {those}; `foreframe collect` makes one",
        dir = dir.display(),
        those = crate::wording::those(known)
    )]
    Unknown {
        /// The name asked for.
        name: String,
        /// Where it was looked for.
        dir: PathBuf,
        /// The names there are.
        known: Vec<String>,
    },
    /// The directory holds no data set.
    #[error(
        "{path} holds no data set (meta/info.json is missing); name one that `foreframe collect` made",
        path = path.display()
    )]
    NotADataset {
        /// The directory.
        path: PathBuf,
    },
    /// The directory is in use for something else.
    #[error(
        "{path} exists and is not a collection; name a directory that doesn't exist or is empty",
        path = path.display()
    )]
    OutExists {
        /// The directory.
        path: PathBuf,
    },
    /// The collection there was begun with other arguments.
    #[error(
        "{path} was begun with other arguments ({differences}); use those to go on, or name another directory",
        path = path.display()
    )]
    OtherArguments {
        /// The directory.
        path: PathBuf,
        /// Each argument that differs, with both values.
        differences: String,
    },
    /// Another collection is writing there.
    #[error("another collection is running in {path}; wait for it or name another directory", path = path.display())]
    Busy {
        /// The directory.
        path: PathBuf,
    },
    /// The collection was stopped before its end.
    #[error("stopped with {done} of {total} trials kept; run the same command again to go on")]
    Cancelled {
        /// Trials in finished shards.
        done: u64,
        /// Trials asked for.
        total: u64,
    },
    /// The world's settings are out of range.
    #[error(transparent)]
    World(SimError),
    /// The world refused.
    #[error("trial {trial} could not be simulated")]
    Simulation {
        /// The trial.
        trial: u64,
        /// What the world said.
        source: SimError,
    },
    /// The collection was interrupted.
    #[error(
        "the data set in {path} is unfinished; run `foreframe collect` with the same arguments to go on: {arguments}",
        path = path.display()
    )]
    Unfinished {
        /// The directory.
        path: PathBuf,
        /// The arguments it was begun with.
        arguments: String,
    },
    /// There is no such episode.
    #[error("there is no episode {episode} in \"{name}\"; it has {count}, counted from 0")]
    NoEpisode {
        /// The data set's name.
        name: String,
        /// The episode asked for.
        episode: usize,
        /// How many there are.
        count: usize,
    },
}

impl DatasetError {
    /// An [`DatasetError::Io`] of that action on that path.
    pub(crate) fn io(action: &'static str, path: &std::path::Path) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.to_owned();
        move |source| Self::Io { action, path, source }
    }
}
