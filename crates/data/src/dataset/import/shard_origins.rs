//! What the shards of an unfinished import were made from. A later run takes over only those that it would make again from the
//! same records and images.

use std::fs;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::time::UNIX_EPOCH;

use sha2::Digest;

use super::files::entries;
use super::saved_shards::plan_hash;
use super::timing::ImportPlan;
use super::{ImportConfig, ImportError, ImportOptions};
use crate::dataset::store::files::{json_text, write_atomically};
use crate::dataset::store::writer::ShardWriter;

/// A hash for each shard of an unfinished import. It is deleted when the data set is complete.
const ORIGINS: &str = "meta/shard-origins.json";

/// What the shards on disk were made from, and what they would be made from now.
pub(super) struct ShardOrigins<'a> {
    plan: &'a ImportPlan,
    /// Without `skip_bad`: a shard of which nothing was left out is the same with it.
    options: ImportOptions,
    path: PathBuf,
    /// Those of the shards on disk.
    hashes: Vec<String>,
    /// Names, sizes and times of the source's files, unless each image has its own file; then these count.
    source: Option<String>,
    /// How many shards on disk were of no use.
    discarded: usize,
}

impl<'a> ShardOrigins<'a> {
    /// Those of the shards in the data set's directory. The images are read from the files below `read_from`.
    pub(super) fn read(config: &ImportConfig, plan: &'a ImportPlan, read_from: &Path) -> Self {
        let path = config.out.join(ORIGINS);
        // A shard of unknown origin is made again.
        let hashes = fs::read(&path).ok().and_then(|text| serde_json::from_slice(&text).ok());
        // An archive is unpacked again by every run, so the times of the files in it say nothing.
        let is_unpacked = read_from != config.source;
        let mut records = plan.recording.records.iter();
        let has_files = records.all(|record| plan.recording.images.file(record).is_some());
        Self {
            plan,
            options: ImportOptions {
                skip_bad: false,
                ..config.options.clone()
            },
            path,
            hashes: hashes.unwrap_or_default(),
            source: (is_unpacked || !has_files)
                .then(|| stamps(&config.source, config.out.canonicalize().ok().as_deref())),
            discarded: 0,
        }
    }

    /// Takes the next shard from disk if it would be made of the same now. If not, or if it `is_to_be_made`, deletes it and those
    /// after it, and notes what it is made from. Errors: `Dataset`.
    pub(super) fn resume(
        &mut self,
        writer: &mut ShardWriter,
        episodes: Range<usize>,
        is_to_be_made: bool,
    ) -> Result<bool, ImportError> {
        let (shard, hash) = (writer.shard_count(), self.hash(episodes));
        if !is_to_be_made && self.hashes.get(shard) == Some(&hash) && writer.resume(None) {
            return Ok(true);
        }
        self.discard_rest(writer)?;
        self.hashes.truncate(shard);
        self.hashes.push(hash);
        write_atomically(&self.path, json_text(&self.hashes).as_bytes())?;
        Ok(false)
    }

    /// Deletes the shards on disk after those that the writer has. Errors: `Dataset`.
    pub(super) fn discard_rest(&mut self, writer: &ShardWriter) -> Result<(), ImportError> {
        self.discarded += writer.discard_rest()?;
        Ok(())
    }

    /// That shards on disk were of no use, if there were some.
    pub(super) fn note(&self) -> Option<String> {
        (self.discarded > 0).then(|| {
            format!(
                "{} saved shards of an earlier run did not fit the recording or the options, and were made again",
                self.discarded
            )
        })
    }

    fn hash(&self, episodes: Range<usize>) -> String {
        let mut hash = plan_hash(&self.options, self.plan, episodes.clone());
        if let Some(source) = &self.source {
            hash.update(source);
        } else {
            let recording = &self.plan.recording;
            for frame in self.plan.episodes[episodes].iter().flatten() {
                let file = recording.images.file(&recording.records[frame.record]);
                hash.update(file.map(stamp).unwrap_or_default());
            }
        }
        format!("{:x}", hash.finalize())
    }
}

/// Deletes what is not needed of a complete data set.
pub(super) fn forget(out: &Path) {
    // A file that stays does no harm.
    let _ = fs::remove_file(out.join(ORIGINS));
}

/// The stamp of a file, or those of all files in a folder, without the folder `out`, which the import writes.
fn stamps(source: &Path, out: Option<&Path>) -> String {
    let mut text = stamp(source);
    for path in entries(source).unwrap_or_default() {
        // Links to folders are not followed: they can lead in a circle.
        let is_folder = path.symlink_metadata().is_ok_and(|found| found.is_dir());
        if !is_folder {
            text += &stamp(&path);
        } else if path.canonicalize().ok().as_deref() != out {
            text += &stamps(&path, out);
        }
    }
    text
}

/// Name, size and time of change of a file.
fn stamp(path: &Path) -> String {
    let found = fs::metadata(path).and_then(|found| Ok((found.len(), found.modified()?)));
    let Ok((bytes, changed)) = found else {
        return format!("{} is missing\n", path.display());
    };
    let changed_ns = changed.duration_since(UNIX_EPOCH).map_or(0, |time| time.as_nanos());
    format!("{} {bytes} {changed_ns}\n", path.display())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_stamps_of_a_folder_change_with_each_of_its_files() {
        let dir = tempfile::tempdir().unwrap();
        let inner = dir.path().join("videos");
        fs::create_dir(&inner).unwrap();
        fs::write(inner.join("a.mp4"), "1").unwrap();
        let out = inner.canonicalize().unwrap().join("set");
        fs::create_dir(&out).unwrap();
        let stamps = || stamps(dir.path(), Some(&out));
        let before = stamps();
        fs::write(out.join("shard"), "1").unwrap();
        assert_eq!(stamps(), before);
        fs::write(inner.join("a.mp4"), "22").unwrap();
        assert_ne!(stamps(), before);
    }
}
