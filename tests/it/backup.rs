//! `foreframe backup` and `foreframe restore`: beside a running server, on a stopped one, and with damaged files.
#![cfg(unix)]

use std::path::{Path, PathBuf};

use foreframe_jobs::store::{Store, StoreConfig};
use serde_json::{Value, json};

use crate::process::{RunningServer, output, text};

/// Runs a command that must succeed; returns its standard output.
fn succeed(dir: &Path, arguments: &[&str]) -> String {
    let output = output(dir, arguments);
    assert!(output.status.success(), "{arguments:?}: {}", text(&output.stderr));
    text(&output.stdout)
}

/// Runs a command that must fail; returns its standard error.
fn fail(dir: &Path, arguments: &[&str]) -> String {
    let output = output(dir, arguments);
    let error = text(&output.stderr);
    assert!(
        !output.status.success() && error.lines().count() == 1,
        "{arguments:?}: {error}"
    );
    error
}

/// Every file below a directory with its content.
fn contents(root: &Path) -> Vec<(PathBuf, Vec<u8>)> {
    let (mut dirs, mut files) = (vec![root.to_owned()], Vec::new());
    while let Some(dir) = dirs.pop() {
        for entry in std::fs::read_dir(dir).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                dirs.push(path);
            } else {
                files.push((
                    path.strip_prefix(root).unwrap().to_owned(),
                    std::fs::read(&path).unwrap(),
                ));
            }
        }
    }
    files.sort();
    files
}

fn paper() -> String {
    format!("{}/models/paper", env!("CARGO_MANIFEST_DIR"))
}

#[test]
fn a_backup_of_a_running_server_goes_on_elsewhere() {
    let (dir, other) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let server = RunningServer::start(dir.path(), &[]);
    let collect = |name: &str, trials: u32| {
        let spec = json!({"kind": "collect", "name": name, "scenario": "static-observer", "trials": trials});
        server.ask("POST", "/v1/jobs", &spec)["id"].as_str().unwrap().to_owned()
    };
    let small = collect("small", 6);
    let small = server.wait_for_job(&small, |job| job["state"] == "succeeded");
    succeed(dir.path(), &["publish", &paper(), "--name", "mine"]);
    let large = collect("large", 40);
    server.wait_for_job(&large, |job| job["progress"]["done"].as_u64() > Some(0));
    let told = succeed(dir.path(), &["backup", "monday"]);
    assert!(
        told.contains(" files with ") && told.contains("are in monday"),
        "{told}"
    );
    drop(server);

    let backup = dir.path().join("monday").display().to_string();
    succeed(other.path(), &["restore", &backup]);
    for part in ["models", "datasets/small"] {
        let (original, restored) = (dir.path().join("data").join(part), other.path().join("data").join(part));
        let original = contents(&original);
        assert!(!original.is_empty() && original == contents(&restored), "{part}");
    }
    let server = RunningServer::start(other.path(), &["--set", "job_lease_ms=1000"]);
    let job = server.wait_for_job(small["id"].as_str().unwrap(), |_| true);
    assert_eq!(job, small);
    assert_eq!(server.ask("GET", "/v1/models/mine", &Value::Null)["active_version"], 1);
    server.wait_for_job(&large, |job| job["state"] == "succeeded");
}

#[tokio::test]
async fn a_backup_of_a_stopped_server_holds_its_keys() {
    let dir = tempfile::tempdir().unwrap();
    let key = succeed(dir.path(), &["keys", "create", "robot"]);
    succeed(dir.path(), &["publish", &paper(), "--name", "mine"]);
    succeed(dir.path(), &["backup", "tuesday"]);
    succeed(dir.path(), &["restore", "tuesday", "--data-dir", "restored"]);
    let config = StoreConfig {
        data_dir: dir.path().join("restored"),
        ..StoreConfig::default()
    };
    let store = Store::open(&config).await.unwrap();
    let keys = store.list_keys().await.unwrap();
    assert!(keys.len() == 1 && key.contains(&keys[0].id) && store.keys_were_created());
    let versions = store.published_versions().await.unwrap();
    assert_eq!((versions[0].0.as_str(), versions[0].1), ("mine", 1));
}

#[test]
fn a_damaged_backup_is_not_restored() {
    let dir = tempfile::tempdir().unwrap();
    succeed(dir.path(), &["publish", &paper(), "--name", "mine"]);
    succeed(dir.path(), &["backup", "wednesday"]);
    let weights = dir.path().join("wednesday/models/mine/1/model.safetensors");
    let whole = std::fs::read(&weights).unwrap();
    let mut damaged = whole.clone();
    damaged[whole.len() / 2] ^= 0x55;
    std::fs::write(&weights, damaged).unwrap();
    let restore = ["restore", "wednesday", "--data-dir", "restored"];
    let refused = fail(dir.path(), &restore);
    assert!(refused.contains("model.safetensors is damaged or missing"), "{refused}");
    let refused = fail(dir.path(), &["models", "list", "--data-dir", "restored"]);
    assert!(
        refused.contains("the restore into restored did not finish"),
        "{refused}"
    );
    std::fs::write(&weights, whole).unwrap();
    succeed(dir.path(), &restore);
    let listed = succeed(dir.path(), &["models", "list", "--data-dir", "restored"]);
    assert!(listed.contains("mine"), "{listed}");
    // What was restored is not overwritten.
    assert!(fail(dir.path(), &restore).contains("is not empty"));
}

/// A directory with the backups `one` and, with another model, `two`.
fn two_backups() -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    for (model, backup) in [("mine", "one"), ("other", "two")] {
        succeed(dir.path(), &["publish", &paper(), "--name", model]);
        succeed(dir.path(), &["backup", backup]);
    }
    dir
}

#[test]
fn a_restore_killed_early_is_finished_by_the_next_one() {
    let dir = two_backups();
    let restored = dir.path().join("restored");
    let restore = |backup: &str| succeed(dir.path(), &["restore", backup, "--data-dir", "restored"]);
    let partial = format!("restore-unfinished.{:016x}.partial", 7);
    // What a kill leaves: of an older version, a half-written marker or a whole one; of this version, an empty one.
    for (left, content, is_noticed) in [
        (partial.as_str(), "foreframe rest", false),
        ("restore-unfinished", "", true),
        ("restore-unfinished", "foreframe restore did not finish\n", true),
    ] {
        std::fs::create_dir(&restored).unwrap();
        std::fs::write(restored.join(left), content).unwrap();
        if is_noticed {
            let refused = fail(
                dir.path(),
                &["serve", "--bind", "127.0.0.1:0", "--data-dir", "restored"],
            );
            assert!(
                refused.contains("the restore into restored did not finish"),
                "{refused}"
            );
        }
        restore("one");
        assert_eq!(contents(&restored), contents_of_backup(&dir.path().join("one")));
        std::fs::remove_dir_all(&restored).unwrap();
    }
}

#[test]
fn a_restore_of_another_backup_removes_the_first_ones_files() {
    let dir = two_backups();
    let restored = dir.path().join("restored");
    succeed(dir.path(), &["restore", "two", "--data-dir", "restored"]);
    let names: Vec<PathBuf> = contents(&restored).into_iter().map(|(path, _)| path).collect();
    // As after a kill behind the last copy.
    let marker = serde_json::json!({"database": restored.join("foreframe.db"), "files": names});
    std::fs::write(restored.join("restore-unfinished"), marker.to_string()).unwrap();
    succeed(dir.path(), &["restore", "one", "--data-dir", "restored"]);
    assert_eq!(contents(&restored), contents_of_backup(&dir.path().join("one")));
}

#[test]
fn an_unfinished_restore_does_not_allow_another_database() {
    let dir = two_backups();
    succeed(dir.path(), &["keys", "create", "robot", "--data-dir", "live"]);
    let live = std::fs::read(dir.path().join("live/foreframe.db")).unwrap();
    let restored = dir.path().join("restored");
    std::fs::create_dir(&restored).unwrap();
    std::fs::write(restored.join("restore-unfinished"), "").unwrap();
    let elsewhere = [
        "restore",
        "one",
        "--data-dir",
        "restored",
        "--database-url",
        "sqlite:live/foreframe.db",
    ];
    let refused = fail(dir.path(), &elsewhere);
    assert!(refused.contains("foreframe.db is not empty"), "{refused}");
    assert_eq!(std::fs::read(dir.path().join("live/foreframe.db")).unwrap(), live);
    succeed(dir.path(), &["restore", "one", "--data-dir", "restored"]);
    assert_eq!(contents(&restored), contents_of_backup(&dir.path().join("one")));
}

#[test]
fn two_restores_into_one_directory_do_not_run_at_once() {
    let dir = two_backups();
    let restored = dir.path().join("restored");
    std::fs::create_dir(&restored).unwrap();
    let lock = std::fs::File::create(restored.join("restore.lock")).unwrap();
    lock.lock().unwrap();
    let restore = ["restore", "one", "--data-dir", "restored"];
    let refused = fail(dir.path(), &restore);
    assert!(refused.contains("is running; wait for its end"), "{refused}");
    drop(lock);
    succeed(dir.path(), &restore);
    assert_eq!(contents(&restored), contents_of_backup(&dir.path().join("one")));
}

#[test]
fn a_restore_killed_at_any_time_leaves_no_file_of_another_backup() {
    let dir = two_backups();
    let restored = dir.path().join("restored");
    let whole = contents_of_backup(&dir.path().join("two"));
    for delay_ms in [0, 1, 2, 4, 8, 16, 32] {
        let mut killed = crate::process::foreframe(dir.path())
            .args(["restore", "two", "--data-dir", "restored"])
            .stdout(std::process::Stdio::null())
            .spawn()
            .unwrap();
        std::thread::sleep(std::time::Duration::from_millis(delay_ms));
        // On Unix this is SIGKILL.
        killed.kill().unwrap();
        killed.wait().unwrap();
        let mut left = if restored.exists() {
            contents(&restored)
        } else {
            Vec::new()
        };
        left.retain(|(path, _)| path != Path::new("restore.lock"));
        if left == whole {
            // The restore had ended, though the process perhaps had not.
            std::fs::remove_dir_all(&restored).unwrap();
        }
        succeed(dir.path(), &["restore", "one", "--data-dir", "restored"]);
        assert_eq!(contents(&restored), contents_of_backup(&dir.path().join("one")));
        std::fs::remove_dir_all(&restored).unwrap();
    }
}

/// The files of a backup without the list of them.
fn contents_of_backup(backup: &Path) -> Vec<(PathBuf, Vec<u8>)> {
    let mut files = contents(backup);
    files.retain(|(path, _)| path != Path::new("backup.json"));
    files
}

#[test]
fn a_backup_needs_a_store_and_a_directory_of_its_own() {
    let dir = tempfile::tempdir().unwrap();
    assert!(fail(dir.path(), &["backup", "b"]).contains("there is nothing to back up in data"));
    succeed(dir.path(), &["keys", "create", "ada"]);
    std::fs::create_dir(dir.path().join("full")).unwrap();
    std::fs::write(dir.path().join("full/file"), "").unwrap();
    assert!(fail(dir.path(), &["backup", "full"]).contains("full is not empty"));
    assert!(fail(dir.path(), &["backup", "data/inside"]).contains("is in the data directory"));
    assert!(fail(dir.path(), &["restore", "full", "--data-dir", "d"]).contains("holds no complete backup"));
}
