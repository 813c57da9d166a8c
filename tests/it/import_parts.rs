//! Imports in parts: the same bytes as without, whatever is missing.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

use foreframe_data::dataset::import::{
    DEFAULT_DISK_MIB, DEFAULT_MAX_FILES, ImportConfig, ImportError, ImportOptions, ImportPart, import, import_part,
    import_parts, saved_part_shards,
};

use crate::import::small;
use crate::import_archives::{contents, zip};
use crate::recordings::images_with_csv;

const PARTS: usize = 2;
/// Three shards: two of 2000 frames, and the rest.
const FRAMES: u32 = 4050;

fn config(source: &Path, out: &Path) -> ImportConfig {
    ImportConfig {
        source: source.to_owned(),
        out: out.join("set"),
        options: ImportOptions {
            skip_bad: true,
            ..small()
        },
        disk_mib: DEFAULT_DISK_MIB,
        max_files: DEFAULT_MAX_FILES,
    }
}

fn part(dir: &Path, index: usize) -> ImportPart {
    ImportPart {
        dir: dir.join(index.to_string()),
        index,
        count: PARTS,
    }
}

/// Imports all parts; returns their directories.
fn parts(config: &ImportConfig, dir: &Path) -> Vec<PathBuf> {
    let imported = |index| {
        let part = part(dir, index);
        import_part(config, &part, &|_| {}, &AtomicBool::new(false)).unwrap();
        part.dir
    };
    (0..PARTS).map(imported).collect()
}

/// The files of the data set, which is then deleted, but for its arguments, which name its source.
fn data_set(out: &Path) -> Vec<(String, Vec<u8>)> {
    let mut files = contents(&out.join("set"), "");
    files.retain(|(name, _)| !name.ends_with("import.json"));
    assert!(
        files.iter().any(|(name, _)| name == "meta/skipped.json"),
        "{:?}",
        names(&files)
    );
    files.sort();
    fs::remove_dir_all(out.join("set")).unwrap();
    files
}

fn names(files: &[(String, Vec<u8>)]) -> Vec<&str> {
    files.iter().map(|(name, _)| name.as_str()).collect()
}

fn assert_same(found: &[(String, Vec<u8>)], expected: &[(String, Vec<u8>)]) {
    assert_eq!(names(found), names(expected));
    for ((name, found), (_, expected)) in found.iter().zip(expected) {
        assert!(found == expected, "{name}");
    }
}

#[test]
fn parts_give_the_same_data_set_whatever_is_missing() {
    let dir = tempfile::tempdir().unwrap();
    let source = dir.path().join("walk");
    images_with_csv(&source, FRAMES);
    // Episodes before it have fewer frames than planned.
    fs::write(source.join("7.png"), b"no image").unwrap();
    fs::write(source.join("4001.png"), b"no image").unwrap();
    let config = config(&source, dir.path());
    let running = AtomicBool::new(false);
    import(&config, &|_| {}, &running).unwrap();
    let expected = data_set(dir.path());
    let saved = parts(&config, dir.path());
    assert_eq!([saved_part_shards(&saved[0]), saved_part_shards(&saved[1])], [1, 2]);

    // What is saved is not read again.
    let image = fs::read(source.join("20.png")).unwrap();
    fs::write(source.join("20.png"), b"no image").unwrap();
    import_parts(&config, &saved, &|_| {}, &running).unwrap();
    assert_same(&data_set(dir.path()), &expected);
    fs::write(source.join("20.png"), image).unwrap();

    // One shard is lost, another one damaged.
    let file = |part: usize, name: &str| saved[part].join(name);
    fs::remove_file(file(0, "shards/shard-000000.json")).unwrap();
    fs::write(file(1, "unfinished/shard-000001.parquet"), b"no shard").unwrap();
    import_parts(&config, &saved, &|_| {}, &running).unwrap();
    assert_same(&data_set(dir.path()), &expected);

    // With other options, nothing that was saved fits.
    let every = ImportConfig {
        options: ImportOptions {
            every: 2,
            ..config.options.clone()
        },
        ..config.clone()
    };
    import(&every, &|_| {}, &running).unwrap();
    let expected = data_set(dir.path());
    import_parts(&every, &saved, &|_| {}, &running).unwrap();
    assert_same(&data_set(dir.path()), &expected);
}

#[test]
fn a_part_of_an_archive_names_what_it_left_out_as_the_whole_does() {
    let dir = tempfile::tempdir().unwrap();
    images_with_csv(&dir.path().join("walk"), 60);
    fs::write(dir.path().join("walk/7.png"), b"no image").unwrap();
    let entries = contents(&dir.path().join("walk"), "walk/");
    let entries: Vec<(&str, &[u8])> = entries
        .iter()
        .map(|(name, bytes)| (name.as_str(), &bytes[..]))
        .collect();
    let source = dir.path().join("walk.zip");
    fs::write(&source, zip(&entries)).unwrap();
    let config = config(&source, dir.path());
    import(&config, &|_| {}, &AtomicBool::new(false)).unwrap();
    let expected = data_set(dir.path());
    let saved = parts(&config, dir.path());
    assert!(!saved[1].join(".unpacked").exists());
    import_parts(&config, &saved, &|_| {}, &AtomicBool::new(false)).unwrap();
    assert_same(&data_set(dir.path()), &expected);
}

#[test]
fn a_part_that_was_stopped_continues_with_the_next_shard() {
    let dir = tempfile::tempdir().unwrap();
    let source = dir.path().join("walk");
    images_with_csv(&source, FRAMES);
    let (config, part) = (config(&source, dir.path()), part(dir.path(), 1));
    let stop = AtomicBool::new(false);
    let stopped = import_part(
        &config,
        &part,
        &|now| stop.store(now.done >= 2000, Ordering::Release),
        &stop,
    );
    assert!(
        matches!(
            stopped,
            Err(ImportError::Cancelled {
                done: 2000,
                total: 2050
            })
        ),
        "{stopped:?}"
    );
    assert_eq!(saved_part_shards(&part.dir), 1);
    fs::write(source.join("2001.png"), b"no image").unwrap();
    import_part(&config, &part, &|_| {}, &AtomicBool::new(false)).unwrap();
    assert_eq!(saved_part_shards(&part.dir), 2);
    let saved = fs::read_to_string(part.dir.join("shards/shard-000001.json")).unwrap();
    assert!(!saved.contains("2001.png"), "{saved}");
}
