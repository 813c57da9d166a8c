//! The module order: a module uses only earlier modules, and some dependencies are used only in certain modules.

use std::fs;
use std::path::{Path, PathBuf};

/// The modules that each module may use.
const MAY_USE: &[(&str, &[&str])] = &[
    ("types", &[]),
    ("files", &[]),
    ("error_text", &[]),
    ("telemetry", &[]),
    ("frame", &["types"]),
    ("nn", &["types", "frame"]),
    ("sim", &["types", "frame"]),
    ("dataset", &["types", "files", "error_text", "frame", "sim"]),
    ("registry", &["types", "files", "error_text", "nn"]),
    ("training", &["types", "files", "frame", "nn", "dataset", "registry"]),
    (
        "evaluation",
        &["types", "files", "error_text", "frame", "nn", "sim", "dataset", "registry"],
    ),
    ("serving", &["types", "telemetry", "frame", "nn", "registry"]),
    ("store", &["types", "files"]),
    (
        "versions",
        &["types", "files", "error_text", "telemetry", "registry", "serving", "store"],
    ),
    (
        "jobs",
        &[
            "types",
            "files",
            "error_text",
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
            "error_text",
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

/// The modules in which a dependency may be used.
const USED_IN: &[(&str, &[&str])] = &[
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
    assert!(files.len() > 50, "only {} source files were found", files.len());
    files
}

fn module(file: &str) -> &str {
    file.split('/').next().unwrap().trim_end_matches(".rs")
}

/// The lines of code before the unit tests, without comments.
fn code(text: &str) -> impl Iterator<Item = &str> {
    text.lines()
        .take_while(|line| line.trim() != "#[cfg(test)]")
        .filter(|line| !line.trim_start().starts_with("//"))
}

#[test]
fn modules_use_only_earlier_modules() {
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
fn dependencies_are_used_only_in_their_modules() {
    for (file, text) in sources() {
        for (name, modules) in USED_IN.iter().filter(|(_, modules)| !modules.contains(&module(&file))) {
            let uses = |line: &str| line.trim_start().starts_with(&format!("use {name}"));
            assert!(!code(&text).any(uses), "{file} uses {name}, which is for {modules:?} only");
        }
    }
}

#[test]
fn no_file_is_longer_than_400_lines() {
    for (file, text) in sources() {
        assert!(text.lines().count() <= 400, "{file} has {} lines", text.lines().count());
    }
}
