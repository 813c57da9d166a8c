//! An import that was stopped by an error continues with its saved shards only where these belong to the recording as it is now.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

use foreframe_data::dataset::Dataset;
use foreframe_data::dataset::import::{
    DEFAULT_DISK_MIB, DEFAULT_MAX_FILES, ImportConfig, ImportError, ImportOptions, ImportProgress, Imported, import,
    saved_shards,
};

use crate::import::{run, small};
use crate::recordings::{contents, images_with_csv};

/// A shard of 2000 frames, and another one.
const FRAMES: u32 = 2050;
/// In the second shard.
const DAMAGED: &str = "2030.png";

struct Recording {
    _dir: tempfile::TempDir,
    source: PathBuf,
    /// The bytes of the damaged image before.
    image: Vec<u8>,
    sets: PathBuf,
}

impl Recording {
    /// A recording whose import failed at an image of the second shard.
    fn half_imported() -> Self {
        let dir = tempfile::tempdir().unwrap();
        let (source, sets) = (dir.path().join("walk"), dir.path().join("sets"));
        images_with_csv(&source, FRAMES);
        let image = fs::read(source.join(DAMAGED)).unwrap();
        fs::write(source.join(DAMAGED), b"no image").unwrap();
        let recording = Self {
            _dir: dir,
            source,
            image,
            sets,
        };
        let error = run(&recording.source, &recording.set("walk"), small()).unwrap_err();
        assert!(error.to_string().contains("--skip-bad"), "{error}");
        assert_eq!(saved_shards(&recording.set("walk")), 1);
        recording
    }

    /// One of two directories of the same name.
    fn set(&self, beside: &str) -> PathBuf {
        self.sets.join(beside).join("set")
    }

    fn mend(&self) {
        fs::write(self.source.join(DAMAGED), &self.image).unwrap();
    }

    fn change_csv(&self, change: impl Fn(&str) -> String) {
        let path = self.source.join("log.csv");
        fs::write(&path, change(&fs::read_to_string(&path).unwrap())).unwrap();
    }

    /// Continues the import, and compares the data set with that of an import without a break.
    fn continues_as_unbroken(&self, options: &ImportOptions) -> Imported {
        let continued = run(&self.source, &self.set("walk"), options.clone()).unwrap();
        let unbroken = run(&self.source, &self.set("unbroken"), options.clone()).unwrap();
        assert_eq!(continued.info, unbroken.info);
        let files = |beside: &str| contents(&self.sets.join(beside));
        assert!(files("walk") == files("unbroken"), "the files differ");
        Dataset::open(&self.set("walk")).unwrap();
        fs::remove_dir_all(self.sets.join("unbroken")).unwrap();
        continued
    }
}

fn is_told(imported: &Imported) -> bool {
    imported.notes.iter().any(|note| note.contains("were made again"))
}

#[test]
fn a_saved_shard_of_the_same_recording_is_used() {
    let recording = Recording::half_imported();
    let shard = recording.set("walk").join("data/chunk-000/file-000.parquet");
    let written = || fs::metadata(&shard).unwrap().modified().unwrap();
    let before = written();
    recording.mend();
    let imported = recording.continues_as_unbroken(&small());
    assert_eq!((written(), is_told(&imported)), (before, false));
}

#[test]
fn saved_shards_of_other_values_are_imported_anew() {
    type Change = fn(&str) -> String;
    let other_values: Change = |csv| {
        csv.replace(".png,", ".png,-0.7,")
            .replace("[rad],state.h", "[rad],action.old,state.h")
    };
    let without_rows: Change = |csv| {
        let kept = csv.lines().enumerate().filter(|(line, _)| !(1..=50).contains(line));
        let kept: Vec<&str> = kept.map(|(_, line)| line).collect();
        kept.join("\n") + "\n"
    };
    let another_column: Change = |csv| {
        let lines = csv.lines().enumerate();
        let added = |(line, text): (usize, &str)| match line {
            0 => format!("{text},action.gas\n"),
            _ => format!("{text},0.5\n"),
        };
        lines.map(added).collect()
    };
    for change in [other_values, without_rows, another_column] {
        let recording = Recording::half_imported();
        recording.mend();
        recording.change_csv(change);
        assert!(is_told(&recording.continues_as_unbroken(&small())));
    }
}

#[test]
fn an_image_that_was_replaced_is_read_again() {
    let recording = Recording::half_imported();
    recording.mend();
    fs::copy(recording.source.join("40.png"), recording.source.join("7.png")).unwrap();
    assert!(is_told(&recording.continues_as_unbroken(&small())));
}

#[test]
fn damage_after_a_saved_shard_can_be_left_out() {
    let skipping = ImportOptions {
        skip_bad: true,
        ..small()
    };
    let recording = Recording::half_imported();
    let imported = recording.continues_as_unbroken(&skipping);
    assert_eq!((imported.skipped.len(), is_told(&imported)), (1, false));
    // A data set from which something was left out is not one of an import that leaves nothing out.
    let error = run(&recording.source, &recording.set("walk"), small()).unwrap_err();
    assert!(error.to_string().contains("other options"), "{error}");
}

#[test]
fn a_shard_that_lacks_an_image_is_not_one_of_an_import_that_needs_all() {
    let recording = Recording::half_imported();
    let seventh = fs::read(recording.source.join("7.png")).unwrap();
    fs::write(recording.source.join("7.png"), b"no image").unwrap();
    let config = ImportConfig {
        source: recording.source.clone(),
        out: recording.set("walk"),
        options: ImportOptions {
            skip_bad: true,
            ..small()
        },
        disk_mib: DEFAULT_DISK_MIB,
        max_files: DEFAULT_MAX_FILES,
    };
    let stop = AtomicBool::new(false);
    let on_progress = |now: ImportProgress| stop.store(now.done >= 2000, Ordering::Relaxed);
    let stopped = import(&config, &on_progress, &stop).unwrap_err();
    assert!(
        matches!(stopped, ImportError::Cancelled { done: 2000, .. }),
        "{stopped}"
    );
    let error = run(&recording.source, &config.out, small()).unwrap_err();
    assert!(error.to_string().contains("7.png"), "{error}");
    fs::write(recording.source.join("7.png"), seventh).unwrap();
    recording.mend();
    recording.continues_as_unbroken(&small());
}

#[test]
fn no_shard_stays_of_a_recording_that_became_shorter() {
    let dir = tempfile::tempdir().unwrap();
    let (source, out) = (dir.path().join("walk"), dir.path().join("set"));
    images_with_csv(&source, 4050);
    fs::write(source.join("4030.png"), b"no image").unwrap();
    run(&source, &out, small()).unwrap_err();
    assert_eq!(saved_shards(&out), 2);
    let csv = fs::read_to_string(source.join("log.csv")).unwrap();
    let kept: Vec<&str> = csv.lines().take(2001).collect();
    fs::write(source.join("log.csv"), kept.join("\n") + "\n").unwrap();
    let imported = run(&source, &out, small()).unwrap();
    assert_eq!((imported.info.frame_count, saved_shards(&out)), (2000, 1));
    assert!(is_told(&imported));
    assert_eq!(lists_of_shards(&out), 0, "a complete data set needs none");
}

fn lists_of_shards(out: &Path) -> usize {
    let entries = fs::read_dir(out.join("meta")).unwrap();
    let names = entries.map(|entry| entry.unwrap().file_name().into_string().unwrap());
    names.filter(|name| name.contains("origins")).count()
}

#[test]
fn values_that_32_bits_hold_coarsely_are_told() {
    let dir = tempfile::tempdir().unwrap();
    let source = dir.path().join("walk");
    images_with_csv(&source, 60);
    let csv = fs::read_to_string(source.join("log.csv")).unwrap();
    let lines = csv.lines().enumerate().map(|(line, text)| match line {
        0 => format!("{text},state.north [m]\n"),
        _ => format!("{text},{}\n", 5_400_000.0 + line as f64 * 0.01),
    });
    fs::write(source.join("log.csv"), lines.collect::<String>()).unwrap();
    let imported = run(&source, &dir.path().join("set"), small()).unwrap();
    let note = &imported.notes[0];
    assert!(
        note.contains("\"state.north\"") && note.contains("subtract an origin"),
        "{note}"
    );
    assert_eq!(imported.notes.len(), 1);
}
