//! Machines whose clocks are wrong: leases, the expiry of keys and the order in which jobs ended go by the database's clock.

use std::path::Path;

use serde_json::json;

use crate::process::{RunningServer, foreframe, output, text};
use crate::store_away::{OwnPostgres, status};

/// Where this machine's wall clock is read, and what for. Whatever is decided by a time has to go by `Store::now_s` or by a
/// monotonic clock.
const WALL_CLOCK: [(&str, &str); 13] = [
    (
        "crates/core/src/files.rs",
        "the age of partial files, against times of the same file system",
    ),
    ("crates/jobs/src/jobs.rs", "imports it for the report"),
    (
        "crates/jobs/src/jobs/report.rs",
        "the time of log lines, the rate that is shown",
    ),
    ("src/server/http/middleware.rs", "ids of requests"),
    ("src/server/inference_statistics.rs", "the time that is shown"),
    ("crates/jobs/src/store.rs", "defines it"),
    ("crates/jobs/src/store/audit.rs", "the time that is shown"),
    (
        "crates/jobs/src/store/backup.rs",
        "the time that is shown; whether a file changed",
    ),
    ("src/server/routes/world_sessions.rs", "the time that is shown"),
    ("src/telemetry/prometheus.rs", "the start of the process"),
    (
        "crates/train/src/training/event_file.rs",
        "names of files, the time that is shown",
    ),
    ("crates/jobs/src/versions.rs", "the times that are shown"),
    ("crates/jobs/src/versions/publish.rs", "the times that are shown"),
];

#[test]
fn only_times_that_are_shown_come_from_the_wall_clock() {
    let mut found = Vec::new();
    let mut dirs = ["src", "crates"].map(|root| Path::new(root).to_owned()).to_vec();
    while let Some(dir) = dirs.pop() {
        for entry in std::fs::read_dir(dir).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                dirs.push(path);
            } else if path.extension().is_some_and(|extension| extension == "rs") {
                let source = std::fs::read_to_string(&path).unwrap();
                if ["SystemTime::now", "unix_s()", "unix_s}", "UNIX_EPOCH.elapsed"]
                    .iter()
                    .any(|read| source.contains(read))
                {
                    found.push(path.display().to_string());
                }
            }
        }
    }
    found.retain(|path| !WALL_CLOCK.iter().any(|(known, _)| known == path));
    assert!(
        found.is_empty(),
        "{found:?} read the wall clock: decide by Store::now_s, or add what it is for here"
    );
}

/// Shifts the database's clock, in place of this machine's, which a test cannot set.
fn shift_clock(postgres: &OwnPostgres, hours: i32) {
    let port = postgres.port().to_string();
    let sql = format!(
        "CREATE SCHEMA IF NOT EXISTS shifted; \
         CREATE OR REPLACE FUNCTION shifted.clock_timestamp() RETURNS timestamptz LANGUAGE sql AS \
         $$ SELECT pg_catalog.clock_timestamp() + interval '{hours} hours' $$; \
         ALTER DATABASE postgres SET search_path = shifted, public, pg_catalog"
    );
    let connection = [
        "-h",
        "127.0.0.1",
        "-p",
        &port,
        "-U",
        "foreframe",
        "-d",
        "postgres",
        "-c",
    ];
    postgres.succeed("psql", &[&connection[..], &[&sql]].concat());
}

#[test]
fn a_clock_that_is_an_hour_wrong_changes_no_lease_and_no_key() {
    for hours in [-1, 1] {
        let Some(postgres) = OwnPostgres::new() else { return };
        postgres.start();
        shift_clock(&postgres, hours);
        let (dir, url) = (tempfile::tempdir().unwrap(), postgres.url());
        let created = output(
            dir.path(),
            &["keys", "create", "robot", "--expires", "30m", "--database-url", &url],
        );
        assert!(created.status.success(), "{}", text(&created.stderr));
        let listed = text(&output(dir.path(), &["keys", "list", "--database-url", &url]).stdout);
        assert!(
            listed.contains(" valid ") && listed.contains("expires in 0.0 days"),
            "{listed}"
        );
        let settings = [
            "--database-url",
            &url,
            "--set",
            "job_lease_ms=2000",
            "--set",
            "key_refresh_ms=100",
        ];
        let key = text(&created.stdout);
        let server =
            RunningServer::start(dir.path(), &[&["--run-jobs", "false"], &settings[..]].concat()).with_key(key.trim());
        assert_eq!(status(&server.get("/v1/jobs")), "200");
        let collect = json!({"kind": "collect", "name": "a", "scenario": "static-observer", "trials": 400});
        assert_eq!(server.ask("POST", "/v1/jobs", &collect)["id"], "job-1");
        // The first worker is killed; the second has to wait only for the lease.
        let state = |expected: &str, attempts: u64| {
            server.wait_for_job("job-1", |job| {
                job["state"] == expected && job["attempts"].as_u64() >= Some(attempts)
            })
        };
        for attempt in 1..=2 {
            let own = tempfile::tempdir().unwrap();
            let mut worker = foreframe(own.path());
            worker.arg("worker").args(settings);
            let mut worker = worker.spawn().unwrap();
            state("running", attempt);
            worker.kill().unwrap();
            worker.wait().unwrap();
        }
    }
}
