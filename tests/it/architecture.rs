//! The layout's one direction: a module uses only those before it in reading order, and some crates stay in their rooms.

use std::fs;
use std::path::{Path, PathBuf};

/// What each module may use of the crate.
const MAY_USE: &[(&str, &[&str])] = &[
    ("types", &[]),
    ("files", &[]),
    ("wording", &[]),
    ("telemetry", &[]),
    ("frame", &["types"]),
    ("nn", &["types", "frame"]),
    ("sim", &["types", "frame"]),
    ("dataset", &["types", "files", "wording", "frame", "sim"]),
    ("registry", &["types", "files", "wording", "nn"]),
    ("training", &["types", "files", "frame", "nn", "dataset", "registry"]),
    (
        "evaluation",
        &["types", "files", "wording", "frame", "nn", "sim", "dataset", "registry"],
    ),
    ("serving", &["types", "telemetry", "frame", "nn", "registry"]),
    ("store", &["types", "files"]),
    (
        "versions",
        &["types", "files", "wording", "telemetry", "registry", "serving", "store"],
    ),
    (
        "jobs",
        &[
            "types",
            "files",
            "wording",
            "telemetry",
            "frame",
            "nn",
            "sim",
            "dataset",
            "registry",
            "training",
            "evaluation",
            "serving",
            "store",
            "versions",
        ],
    ),
    (
        "server",
        &[
            "types",
            "wording",
            "telemetry",
            "frame",
            "nn",
            "sim",
            "dataset",
            "registry",
            "training",
            "evaluation",
            "serving",
            "store",
            "versions",
            "jobs",
        ],
    ),
    ("config", &["telemetry", "server"]),
];

/// Where a crate may be used, by path prefixes under `src/`.
const ROOMS: &[(&str, &[&str])] = &[
    ("candle_core", &["nn", "registry", "training", "evaluation", "serving"]),
    ("axum", &["server"]),
    ("hyper", &["server"]),
    ("figment", &["config"]),
    ("metrics_exporter_prometheus", &["telemetry"]),
    ("image::", &["frame"]),
    ("tokio", &["server", "jobs", "versions", "store", "serving", "cli"]),
    ("sqlx", &["store"]),
    ("object_store", &["store"]),
    ("rapier3d", &["sim"]),
    ("parquet", &["dataset"]),
    ("rustix", &["jobs"]),
];

fn sources() -> Vec<(String, String)> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut folders = vec![root.clone()];
    let mut files = Vec::new();
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(folder).unwrap() {
            let path: PathBuf = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else if path.extension().is_some_and(|extension| extension == "rs") {
                let name = path.strip_prefix(&root).unwrap().to_string_lossy().replace('\\', "/");
                files.push((name, fs::read_to_string(&path).unwrap()));
            }
        }
    }
    assert!(files.len() > 50, "only {} sources were found", files.len());
    files
}

fn module(file: &str) -> &str {
    file.split('/').next().unwrap().trim_end_matches(".rs")
}

/// The code above the unit tests.
fn code(text: &str) -> impl Iterator<Item = &str> {
    text.lines()
        .take_while(|line| line.trim() != "#[cfg(test)]")
        .filter(|line| !line.trim_start().starts_with("//"))
}

#[test]
fn a_module_uses_only_those_before_it() {
    for (file, text) in sources() {
        let Some((_, allowed)) = MAY_USE.iter().find(|(name, _)| *name == module(&file)) else {
            continue;
        };
        for line in code(&text) {
            for used in line.split("crate::").skip(1) {
                let used: String = used.chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect();
                let is_own = used == module(&file) || used.is_empty();
                assert!(is_own || allowed.contains(&used.as_str()), "{file} uses crate::{used}");
            }
        }
    }
}

#[test]
fn a_crate_stays_in_its_rooms() {
    for (file, text) in sources() {
        for (name, rooms) in ROOMS.iter().filter(|(_, rooms)| !rooms.contains(&module(&file))) {
            let uses = |line: &str| line.trim_start().starts_with(&format!("use {name}"));
            assert!(!code(&text).any(uses), "{file} uses {name}, which belongs to {rooms:?}");
        }
    }
}

#[test]
fn no_file_is_longer_than_400_lines() {
    for (file, text) in sources() {
        assert!(text.lines().count() <= 400, "{file} has {} lines", text.lines().count());
    }
}

#[test]
fn every_expect_says_that_its_failure_is_a_bug() {
    for (file, text) in sources() {
        let code: String = code(&text).collect();
        for call in code.split(".expect(").skip(1) {
            let message = call.split('"').nth(1).unwrap_or_default();
            assert!(message.ends_with("is a bug"), "{file} expects {message:?}");
        }
    }
}
