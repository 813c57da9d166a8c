//! Clients of the ordinary load that change something: jobs, versions, data sets and API keys. Each change is repeated until
//! it is acknowledged, and then remembered.

use std::process::Command;
use std::sync::Arc;
use std::time::Duration;

use serde_json::{Value, json};
use tokio::time::sleep;

use super::requests::BASE;
use super::shared::{CreatedKey, EnduranceRun, RunClient};
use crate::http::Request;
use crate::project;

const JOB_PERIOD: Duration = Duration::from_secs(4);
/// Every third job is a training.
const TRAIN_EVERY: u64 = 3;
const VERSION_PERIOD: Duration = Duration::from_secs(5);
const DATASET_PERIOD: Duration = Duration::from_secs(7);
const KEY_PERIOD: Duration = Duration::from_secs(8);
const BASE_TRIALS: u64 = 12;
/// Versions and collected data sets that are kept; older ones are deleted.
const KEPT: usize = 3;
/// The name of the trained model.
pub(super) const MODEL: &str = "trained";
/// Prefix of the names of the collected data sets.
pub(super) const COLLECTED: &str = "set-";

/// Submits jobs at a steady pace.
pub(super) async fn jobs(run: Arc<EnduranceRun>) {
    let mut client = RunClient::new(&run, "jobs");
    for number in 0.. {
        if run.is_over() {
            return;
        }
        let spec = if number % TRAIN_EVERY == 0 {
            train()
        } else {
            collect(number)
        };
        let key = format!("endurance-{number}");
        let request = Request::json("/v1/jobs", &spec).with_header("idempotency-key", &key);
        let answer = client.until_answered(&request).await;
        if client.expect(&answer, &[202]) {
            let id = answer.json()["id"].as_str().expect("a job has an id").to_owned();
            run.ledger.lock().unwrap().jobs.insert(key, id);
        }
        sleep(JOB_PERIOD).await;
    }
}

/// The job of the base data set.
pub(super) fn base() -> Value {
    json!({"kind": "collect", "name": BASE, "scenario": "static-observer", "trials": BASE_TRIALS})
}

/// All collections have the same seed, so all data sets have the same content.
fn collect(number: u64) -> Value {
    json!({"kind": "collect", "name": format!("{COLLECTED}{number:05}"), "scenario": "static-observer", "trials": 3})
}

/// All trainings have the same settings, so all versions have the same weights.
fn train() -> Value {
    let settings = json!({
        "model": {"features": 16, "hidden": 16},
        "data": {"windows": 64, "validation_windows": 8},
        "pretrain": {"steps": 10, "batch_size": 16, "start": "random"},
        "sequence": {"steps": 40, "batch_size": 16},
        "run": {"validate_every_steps": 20, "checkpoint_every_steps": 4},
    });
    json!({"kind": "train", "name": MODEL, "preset": "paper", "dataset": BASE, "settings": settings})
}

/// Activates the newest version and deletes the oldest.
pub(super) async fn versions(run: Arc<EnduranceRun>) {
    let mut client = RunClient::new(&run, "versions");
    let model = format!("/v1/models/{MODEL}");
    while !run.is_over() {
        sleep(VERSION_PERIOD).await;
        let answer = client.until_answered(&Request::get(&model)).await;
        // Until the first training has ended, there is no such model.
        if answer.status == 404 || !client.expect(&answer, &[200]) {
            continue;
        }
        let versions = numbers(&answer.json()["versions"]);
        let Some(&newest) = versions.last() else { continue };
        let path = format!("{model}/versions/{newest}/activate");
        let answer = client.until_answered(&Request::json(&path, &json!({}))).await;
        if client.expect(&answer, &[200]) {
            run.ledger.lock().unwrap().active_version = Some(newest);
        }
        for &oldest in versions.iter().take(versions.len().saturating_sub(KEPT)) {
            let path = format!("{model}/versions/{oldest}");
            let answer = client.until_answered(&Request::delete(&path)).await;
            // 404: it was deleted by a request whose answer was lost.
            if client.expect(&answer, &[204, 404]) {
                run.ledger.lock().unwrap().deleted_versions.insert(oldest);
            }
        }
    }
}

pub(super) fn numbers(list: &Value) -> Vec<u64> {
    serde_json::from_value(list.clone()).expect("versions are numbers")
}

/// Deletes the oldest of the collected data sets.
pub(super) async fn datasets(run: Arc<EnduranceRun>) {
    let mut client = RunClient::new(&run, "data sets");
    while !run.is_over() {
        sleep(DATASET_PERIOD).await;
        let answer = client.until_answered(&Request::get("/v1/datasets?limit=1000")).await;
        if !client.expect(&answer, &[200]) {
            continue;
        }
        let names = dataset_names(&answer.json());
        for oldest in names.iter().take(names.len().saturating_sub(KEPT)) {
            let answer = client
                .until_answered(&Request::delete(&format!("/v1/datasets/{oldest}")))
                .await;
            // 409: the job that made it has not ended yet.
            if client.expect(&answer, &[204, 404, 409]) && answer.status != 409 {
                run.ledger.lock().unwrap().deleted_datasets.insert(oldest.clone());
            }
        }
    }
}

/// The names of the collected data sets, the oldest first.
fn dataset_names(list: &Value) -> Vec<String> {
    let names = list["datasets"].as_array().expect("a list of data sets").iter();
    names
        .filter_map(|dataset| dataset["name"].as_str())
        .filter(|name| name.starts_with(COLLECTED))
        .map(str::to_owned)
        .collect()
}

/// Creates keys by the command line, and revokes every second one.
pub(super) async fn keys(run: Arc<EnduranceRun>) {
    let mut is_revoked = false;
    while !run.is_over() {
        sleep(KEY_PERIOD).await;
        let Some(text) = command(&run, &["keys", "create", "endurance", "--scope", "predict"]).await else {
            continue;
        };
        let mut key = CreatedKey {
            text,
            is_revoked: false,
        };
        if is_revoked {
            key.is_revoked = revoke(&run, key.id()).await;
        }
        is_revoked = !is_revoked;
        run.ledger.lock().unwrap().keys.push(key);
    }
}

/// Revokes a key. After a failure its state is unknown, so this is repeated.
async fn revoke(run: &EnduranceRun, id: &str) -> bool {
    loop {
        let before = command(run, &["keys", "list"]).await;
        let is_valid = before.is_some_and(|list| {
            list.lines()
                .any(|line| line.starts_with(id) && line.contains(" valid "))
        });
        if is_valid && command(run, &["keys", "revoke", id]).await.is_some() {
            return true;
        }
        let list = command(run, &["keys", "list"]).await.unwrap_or_default();
        if list
            .lines()
            .any(|line| line.starts_with(id) && line.contains(" revoked "))
        {
            return true;
        }
    }
}

/// The output of a command on the run's store; `None` if it failed, as it may while the store is away.
pub(super) async fn command(run: &EnduranceRun, arguments: &[&str]) -> Option<String> {
    let mut command = Command::new(project::program());
    command
        .args(arguments)
        .arg("--data-dir")
        .arg(&run.data_dir)
        .args(&run.store_arguments)
        .current_dir(project::root());
    let output = tokio::task::spawn_blocking(move || command.output().unwrap());
    let output = output.await.unwrap();
    let is_done = output.status.success();
    run.count("keys", |counts| {
        *if is_done {
            &mut counts.answered
        } else {
            &mut counts.refused
        } += 1;
    });
    is_done.then(|| String::from_utf8(output.stdout).unwrap().trim().to_owned())
}
