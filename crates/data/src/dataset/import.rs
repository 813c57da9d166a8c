//! Turns recordings of real robots into data sets.
//!
//! A source (`images`, `donkeycar`, `lerobot`, `numpy`, `npz`, `video` or `bag`) lists its records: time, action, state and where the image
//! is. `archive` unpacks a source that is one. `timing` cuts them into episodes at one frame rate. `encoder` reads the images and
//! resizes them, `writer` writes shards. `part` saves some of the shards for another process, by `saved_shards`.
//! `shard_origins` tells which shards of an import that was stopped are still of use.
//! Only one shard is in memory at a time.

mod archive;
mod bag;
mod camera;
mod donkeycar;
mod encoder;
mod error;
mod files;
mod image_files;
mod images;
mod lerobot;
mod npz;
mod numpy;
mod options;
mod part;
mod raw_images;
mod recording;
mod rounding;
mod saved_shards;
mod shard_origins;
mod skipped;
mod timing;
mod video;
mod writer;

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use self::archive::UnpackedSource;
pub use self::bag::live;
pub use self::error::ImportError;
use self::files::{extension, open_file};
pub use self::options::{DEFAULT_DISK_MIB, DEFAULT_MAX_FILES, ImportConfig, ImportOptions, parse_size};
#[doc(hidden)]
pub use self::part::ImportPart;
use self::recording::Recording;
use self::saved_shards::SavedShards;
#[doc(hidden)]
pub use self::saved_shards::saved_part_shards;
pub use self::skipped::SkippedItem;
use self::skipped::listed;
use self::timing::ImportPlan;
use self::writer::EpisodeSources;
pub use self::writer::{ImportProgress, Imported, saved_shards};
use foreframe_core::types::Channel;

/// Whether a directory can be written by this import: it is unused, holds the same import, or holds another one that has
/// written no frames yet. Errors: `OutExists`, `Io`.
pub fn check_out(config: &ImportConfig) -> Result<(), ImportError> {
    writer::Directory::check(config).map(drop)
}

/// Imports a recording, or continues an import that was stopped; the result has the same bytes either way. Returns at once
/// if the data set is complete. An import that fails before its first shard leaves nothing. Errors: every [`ImportError`].
pub fn import(
    config: &ImportConfig,
    on_progress: &(dyn Fn(ImportProgress) + Sync),
    cancelled: &AtomicBool,
) -> Result<Imported, ImportError> {
    import_parts(config, &[], on_progress, cancelled)
}

/// As [`import`], but shards that [`import_part`] saved in these directories are taken from there. What is missing there is
/// imported, so the bytes are the same in every case. Errors: every [`ImportError`].
#[doc(hidden)]
pub fn import_parts(
    config: &ImportConfig,
    parts: &[PathBuf],
    on_progress: &(dyn Fn(ImportProgress) + Sync),
    cancelled: &AtomicBool,
) -> Result<Imported, ImportError> {
    config.options.validate()?;
    let directory = writer::Directory::claim(config)?;
    if let Some(finished) = directory.finished()? {
        return Ok(finished);
    }
    let write = || {
        // Its images are read while the data set is written.
        let source = UnpackedSource::of(config, cancelled)?;
        let written = plan(&source.path, config, cancelled).and_then(|plan| {
            let from = EpisodeSources {
                plan: &plan,
                saved: &SavedShards::new(config, &plan, parts),
                source: &source,
            };
            directory.write(&from, on_progress, cancelled)
        });
        written.map_err(|error| source.name_in_archive(error))
    };
    let imported = write();
    if imported.is_err() {
        directory.discard();
    }
    imported
}

/// Imports a part of a recording, or continues: its share of the shards of the import with the same `config`, in its own directory.
/// [`import_parts`] then takes them. Errors: every [`ImportError`].
#[doc(hidden)]
pub fn import_part(
    config: &ImportConfig,
    part: &ImportPart,
    on_progress: &(dyn Fn(ImportProgress) + Sync),
    cancelled: &AtomicBool,
) -> Result<(), ImportError> {
    config.options.validate()?;
    // Archives and arrays are unpacked in the part's directory.
    let here = ImportConfig {
        out: part.dir.clone(),
        ..config.clone()
    };
    let source = UnpackedSource::of(&here, cancelled)?;
    let plan = plan(&source.path, &here, cancelled);
    let written = plan.and_then(|plan| part::write(&plan, config, part, on_progress, cancelled));
    written.map_err(|error| source.name_in_archive(error))
}

/// Reads what is to be written. Errors: those of the source, `Option`, `Record`, `Empty`, `Stopped`.
fn plan(source: &Path, config: &ImportConfig, cancelled: &AtomicBool) -> Result<ImportPlan, ImportError> {
    let options = &config.options;
    let recording = open(source, config, cancelled)?;
    check_channels(&recording)?;
    check_units(options, &recording)?;
    let mut plan = timing::plan(recording, options)?;
    let notes = rounding::notes(&plan);
    plan.recording.notes.extend(notes);
    camera::describe(&mut plan, options, cancelled)?;
    Ok(plan)
}

/// Errors: `Option` if two components of the action or of the state have the same name.
fn check_channels(recording: &Recording) -> Result<(), ImportError> {
    for (what, channels) in [
        ("action", &recording.action_channels),
        ("state", &recording.state_channels),
    ] {
        let mut names = BTreeSet::new();
        if let Some(Channel { name, .. }) = channels.iter().find(|channel| !names.insert(&channel.name)) {
            return Err(ImportError::Option(format!(
                "two components of the {what} are named \"{name}\"; choose and name them with --{what}, each once"
            )));
        }
    }
    Ok(())
}

/// Errors: `Option` if a unit is given for a channel that the recording does not have.
fn check_units(options: &ImportOptions, recording: &Recording) -> Result<(), ImportError> {
    let channels = || recording.action_channels.iter().chain(&recording.state_channels);
    let mut named = options.units.iter().filter_map(|unit| unit.split_once('='));
    let Some((name, _)) = named.find(|(name, _)| channels().all(|channel| channel.name != *name)) else {
        return Ok(());
    };
    let known = listed(channels().map(|channel| &channel.name));
    let name = name.escape_default();
    Err(ImportError::Option(format!(
        "--unit names the channel \"{name}\", which is not imported; there are: {known}"
    )))
}

/// Reads the records of a source, after finding out of which kind it is.
fn open(source: &Path, config: &ImportConfig, cancelled: &AtomicBool) -> Result<Recording, ImportError> {
    let options = &config.options;
    if !source.is_dir() {
        open_file(source)?;
    }
    if donkeycar::is_tub(source) {
        return donkeycar::open(source, options);
    }
    if lerobot::is_lerobot(source) {
        return lerobot::open(source, options, cancelled);
    }
    if bag::is_bag(source) {
        return bag::open(source, options, cancelled);
    }
    if source.is_dir() {
        return images::open(source, options);
    }
    match extension(source).as_str() {
        "npy" => numpy::open(source, options),
        "npz" => npz::open(source, config, cancelled),
        "mp4" | "mkv" | "avi" | "mov" | "webm" => video::open(source, options, cancelled),
        _ => Err(ImportError::UnknownSource(source.to_owned())),
    }
}
