//! The checks at the end of a run: what was acknowledged is there, once and undamaged.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::{Duration, Instant};

use foreframe_core::registry;
use foreframe_data::dataset::Dataset;
use serde_json::{Value, json};

use super::changes::{COLLECTED, MODEL, numbers};
use super::shared::{EnduranceRun, RunClient};
use crate::http::{Http, Request};
use crate::report::Bounds;

/// How long the jobs that still wait may take together.
const JOB_LIMIT: Duration = Duration::from_mins(10);
const POLL: Duration = Duration::from_millis(500);
/// What the reason of a job says that failed because the disk was full.
const DISK_FULL: [&str; 3] = ["No space left", "StorageFull", "disk is full"];

/// The jobs of a run, by id.
pub(super) struct EndedJobs(BTreeMap<String, Value>);

impl EndedJobs {
    /// Waits until all jobs have ended. Jobs that failed because the disk was full are resumed.
    pub(super) async fn wait(run: &Arc<EnduranceRun>, bounds: &mut Bounds) -> Self {
        let (mut client, since) = (RunClient::new(run, "checks"), Instant::now());
        let (mut resumed, mut open_before) = (BTreeSet::new(), 0);
        let jobs = loop {
            let answer = client.until_answered(&Request::get("/v1/jobs?limit=1000")).await;
            let jobs = by_id(&answer.json());
            for (id, job) in &jobs {
                let reason = job["error"].as_str().unwrap_or_default();
                if DISK_FULL.iter().any(|text| reason.contains(text)) && !resumed.contains(id) {
                    let path = format!("/v1/jobs/{id}/resume");
                    let answer = client.until_answered(&Request::json(&path, &json!({}))).await;
                    // 409: it was resumed by a request whose answer was lost.
                    client.expect(&answer, &[202, 409]);
                    resumed.insert(id.clone());
                }
            }
            let is_open = |job: &Value| job["state"] == "queued" || job["state"] == "running";
            let open = jobs.values().filter(|job| is_open(job)).count();
            if since.elapsed() > JOB_LIMIT || open == 0 {
                break jobs;
            }
            if open != open_before {
                println!("{open} jobs have not ended");
                open_before = open;
            }
            tokio::time::sleep(POLL).await;
        };
        println!(
            "all jobs ended {:.1} s after the load; {} had failed on the full disk and were resumed",
            since.elapsed().as_secs_f64(),
            resumed.len()
        );
        let jobs = Self(jobs);
        jobs.check(run, bounds);
        jobs
    }

    fn check(&self, run: &EnduranceRun, bounds: &mut Bounds) {
        let ledger = run.ledger.lock().unwrap();
        let lost = ledger.jobs.values().filter(|id| !self.0.contains_key(*id)).count();
        let count = ledger.jobs.len();
        bounds.check(
            lost == 0 && count > 0,
            format!("none of {count} acknowledged jobs is lost ({lost} are)"),
        );
        // The base data set's job was not submitted with a key.
        let extra = self.0.len() as i64 - count as i64 - 1;
        bounds.check(
            extra == 0,
            format!("each request made one job, though its answer was lost ({extra} more)"),
        );
        let mut states = BTreeMap::<&str, u64>::new();
        for (id, job) in &self.0 {
            let state = job["state"].as_str().unwrap_or_default();
            *states.entry(state).or_default() += 1;
            if state != "succeeded" {
                println!("  {id} {state}: {}", job["error"]);
            }
        }
        println!("  jobs: {states:?}");
        bounds.check(
            states.keys().eq(["succeeded"].iter()),
            "every job succeeded, at the latest when it was resumed after the full disk",
        );
    }

    /// The results of the succeeded jobs of a kind.
    fn results(&self, kind: &str) -> Vec<&Value> {
        let of_kind = self.0.values().filter(|job| job["spec"]["kind"] == kind);
        of_kind
            .map(|job| &job["result"])
            .filter(|result| !result.is_null())
            .collect()
    }
}

fn by_id(list: &Value) -> BTreeMap<String, Value> {
    assert!(list["next"].is_null(), "all jobs are on one page");
    let jobs = list["jobs"].as_array().expect("a list of jobs").iter();
    jobs.map(|job| (job["id"].as_str().unwrap_or_default().to_owned(), job.clone()))
        .collect()
}

/// Each training published one version; those that were not deleted are listed, load, and have the same weights.
pub(super) async fn versions(run: &Arc<EnduranceRun>, jobs: &EndedJobs, bounds: &mut Bounds) {
    let mut client = RunClient::new(run, "checks");
    let results = jobs.results("train");
    let published: BTreeSet<u64> = results.iter().filter_map(|result| result["version"].as_u64()).collect();
    bounds.check(
        published.len() == results.len() && !results.is_empty(),
        format!("{} trainings published {} versions", results.len(), published.len()),
    );
    let answer = client
        .until_answered(&Request::get(&format!("/v1/models/{MODEL}")))
        .await
        .json();
    let listed: BTreeSet<u64> = numbers(&answer["versions"]).into_iter().collect();
    let (deleted, active) = {
        let ledger = run.ledger.lock().unwrap();
        (ledger.deleted_versions.clone(), ledger.active_version)
    };
    let expected: BTreeSet<u64> = published.difference(&deleted).copied().collect();
    bounds.check(
        listed == expected,
        format!("the versions are {listed:?}: the published ones without the deleted ones, {expected:?}"),
    );
    bounds.check(
        active.is_none() || answer["active_version"].as_u64() == active,
        format!("the active version is the last that was activated, {active:?}"),
    );
    let mut weights = BTreeSet::new();
    let mut damaged = Vec::new();
    for version in &listed {
        match registry::load(&run.data_dir.join(format!("models/{MODEL}/{version}"))) {
            Ok(loaded) => drop(weights.insert(loaded.manifest.weights_sha256.clone())),
            Err(error) => damaged.push(error.to_string()),
        }
    }
    bounds.check(
        damaged.is_empty(),
        format!("every version loads and its hash is right {damaged:?}"),
    );
    bounds.check(
        weights.len() == 1,
        format!(
            "all trainings ended with the same weights, interrupted or not ({})",
            weights.len()
        ),
    );
}

/// The data sets that were collected and not deleted are listed and undamaged, and all have the same content.
pub(super) async fn datasets(run: &Arc<EnduranceRun>, jobs: &EndedJobs, bounds: &mut Bounds) {
    let mut client = RunClient::new(run, "checks");
    let answer = client
        .until_answered(&Request::get("/v1/datasets?limit=1000"))
        .await
        .json();
    let field = |dataset: &Value, field: &str| dataset[field].as_str().unwrap_or_default().to_owned();
    let list = answer["datasets"].as_array().expect("a list of data sets");
    let is_collected = |name: &String| name.starts_with(COLLECTED);
    let listed: BTreeSet<String> = list
        .iter()
        .map(|dataset| field(dataset, "name"))
        .filter(is_collected)
        .collect();
    let results = jobs.results("collect");
    let made = results
        .iter()
        .map(|result| field(result, "dataset"))
        .filter(is_collected);
    let deleted = run.ledger.lock().unwrap().deleted_datasets.clone();
    let expected: BTreeSet<String> = made.filter(|name| !deleted.contains(name)).collect();
    bounds.check(
        listed == expected && !listed.is_empty(),
        format!("the data sets are the collected ones without the deleted ones: {listed:?}, expected {expected:?}"),
    );
    let mut damaged = Vec::new();
    for name in &listed {
        let opened = Dataset::open(&run.data_dir.join("datasets").join(name));
        damaged.extend(opened.err().map(|error| error.to_string()));
    }
    bounds.check(
        damaged.is_empty(),
        format!("every file of every data set has its hash {damaged:?}"),
    );
    let contents: BTreeSet<String> = results
        .iter()
        .filter(|result| is_collected(&field(result, "dataset")))
        .map(|result| field(result, "content_hash"))
        .collect();
    bounds.check(
        contents.len() == 1,
        format!(
            "all collections ended with the same bytes, interrupted or not ({})",
            contents.len()
        ),
    );
}

/// Every key that was created and not revoked is accepted, every revoked one is refused.
pub(super) async fn keys(run: &Arc<EnduranceRun>, bounds: &mut Bounds) {
    let keys: Vec<(String, bool)> = {
        let ledger = run.ledger.lock().unwrap();
        ledger
            .keys
            .iter()
            .map(|key| (key.text.clone(), key.is_revoked))
            .collect()
    };
    let (mut http, mut wrong) = (Http::new(run.address), Vec::new());
    for (text, is_revoked) in &keys {
        let expected = if *is_revoked { 401 } else { 200 };
        let answer = http.ask(&Request::get("/v1/models").with_key(text)).await;
        let status = answer.map(|answer| answer.status).unwrap_or_default();
        if status != expected {
            wrong.push(format!("{status} instead of {expected}"));
        }
    }
    let revoked = keys.iter().filter(|(_, is_revoked)| *is_revoked).count();
    bounds.check(
        wrong.is_empty() && !keys.is_empty(),
        format!(
            "{} keys are accepted, {revoked} revoked ones refused {wrong:?}",
            keys.len() - revoked
        ),
    );
}
