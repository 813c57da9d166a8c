//! Recordings with endless damage or endless names: what an import needs is bounded by what it keeps.
#![cfg(target_os = "linux")]

use std::fs;
use std::path::Path;
use std::process::Output;

use foreframe_data::dataset::import::{DEFAULT_DISK_MIB, ImportConfig, ImportError, ImportOptions, import};
use serde_json::Value;

use crate::bag_files::endless_topics;
use crate::import_arrays::npz;
use crate::process::{foreframe, text};
use crate::recordings::{self, numpy_array};

/// Memory that an import may use in these tests, in KiB: three times what it needs for a few frames.
const MEMORY_KIB: u64 = 192 << 10;

/// Runs `foreframe import SOURCE --skip-bad` with little memory.
fn import_with_little_memory(dir: &Path, source: &str) -> Output {
    let program = foreframe(dir);
    let mut shell = std::process::Command::new("sh");
    let script = format!("ulimit -d {MEMORY_KIB} && exec \"$0\" \"$@\"");
    shell.args(["-c", &script]).arg(program.get_program());
    shell.args(["import", source, "--out", "set", "--skip-bad"]);
    shell
        .current_dir(dir)
        .env("RAYON_NUM_THREADS", "2")
        .env("MIMALLOC_ARENA_EAGER_COMMIT", "0")
        .env("MIMALLOC_PURGE_DELAY", "-1");
    shell.output().unwrap()
}

#[test]
fn a_catalog_of_bad_lines_needs_little_memory() {
    let dir = tempfile::tempdir().unwrap();
    recordings::tub(&dir.path().join("tub"), 20);
    let catalog = dir.path().join("tub/catalog_0.catalog");
    let good = fs::read_to_string(&catalog).unwrap();
    let bad = 3_000_000;
    fs::write(&catalog, good + &"{}\n".repeat(bad)).unwrap();
    let output = import_with_little_memory(dir.path(), "tub");
    let printed = text(&output.stdout);
    assert!(output.status.success(), "{}", text(&output.stderr));
    assert!(printed.contains(&format!("left out {bad} damaged items")), "{printed}");
    let listed = fs::metadata(dir.path().join("set/meta/skipped.json")).unwrap().len();
    assert!(listed < 5 << 20, "{listed}");
}

#[test]
fn endless_damaged_images_are_listed_up_to_the_limit() {
    let dir = tempfile::tempdir().unwrap();
    recordings::tub(&dir.path().join("tub"), 20);
    fs::write(dir.path().join("tub/images/bad.jpg"), "no image").unwrap();
    let catalog = dir.path().join("tub/catalog_0.catalog");
    let mut lines = fs::read_to_string(&catalog).unwrap();
    let bad: u64 = 12_000;
    for index in 20..20 + bad {
        let line = serde_json::json!({
            "_index": index, "_session_id": "9", "_timestamp_ms": 1_000_000 + 50 * index, "cam/image_array": "bad.jpg",
            "user/angle": 0.5, "user/throttle": 0.5, "user/mode": "user",
        });
        lines.push_str(&line.to_string());
        lines.push('\n');
    }
    fs::write(&catalog, lines).unwrap();
    let output = import_with_little_memory(dir.path(), "tub");
    assert!(output.status.success(), "{}", text(&output.stderr));
    let text = fs::read(dir.path().join("set/meta/skipped.json")).unwrap();
    let listed: Vec<(Value, Value)> = serde_json::from_slice(&text).unwrap();
    let counts = listed.iter().map(|(_, item)| item["count"].as_u64().unwrap_or(1));
    assert_eq!(counts.sum::<u64>(), bad);
    // The shards that are written after the limit count theirs together.
    assert!(listed.len() <= 10_010, "{}", listed.len());
}

#[test]
fn a_catalog_line_without_end_is_left_out() {
    let dir = tempfile::tempdir().unwrap();
    recordings::tub(&dir.path().join("tub"), 20);
    let catalog = dir.path().join("tub/catalog_0.catalog");
    let good = fs::read_to_string(&catalog).unwrap();
    fs::write(&catalog, "a".repeat(300 << 20) + "\n" + &good).unwrap();
    let output = import_with_little_memory(dir.path(), "tub");
    assert!(output.status.success(), "{}", text(&output.stderr));
    let printed = text(&output.stdout);
    assert!(printed.contains("the line has more than 1048576 bytes"), "{printed}");
}

#[test]
fn a_bag_of_endless_topics_needs_little_memory() {
    let dir = tempfile::tempdir().unwrap();
    recordings::mcap_bag(&dir.path().join("drive.mcap"), 20);
    let good = fs::read(dir.path().join("drive.mcap")).unwrap();
    fs::write(dir.path().join("topics.mcap"), endless_topics(&good, 600_000)).unwrap();
    let output = import_with_little_memory(dir.path(), "topics.mcap");
    assert!(output.status.success(), "{}", text(&output.stderr));
    let printed = text(&output.stdout);
    assert!(
        printed.contains("the bag has more than 4096 topics that are not imported"),
        "{printed}"
    );
}

#[test]
fn compressed_frames_beyond_the_disk_limit_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let source = dir.path().join("frames.npz");
    let pixels = vec![7; 40 * 256 * 256];
    let arrays = [("frames", numpy_array("|u1", "40, 256, 256", &pixels))];
    npz(&source, &arrays, zip::CompressionMethod::Deflated);
    let run = |disk_mib: u64| {
        let config = ImportConfig {
            source: source.clone(),
            out: dir.path().join("set"),
            options: ImportOptions {
                rate_hz: Some(10.0),
                ..ImportOptions::default()
            },
            disk_mib,
            max_files: 1,
        };
        import(&config, &|_| {}, &false.into())
    };
    let error = run(2).unwrap_err();
    assert!(
        matches!(
            error,
            ImportError::Disk {
                needed_mib: 3,
                limit_mib: 2
            }
        ),
        "{error}"
    );
    assert_eq!(run(DEFAULT_DISK_MIB).unwrap().info.frame_count, 40);
    let left: Vec<_> = recordings::contents(&dir.path().join("set")).into_keys().collect();
    assert!(
        !left.iter().any(|path| path.to_string_lossy().contains("frames.")),
        "{left:?}"
    );
}
