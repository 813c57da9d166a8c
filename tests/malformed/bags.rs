//! Bags in SQLite databases. (Those in MCAP files are fuzzed by `fuzz/run` only.)

use std::path::Path;
use std::sync::atomic::AtomicBool;
use std::sync::mpsc;
use std::time::Duration;

use foreframe_core::error_text::with_causes;
use foreframe_data::dataset::import::{
    DEFAULT_DISK_MIB, DEFAULT_MAX_FILES, ImportConfig, ImportError, ImportOptions, Imported, import,
};
use proptest::prelude::*;
use proptest::sample::Index;
use tempfile::TempDir;

use crate::corpus::files;
use crate::mutation::{mutated, mutations};
use crate::{exclusive, within_memory};

/// A database that makes SQLite compute takes forever, or gigabytes that are not counted here.
const MAX_TIME: Duration = Duration::from_mins(1);
/// What the import of a few small frames allocates, most of it to write a Parquet file.
const MAX_BYTES: usize = 32 << 20;

/// Imports a database within the limits of time and memory.
fn imported(name: &str, bytes: &[u8], skip_bad: bool) -> Result<Imported, ImportError> {
    let dir = in_memory();
    std::fs::write(dir.path().join("bag.db3"), bytes).unwrap();
    let result = within_memory(MAX_BYTES, name, || in_time(name, dir.path(), skip_bad));
    drop(dir);
    result
}

/// A directory in memory where there is one.
fn in_memory() -> TempDir {
    tempfile::tempdir_in("/dev/shm")
        .or_else(|_| tempfile::tempdir())
        .unwrap()
}

fn in_time(name: &str, dir: &Path, skip_bad: bool) -> Result<Imported, ImportError> {
    let config = ImportConfig {
        source: dir.join("bag.db3"),
        out: dir.join("out"),
        options: ImportOptions {
            frame_width_px: 8,
            frame_height_px: 8,
            skip_bad,
            ..ImportOptions::default()
        },
        disk_mib: DEFAULT_DISK_MIB,
        max_files: DEFAULT_MAX_FILES,
    };
    let (sender, receiver) = mpsc::channel();
    std::thread::spawn(move || sender.send(import(&config, &|_| {}, &AtomicBool::new(false))));
    let result = receiver.recv_timeout(MAX_TIME);
    result.unwrap_or_else(|_| panic!("{name}: the import did not end in {MAX_TIME:?}"))
}

#[test]
fn corpus_databases_are_imported_or_refused_as_named() {
    let _alone = exclusive();
    for file in files("bags") {
        let result = imported(&file.name, &file.bytes, false);
        let reason = result.as_ref().err().map(|error| with_causes(error));
        assert_eq!(result.is_ok(), file.part(0) == "ok", "{}: {reason:?}", file.name);
        // What is computed is not damage that could be left out.
        let result = imported(&file.name, &file.bytes, true);
        let reason = result.as_ref().err().map(|error| with_causes(error));
        let is_damaged = file.name == "refused-rows-without-end.db3";
        assert_eq!(
            result.is_ok(),
            file.part(0) == "ok" || is_damaged,
            "{}: {reason:?}",
            file.name
        );
    }
}

proptest! {
    #[test]
    fn mutated_databases_are_imported_or_refused(which: Index, mutations in mutations(), skip_bad: bool) {
        let _alone = exclusive();
        let files = files("bags");
        let file = which.get(&files);
        let _ = imported(&file.name, &mutated(&file.bytes, &mutations), skip_bad);
    }
}
