//! Data sets of recorded and simulated episodes, on disk and in memory.
//!
//! A [`Dataset`] holds actions, states and times in memory. Its frames are in memory too, or, if they are too large for that,
//! decoded in a file. [`sampler`] divides its [`Window`]s into training, validation and test parts. [`collect()`] simulates a
//! data set and writes it in LeRobot's v3.0 layout. The modules in reading order; each uses only those above it.

mod error;

mod info;

mod check;

mod frame_store;

mod opened;

mod joined;

pub mod sampler;

pub mod background;

mod store;

pub mod collect;

mod program;

pub mod import;

pub mod export;

pub use collect::moving_mnist;
pub use collect::{
    CollectConfig, CollectProgress, CollectionStatus, DEFAULT_TRIALS_PER_SHARD, collect, collect_part, take_parts,
};
pub use error::DatasetError;
pub use foreframe_sim::TrialParameters;
pub use info::{DatasetInfo, DatasetPart, Episode, EpisodeData};
pub use joined::Lacking;
pub use opened::Dataset;
pub use sampler::{Split, Splits, Window, WindowShape};
pub use store::catalog::{find, is_finished, list};
pub use store::layout::{IMPORT_ARGUMENTS, INFO, METADATA};
pub use store::parquet_file::silence_caught_panics;
pub use store::preview::{describe, describe_metadata};
