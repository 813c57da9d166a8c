//! Jobs over HTTP, most with an executor that the test controls.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use axum::body::Body;
use axum::http::Request;
use foreframe::server::{App, AppParts, ServerConfig};
use foreframe_core::nn::Conditioning;
use foreframe_core::serving::{Predictor, PredictorConfig};
use foreframe_jobs::jobs::{JobError, JobExecutor, JobFailure, JobLimits, JobReporter, JobResult, JobSpec, Jobs};
use foreframe_jobs::store::JobId;
use foreframe_jobs::versions::Versions;
use futures_util::future::BoxFuture;
use serde_json::{Value, json};

use crate::service::{app, get, model, poll_until, post, run, send, spec, store, with_data};

const JOBS: &str = "/v1/jobs";

/// An executor whose jobs end as the test says, or when they are cancelled.
struct ScriptedExecutor {
    results: Mutex<Receiver<Result<(), JobFailure>>>,
    obeys_cancel: bool,
}

impl JobExecutor for ScriptedExecutor {
    fn check<'a>(&'a self, spec: &'a JobSpec) -> BoxFuture<'a, Result<JobSpec, JobError>> {
        Box::pin(async { Ok(spec.clone()) })
    }

    fn execute(&self, _: &JobSpec, report: &JobReporter, cancelled: &AtomicBool) -> Result<JobResult, JobFailure> {
        report.progress(3, 10, "pretending");
        report.line(format!("attempt {}", report.lease().token));
        let results = self.results.lock().unwrap();
        loop {
            if let Ok(finish) = results.recv_timeout(Duration::from_millis(1)) {
                return finish.map(|()| JobResult::default());
            }
            if self.obeys_cancel && cancelled.load(Ordering::Acquire) {
                return Err(JobFailure::Cancelled);
            }
        }
    }
}

fn scripted_app(dir: &std::path::Path, obeys_cancel: bool) -> (App, Sender<Result<(), JobFailure>>) {
    let (finish, results) = channel();
    let executor = ScriptedExecutor {
        results: Mutex::new(results),
        obeys_cancel,
    };
    let limits = JobLimits {
        queued: 2,
        ended: 10,
        ..ServerConfig::default().jobs()
    };
    let store = store(dir);
    let jobs = Jobs::start(store.clone(), limits, Arc::new(executor), true).unwrap();
    let predictor = Predictor::start(
        vec![model(dir, "plain", spec(Conditioning::None))],
        PredictorConfig::default(),
    );
    let config = ServerConfig {
        shutdown_deadline_ms: 300,
        ..with_data(dir, ServerConfig::default())
    };
    let parts = AppParts {
        predictor: predictor.unwrap(),
        jobs,
        versions: Versions::new(store.clone(), &config.models_dir),
        store,
    };
    (App::with_parts(config, parts), finish)
}

fn collect(name: &str) -> Value {
    json!({"kind": "collect", "name": name, "scenario": "static-observer", "trials": 12})
}

async fn wait_for_state(app: &App, id: &str, state: &str) -> Value {
    let path = format!("{JOBS}/{id}");
    poll_until(async || {
        let job = get(app, &path).await.json();
        let is_over = ["succeeded", "failed", "cancelled"].contains(&job["state"].as_str().unwrap());
        assert!(!is_over || job["state"] == state, "{job}");
        (job["state"] == state).then_some(job)
    })
    .await
}

#[tokio::test]
async fn a_job_reports_its_progress_and_outcome() {
    let dir = tempfile::tempdir().unwrap();
    let (app, finish) = scripted_app(dir.path(), true);
    let taken = post(&app, JOBS, &collect("a")).await;
    assert_eq!(
        (taken.status.as_u16(), &taken.headers["location"]),
        (202, &"/v1/jobs/job-1".parse().unwrap())
    );
    let job = wait_for_state(&app, "job-1", "running").await;
    assert_eq!(job["spec"]["scenario"], "static-observer");
    let progress = poll_until(async || {
        let job = get(&app, "/v1/jobs/job-1").await.json();
        (job["progress"]["total"] == 10).then_some(job["progress"].clone())
    });
    assert_eq!(progress.await["message"], "pretending");
    finish.send(Ok(())).unwrap();
    wait_for_state(&app, "job-1", "succeeded").await;

    post(&app, JOBS, &collect("b")).await;
    finish
        .send(Err(JobFailure::Failed("the disk is full".to_owned())))
        .unwrap();
    assert_eq!(
        wait_for_state(&app, "job-2", "failed").await["error"],
        "the disk is full"
    );
    let all = get(&app, JOBS).await.json();
    let ids: Vec<&Value> = all["jobs"].as_array().unwrap().iter().map(|job| &job["id"]).collect();
    assert_eq!(ids, ["job-2", "job-1"]);
}

#[tokio::test]
async fn queued_jobs_are_limited_and_cancelled_once() {
    let dir = tempfile::tempdir().unwrap();
    let (app, _order) = scripted_app(dir.path(), true);
    post(&app, JOBS, &collect("a")).await;
    wait_for_state(&app, "job-1", "running").await;
    for name in ["b", "c"] {
        assert_eq!(post(&app, JOBS, &collect(name)).await.status, 202);
    }
    let refused = post(&app, JOBS, &collect("d")).await;
    assert_eq!(
        refused.detail(503),
        "the job queue is full (2 jobs are waiting); cancel one or try again later"
    );
    assert_eq!(refused.headers["retry-after"], "1");
    let same = post(&app, "/v1/jobs/job-3/cancel", &Value::Null).await;
    assert_eq!(same.json()["state"], "cancelled");
    let taken = post(&app, JOBS, &collect("a")).await.detail(409);
    assert_eq!(
        taken,
        "name: data set \"a\" is the output of another job that has not ended; choose another name"
    );
    assert_eq!(
        post(&app, "/v1/jobs/job-1/cancel", &Value::Null).await.json()["cancelling"],
        true
    );
    wait_for_state(&app, "job-1", "cancelled").await;
    let again = post(&app, "/v1/jobs/job-1/cancel", &Value::Null).await.detail(409);
    assert_eq!(
        again,
        "job job-1 is cancelled; only a queued or running job can be cancelled"
    );
    assert_eq!(
        get(&app, "/v1/jobs/job-77").await.detail(404),
        "there is no job \"job-77\"; only the latest ended jobs are kept"
    );
}

#[tokio::test]
async fn a_stopping_server_leaves_jobs_for_the_next_start() {
    for obeys_cancel in [true, false] {
        let dir = tempfile::tempdir().unwrap();
        let (app, finish) = scripted_app(dir.path(), obeys_cancel);
        let server = run(app.clone()).await;
        post(&app, JOBS, &collect("a")).await;
        post(&app, JOBS, &collect("b")).await;
        wait_for_state(&app, "job-1", "running").await;
        let started = Instant::now();
        server.stop().await;
        assert!(started.elapsed() < Duration::from_secs(10));
        let expected = if obeys_cancel { "queued" } else { "running" };
        assert_eq!(get(&app, "/v1/jobs/job-1").await.json()["state"], expected);
        assert_eq!(get(&app, "/v1/jobs/job-2").await.json()["state"], "queued");
        assert!(post(&app, JOBS, &collect("c")).await.detail(503).contains("stopping"));
        finish.send(Ok(())).ok();
        if obeys_cancel {
            let (next, finish) = scripted_app(dir.path(), true);
            finish.send(Ok(())).unwrap();
            finish.send(Ok(())).unwrap();
            assert_eq!(wait_for_state(&next, "job-1", "succeeded").await["attempts"], 2);
            wait_for_state(&next, "job-2", "succeeded").await;
        }
    }
}

#[tokio::test]
async fn only_cancelled_or_failed_jobs_can_be_resumed() {
    let dir = tempfile::tempdir().unwrap();
    let (app, finish) = scripted_app(dir.path(), true);
    post(&app, JOBS, &collect("a")).await;
    wait_for_state(&app, "job-1", "running").await;
    let early = post(&app, "/v1/jobs/job-1/resume", &Value::Null).await.detail(409);
    assert_eq!(
        early,
        "job job-1 is running; only a failed or cancelled job can be resumed"
    );
    post(&app, "/v1/jobs/job-1/cancel", &Value::Null).await;
    wait_for_state(&app, "job-1", "cancelled").await;
    let resumed = post(&app, "/v1/jobs/job-1/resume", &Value::Null).await.json()["state"].clone();
    // A runner can have claimed it before it was read for the answer.
    assert!(resumed == "queued" || resumed == "running", "{resumed}");
    finish.send(Err(JobFailure::Failed("no luck".to_owned()))).unwrap();
    let path = "/v1/jobs/job-1";
    let failed = poll_until(async || Some(get(&app, path).await.json()).filter(|job| job["state"] == "failed")).await;
    assert_eq!((&failed["error"], &failed["attempts"]), (&json!("no luck"), &json!(2)));
    post(&app, "/v1/jobs/job-1/resume", &Value::Null).await;
    finish.send(Ok(())).unwrap();
    let done = poll_until(async || Some(get(&app, path).await.json()).filter(|job| job["state"] == "succeeded")).await;
    assert_eq!((&done["error"], &done["attempts"]), (&Value::Null, &json!(3)));
    assert_eq!(post(&app, "/v1/jobs/job-1/resume", &Value::Null).await.status, 409);
    let lines = get(&app, "/v1/jobs/job-1/logs?after=1&limit=1").await.json();
    assert_eq!(
        (&lines["lines"][0]["seq"], &lines["lines"][0]["line"]),
        (&json!(2), &json!("attempt 1"))
    );
    assert_eq!(lines["lines"].as_array().unwrap().len(), 1);
}

#[tokio::test]
async fn a_runner_that_lost_its_lease_writes_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let (app, _order) = scripted_app(dir.path(), true);
    post(&app, JOBS, &collect("a")).await;
    let log = async || get(&app, "/v1/jobs/job-1/logs").await.json()["lines"].clone();
    poll_until(async || (log().await[1]["line"] == "attempt 1").then_some(())).await;
    // Another process claims the job; by its clock the lease has expired.
    let (row, other_lease) = app.store().claim_at("another", 1e12, 2e12).await.unwrap().unwrap();
    assert_eq!((row.id, other_lease.token), (JobId::new(1), 2));
    post(&app, JOBS, &collect("b")).await;
    // The runner starts the next job after it has noticed that it lost the lease.
    wait_for_state(&app, "job-2", "running").await;
    let job = get(&app, "/v1/jobs/job-1").await.json();
    assert_eq!((&job["state"], &job["attempts"]), (&json!("running"), &json!(2)));
    assert_eq!(log().await.as_array().unwrap().len(), 2);
}

#[tokio::test]
async fn an_idempotency_key_creates_one_job() {
    let dir = tempfile::tempdir().unwrap();
    let (app, finish) = scripted_app(dir.path(), true);
    let ask = async |body: Value, key: &str| {
        let request = Request::post(JOBS)
            .header("content-type", "application/json")
            .header("idempotency-key", key)
            .body(Body::from(body.to_string()))
            .unwrap();
        send(&app, request).await
    };
    assert_eq!(ask(collect("a"), "k-1").await.json()["id"], "job-1");
    finish.send(Ok(())).unwrap();
    wait_for_state(&app, "job-1", "succeeded").await;
    assert_eq!(ask(collect("a"), "k-1").await.json()["state"], "succeeded");
    let other = ask(collect("b"), "k-1").await.detail(422);
    assert!(
        other.starts_with("Idempotency-Key: it was used for a different job, job-1"),
        "{other}"
    );
    let long = ask(collect("b"), &"k".repeat(129)).await.detail(422);
    assert_eq!(long, "Idempotency-Key: a key is 1 to 128 visible ASCII characters");
    assert_eq!(ask(collect("b"), "k-2").await.json()["id"], "job-2");
}

#[tokio::test]
async fn jobs_are_listed_by_kind_and_state_in_pages() {
    let dir = tempfile::tempdir().unwrap();
    let (app, _order) = scripted_app(dir.path(), true);
    for name in ["a", "b", "c"] {
        post(&app, JOBS, &collect(name)).await;
        if name == "a" {
            wait_for_state(&app, "job-1", "running").await;
        }
    }
    let ids = async |query: &str| {
        let answer = get(&app, &format!("{JOBS}?{query}")).await.json();
        let ids = answer["jobs"]
            .as_array()
            .unwrap()
            .iter()
            .map(|job| job["id"].as_str().unwrap().to_owned());
        (ids.collect::<Vec<_>>(), answer["next"].clone())
    };
    assert_eq!(
        ids("limit=2").await,
        (vec!["job-3".to_owned(), "job-2".to_owned()], json!("job-2"))
    );
    assert_eq!(
        ids("limit=2&before=job-2").await,
        (vec!["job-1".to_owned()], Value::Null)
    );
    assert_eq!(ids("state=running").await.0, ["job-1"]);
    assert_eq!(ids("kind=train").await.0, [""; 0]);
    for (query, part) in [
        (
            "kind=dream",
            "there is no kind \"dream\"; there are: collect, import, train, adapt, evaluate",
        ),
        ("state=asleep", "unknown variant `asleep`"),
        ("before=7", "\"7\" is not a job id"),
        ("limit=0", "limit is 0; it must be 1 to 1000"),
        ("colour=red", "unknown field `colour`"),
    ] {
        let detail = get(&app, &format!("{JOBS}?{query}")).await.detail(422);
        assert!(detail.contains(part), "{detail}");
    }
}

#[tokio::test]
async fn job_events_last_until_the_job_ends() {
    let dir = tempfile::tempdir().unwrap();
    let (app, finish) = scripted_app(dir.path(), true);
    post(&app, JOBS, &collect("a")).await;
    finish.send(Ok(())).unwrap();
    let seen = get(&app, "/v1/jobs/job-1/events").await;
    assert_eq!(seen.headers["content-type"], "text/event-stream");
    let text = String::from_utf8(seen.body).unwrap();
    assert!(text.contains("event: log\ndata: {\"seq\":1,"), "{text}");
    assert!(text.contains("\"line\":\"attempt 1\""), "{text}");
    assert!(
        text.trim_end()
            .rsplit("event: ")
            .next()
            .unwrap()
            .contains("\"state\":\"succeeded\""),
        "{text}"
    );
    assert_eq!(get(&app, "/v1/jobs/job-9/events").await.status, 404);
}

#[tokio::test]
async fn open_job_events_do_not_delay_shutdown() {
    let dir = tempfile::tempdir().unwrap();
    let (app, _finish) = scripted_app(dir.path(), true);
    post(&app, JOBS, &collect("a")).await;
    let watched = app.clone();
    let watcher = tokio::spawn(async move { get(&watched, "/v1/jobs/job-1/events").await });
    wait_for_state(&app, "job-1", "running").await;
    run(app.clone()).await.stop().await;
    let text = String::from_utf8(watcher.await.unwrap().body).unwrap();
    assert!(!text.contains("succeeded"), "{text}");
}

#[tokio::test]
async fn the_servers_events_announce_its_lists_and_its_stop() {
    let dir = tempfile::tempdir().unwrap();
    let (app, _finish) = scripted_app(dir.path(), true);
    post(&app, JOBS, &collect("a")).await;
    wait_for_state(&app, "job-1", "running").await;
    let watched = app.clone();
    let watcher = tokio::spawn(async move { get(&watched, "/v1/events").await });
    run(app.clone()).await.stop().await;
    let text = String::from_utf8(watcher.await.unwrap().body).unwrap();
    let names: Vec<&str> = text.lines().filter_map(|line| line.strip_prefix("event: ")).collect();
    assert_eq!(names[..2], ["models", "jobs"], "{text}");
    assert_eq!(names.last(), Some(&"stopping"), "{text}");
}

#[tokio::test]
async fn an_invalid_job_is_refused_at_submission() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let train = |more: Value| {
        let mut body = json!({"kind": "train", "name": "new", "preset": "paper", "dataset": "none"});
        body.as_object_mut().unwrap().extend(more.as_object().unwrap().clone());
        body
    };
    let mut wild = collect("a");
    wild["scenario"] = json!("wild");
    let mut zero = collect("a");
    zero["trials"] = json!(0);
    for (body, status, detail) in [
        (wild, 422, "moving-observer"),
        (
            zero,
            422,
            "trials: 0 is out of range; 1 to 1000000 trials can be collected",
        ),
        (collect("../up"), 422, "name: \"../up\" is not a valid name"),
        (
            train(json!({})),
            422,
            "dataset: there is no data set \"none\"; there are: none yet",
        ),
        (
            train(json!({"preset": "papr"})),
            422,
            "preset: there is no preset \"papr\"; there are: paper, static, moving",
        ),
        (
            train(json!({"settings": {"sequence": {"stepz": 1}}})),
            422,
            "unknown field `stepz`",
        ),
        (train(json!({"colour": 1})), 422, "unknown field `colour`"),
        (
            json!({"kind": "dream"}),
            422,
            "kind: there is no kind \"dream\"; there are: collect, import, train, adapt, evaluate",
        ),
    ] {
        let answer = post(&app, JOBS, &body).await.detail(status);
        assert!(answer.contains(detail), "{answer}");
    }
    assert_eq!(get(&app, JOBS).await.json()["jobs"], json!([]));
}
