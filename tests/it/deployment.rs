//! The files to deploy with name metrics and settings that exist.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use super::process::output;
use foreframe_core::metric_names;

/// What Prometheus' library calls adds to the name of a histogram.
const SUFFIXES: [&str; 3] = ["_bucket", "_sum", "_count"];
/// Made by a rule of the adapter.
const DERIVED: &str = "foreframe_prediction_queue_wait_p95_seconds";

/// All files below a directory of the repository.
fn files(directory: &str) -> Vec<PathBuf> {
    let mut found = Vec::new();
    let mut open = vec![Path::new(env!("CARGO_MANIFEST_DIR")).join(directory)];
    while let Some(directory) = open.pop() {
        for entry in std::fs::read_dir(directory).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                open.push(path);
            } else {
                found.push(path);
            }
        }
    }
    found
}

/// The words of all files that begin with a prefix, with the file of each.
fn words(directories: &[&str], prefix: &str) -> BTreeSet<(String, PathBuf)> {
    let mut found = BTreeSet::new();
    for path in directories.iter().flat_map(|directory| files(directory)) {
        let Ok(text) = std::fs::read_to_string(&path) else {
            continue;
        };
        let words = text.split(|c: char| !(c.is_ascii_alphanumeric() || c == '_'));
        found.extend(
            words
                .filter(|word| word.starts_with(prefix))
                .map(|word| (word.to_owned(), path.clone())),
        );
    }
    found
}

#[test]
fn rules_and_dashboard_name_existing_metrics() {
    let used = words(&["deploy/monitoring", "deploy/kubernetes"], "foreframe_");
    assert!(used.len() > 20, "{used:?}");
    for (name, path) in used {
        let base = SUFFIXES
            .iter()
            .find_map(|suffix| name.strip_suffix(suffix))
            .unwrap_or(&name);
        let is_known = [name.as_str(), base]
            .iter()
            .any(|name| metric_names::ALL.contains(name));
        assert!(
            is_known || name == DERIVED,
            "{}: there is no metric {name}",
            path.display()
        );
    }
}

#[test]
fn deployments_name_existing_settings() {
    let dir = tempfile::tempdir().unwrap();
    let config = output(dir.path(), &["config"]);
    let known = String::from_utf8(config.stdout).unwrap();
    let used = words(&["deploy", "docker"], "FOREFRAME_");
    assert!(used.len() > 10, "{used:?}");
    for (name, path) in used {
        let setting = name.trim_start_matches("FOREFRAME_").to_lowercase();
        let is_known = known.lines().any(|line| {
            let line = line.trim_start_matches("# ");
            line.starts_with(&format!("{setting} = ")) || line == format!("{setting} is not set")
        });
        assert!(is_known, "{}: there is no setting {setting}", path.display());
    }
}

/// The documents of all manifests that describe pods.
fn pods() -> Vec<String> {
    let manifests = files("deploy/kubernetes").into_iter();
    let texts: Vec<String> = manifests.map(|path| std::fs::read_to_string(path).unwrap()).collect();
    let documents = texts.iter().flat_map(|text| text.split("\n---\n"));
    let of_pods = documents.filter(|document| document.contains("\n      containers:\n"));
    of_pods.map(str::to_owned).collect()
}

#[test]
fn pods_get_no_variables_of_services() {
    let pods = pods();
    assert_eq!(pods.len(), 2, "{pods:?}");
    for pod in pods {
        // In the pod's specification, beside its containers.
        assert!(pod.contains("\n      enableServiceLinks: false\n"), "{pod}");
    }
}
