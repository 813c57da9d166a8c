//! Writes the planned episodes as shards. What is on disk depends on the source and the options alone, so an import that was
//! killed continues after its last whole shard, if that was made from the same source.

use std::fs::{self, File};
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

use serde::Serialize;
use serde_json::Value;

use super::archive::UnpackedSource;
use super::encoder::{EncodedShard, EpisodeEncoder};
use super::saved_shards::SavedShards;
use super::shard_origins::{self, ShardOrigins};
use super::skipped::{MAX_ITEMS, SkippedItem};
use super::timing::ImportPlan;
use super::{ImportConfig, ImportError, ImportOptions};
use crate::dataset::info::DatasetInfo;
use crate::dataset::store::arguments::lock_file;
use crate::dataset::store::files::{is_unused, write_atomically};
use crate::dataset::store::layout::{DatasetMetadata, IMPORT_ARGUMENTS, INFO, shard_path};
use crate::dataset::store::writer::{ShardWriter, shard_ranges};
use foreframe_core::files::{none_if_missing, remove_partials};

/// Where the episodes of an import come from.
pub(super) struct EpisodeSources<'a> {
    pub(super) plan: &'a ImportPlan,
    /// What parts have made already.
    pub(super) saved: &'a SavedShards<'a>,
    /// The source that the plan's images are in.
    pub(super) source: &'a UnpackedSource,
}

impl EpisodeSources<'_> {
    /// What the source's lists show to be left out, then what was left out of the shards.
    fn all_skipped(&self, of_shards: Vec<(Option<usize>, SkippedItem)>) -> Vec<(Option<usize>, SkippedItem)> {
        let listed = self.plan.recording.skipped.items(MAX_ITEMS).into_iter();
        let listed = listed.map(|item| (None, self.source.item_in_archive(item)));
        let mut all: Vec<_> = listed.chain(of_shards).collect();
        all.sort_by_key(|(of, _)| *of);
        all
    }
}

/// What was left out, with the shard in which it would have been; without one, if the source's lists show it.
const SKIPPED: &str = "meta/skipped.json";

/// What an import made.
#[derive(Clone, Debug, PartialEq)]
pub struct Imported {
    /// The data set.
    pub info: DatasetInfo,
    /// What was left out. The last entry can stand for all that are not listed.
    pub skipped: Vec<SkippedItem>,
    /// What is in the source but was not asked for, and how to import it, in sentences; empty if the data set was complete before.
    pub notes: Vec<String>,
}

impl Imported {
    /// How many items were left out.
    #[must_use]
    pub fn skipped_count(&self) -> u64 {
        self.skipped.iter().map(|item| item.count).sum()
    }
}

/// How many frames are written, of how many.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ImportProgress {
    /// Frames written, those of an earlier run included.
    pub done: u64,
    /// Frames in all.
    pub total: u64,
}

/// What decides the bytes of the data set.
#[derive(Serialize)]
struct ImportArguments<'a> {
    program_version: &'static str,
    source: &'a Path,
    options: &'a ImportOptions,
}

/// The directory of an import, locked by this process.
pub(super) struct Directory<'a> {
    config: &'a ImportConfig,
    /// It and those above it that did not exist before, the innermost first.
    made: Vec<PathBuf>,
    _lock: File,
}

impl<'a> Directory<'a> {
    /// Takes an unused directory, or one with the same import. Errors: `OutExists`, `Io`, `Dataset` (busy).
    pub(super) fn claim(config: &'a ImportConfig) -> Result<Self, ImportError> {
        let out = &config.out;
        let path = out.join(IMPORT_ARGUMENTS);
        let made = out
            .ancestors()
            .take_while(|path| !path.exists() && path.parent().is_some());
        let made = made.map(Path::to_owned).collect();
        // The file may be replaced, so the old one is locked first: another import may still use it.
        let old = path.is_file().then(|| lock_file(&path, out)).transpose()?;
        let lock = match (Self::check(config)?, old) {
            (None, Some(lock)) => lock,
            (text, _) => {
                if let Some(text) = text {
                    write_atomically(&path, text.as_bytes())?;
                }
                lock_file(&path, out)?
            }
        };
        remove_partials(out);
        Ok(Self {
            config,
            made,
            _lock: lock,
        })
    }

    /// Whether the directory can be taken. Returns the arguments that must be written to it; `None` if it has them already.
    /// Errors: `OutExists`, `Io`.
    pub(super) fn check(config: &ImportConfig) -> Result<Option<String>, ImportError> {
        let out = &config.out;
        let path = out.join(IMPORT_ARGUMENTS);
        let source = config.source.canonicalize();
        let arguments = ImportArguments {
            program_version: env!("CARGO_PKG_VERSION"),
            source: &source.map_err(ImportError::io("read", &config.source))?,
            options: &config.options,
        };
        let text = serde_json::to_string_pretty(&arguments)
            .map_err(|error| ImportError::Option(format!("the options cannot be written: {error}")))?;
        let occupied = |what: &str| ImportError::OutExists {
            path: out.clone(),
            what: what.to_owned(),
        };
        match fs::read_to_string(&path) {
            Ok(found) if found == text => Ok(None),
            // What was left out is known of each shard.
            Ok(found) if !out.join(INFO).exists() && are_same_but_for_skip_bad(&found, &text) => Ok(Some(text)),
            // An import that failed before its first shard leaves nothing that is worth keeping.
            Ok(_) if !out.join("data").exists() => Ok(Some(text)),
            Ok(_) => Err(occupied(
                "an import with another source or other options; delete it to import again",
            )),
            Err(error) if matches!(error.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory) => {
                let is_unused = is_unused(out, IMPORT_ARGUMENTS)?;
                is_unused.then_some(Some(text)).ok_or_else(|| occupied("other files"))
            }
            Err(error) => Err(ImportError::io("read", &path)(error)),
        }
    }

    /// The data set, if it is complete. Errors: `Dataset`, `Io`.
    pub(super) fn finished(&self) -> Result<Option<Imported>, ImportError> {
        let out = &self.config.out;
        if !out.join(INFO).exists() {
            return Ok(None);
        }
        shard_origins::forget(out);
        Ok(Some(Imported {
            info: DatasetMetadata::read(out)?.info_in(out)?,
            skipped: self.read_skipped()?.into_iter().map(|(_, item)| item).collect(),
            notes: Vec::new(),
        }))
    }

    /// Removes what a failed import wrote, unless a whole shard is saved, after which the same import continues.
    pub(super) fn discard(self) {
        let out = &self.config.out;
        if saved_shards(out) > 0 {
            return;
        }
        // What cannot be removed does not hide why the import failed, nor stop the next one.
        for part in ["data", "meta"] {
            let _ = fs::remove_dir_all(out.join(part));
        }
        for directory in &self.made {
            let _ = fs::remove_dir(directory);
        }
    }

    fn skipped_path(&self) -> PathBuf {
        self.config.out.join(SKIPPED)
    }

    fn read_skipped(&self) -> Result<Vec<(Option<usize>, SkippedItem)>, ImportError> {
        let path = self.skipped_path();
        match none_if_missing(fs::read(&path)).map_err(ImportError::io("read", &path))? {
            Some(text) => serde_json::from_slice(&text).map_err(|error| ImportError::record(path.display(), error)),
            None => Ok(Vec::new()),
        }
    }

    /// Writes the shards that are missing, then the tables. Shards that parts saved are not read from the source again.
    /// Errors: `Cancelled`, `Image`, `Record`, `Io`, `Dataset`.
    pub(super) fn write(
        &self,
        from: &EpisodeSources<'_>,
        on_progress: &(dyn Fn(ImportProgress) + Sync),
        cancelled: &AtomicBool,
    ) -> Result<Imported, ImportError> {
        let EpisodeSources { plan, saved, source } = *from;
        let mut writer = ShardWriter::new(&self.config.out, description(self.config, plan));
        let total = plan.episodes.iter().map(Vec::len).sum::<usize>() as u64;
        let mut done = 0;
        // Those that the source's lists have are found again by every run.
        let mut skipped = self.read_skipped()?;
        skipped.retain(|(of, _)| of.is_some());
        let mut origins = ShardOrigins::read(self.config, plan, &source.path);
        for episodes in shard_ranges(plan.episodes.iter().map(Vec::len)) {
            let frames: usize = plan.episodes[episodes.clone()].iter().map(Vec::len).sum();
            if cancelled.load(Ordering::Relaxed) {
                return Err(ImportError::Cancelled { done, total });
            }
            let shard = writer.shard_count();
            let lacks_items = skipped.iter().any(|(of, _)| *of == Some(shard));
            let is_refused = lacks_items && !self.config.options.skip_bad;
            if !origins.resume(&mut writer, episodes.clone(), is_refused)? {
                skipped.retain(|(of, _)| of.is_some_and(|of| of < shard));
                let on_frames = |frames: usize| {
                    let done = done + frames as u64;
                    on_progress(ImportProgress { done, total });
                };
                let encoded = match saved.shard(writer.info(), shard) {
                    Some(saved) => Ok(saved),
                    None => EpisodeEncoder {
                        plan,
                        options: &self.config.options,
                        info: writer.info(),
                        first: writer.episode_count(),
                    }
                    .encode(episodes, cancelled, &on_frames),
                };
                let EncodedShard { encoded, bad } = encoded.map_err(|error| match error {
                    ImportError::Stopped => ImportError::Cancelled { done, total },
                    other => other,
                })?;
                let room = MAX_ITEMS.saturating_sub(skipped.len());
                skipped.extend(
                    bad.items(room)
                        .into_iter()
                        .map(|item| (Some(shard), source.item_in_archive(item))),
                );
                self.write_skipped(&skipped)?;
                writer.write(&encoded)?;
            }
            done += frames as u64;
            on_progress(ImportProgress { done, total });
        }
        origins.discard_rest(&writer)?;
        if writer.episode_count() == 0 {
            return Err(ImportError::Empty(self.config.source.clone()));
        }
        let all = from.all_skipped(skipped);
        self.write_skipped(&all)?;
        remove_partials(&self.config.out);
        let info = writer.complete()?;
        shard_origins::forget(&self.config.out);
        Ok(Imported {
            info,
            skipped: all.into_iter().map(|(_, item)| item).collect(),
            notes: plan.recording.notes.iter().cloned().chain(origins.note()).collect(),
        })
    }

    fn write_skipped(&self, skipped: &[(Option<usize>, SkippedItem)]) -> Result<(), ImportError> {
        let text = serde_json::to_vec_pretty(skipped).expect("a list of texts that JSON cannot hold is a bug");
        Ok(write_atomically(&self.skipped_path(), &text)?)
    }
}

/// Whether the arguments of two imports are the same, but for that what is damaged may be left out.
fn are_same_but_for_skip_bad(one: &str, other: &str) -> bool {
    let parsed = |text: &str| -> Option<Value> {
        let mut arguments: Value = serde_json::from_str(text).ok()?;
        *arguments.get_mut("options")?.get_mut("skip_bad")? = Value::Null;
        Some(arguments)
    };
    parsed(one).is_some_and(|one| Some(one) == parsed(other))
}

/// How many shards an unfinished import has written; a later run continues after them.
#[must_use]
pub fn saved_shards(out: &Path) -> usize {
    (0..usize::MAX)
        .take_while(|&shard| out.join(shard_path(shard)).is_file())
        .count()
}

pub(super) fn description(config: &ImportConfig, plan: &ImportPlan) -> DatasetInfo {
    // The name under which users find it; the source's own if the directory has none, as `..` has not.
    let directory = config.out.file_name();
    DatasetInfo {
        name: directory.map_or_else(
            || plan.recording.name.clone(),
            |name| name.to_string_lossy().into_owned(),
        ),
        frame_width_px: config.options.frame_width_px,
        frame_height_px: config.options.frame_height_px,
        frame_period_s: plan.frame_period_s,
        action_channels: plan.recording.action_channels.clone(),
        state_channels: plan.recording.state_channels.clone(),
        camera: plan.recording.camera,
        ..DatasetInfo::default()
    }
}
