//! Jobs over HTTP: with work that the test holds in its hand, and with the real collection and training.

use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::time::{Duration, Instant};

use foreframe::jobs::{Execute, Failure, JobError, JobSpec, Jobs, Report, TableLimits};
use foreframe::nn::Conditioning;
use foreframe::server::{App, ServerConfig};
use foreframe::serving::{Predictor, PredictorConfig};
use serde_json::{Value, json};

use crate::service::{app, context, get, model, post, run, spec, until, with_data};

const JOBS: &str = "/v1/jobs";

/// Work that does what the test says, and looks at its flag.
struct Puppet {
    orders: Mutex<Receiver<Result<(), Failure>>>,
    heeds_cancel: bool,
}

impl Execute for Puppet {
    fn check(&self, _: &JobSpec) -> Result<(), JobError> {
        Ok(())
    }

    fn execute(&self, _: &JobSpec, report: &Report<'_>, cancelled: &AtomicBool) -> Result<(), Failure> {
        report.progress(3, 10, "pretending");
        let orders = self.orders.lock().unwrap();
        loop {
            if let Ok(order) = orders.recv_timeout(Duration::from_millis(1)) {
                return order;
            }
            if self.heeds_cancel && cancelled.load(Ordering::Acquire) {
                return Err(Failure::Cancelled);
            }
        }
    }
}

fn puppet_app(dir: &std::path::Path, heeds_cancel: bool) -> (App, Sender<Result<(), Failure>>) {
    let (order, orders) = channel();
    let puppet = Puppet {
        orders: Mutex::new(orders),
        heeds_cancel,
    };
    let jobs = Jobs::start(TableLimits { queued: 2, ended: 10 }, Box::new(puppet)).unwrap();
    let predictor = Predictor::start(
        vec![model(dir, "plain", spec(Conditioning::None))],
        PredictorConfig::default(),
    );
    let config = ServerConfig {
        shutdown_deadline_ms: 300,
        ..with_data(dir, ServerConfig::default())
    };
    (App::with_parts(config, predictor.unwrap(), jobs), order)
}

fn collect(name: &str) -> Value {
    json!({"kind": "collect", "name": name, "scenario": "static-observer", "trials": 12})
}

async fn state_becomes(app: &App, id: &str, state: &str) -> Value {
    let path = format!("{JOBS}/{id}");
    until(async || {
        let job = get(app, &path).await.json();
        let is_over = ["succeeded", "failed", "cancelled"].contains(&job["state"].as_str().unwrap());
        assert!(!is_over || job["state"] == state, "{job}");
        (job["state"] == state).then_some(job)
    })
    .await
}

#[tokio::test]
async fn a_job_goes_its_way_and_can_be_watched() {
    let dir = tempfile::tempdir().unwrap();
    let (app, order) = puppet_app(dir.path(), true);
    let taken = post(&app, JOBS, &collect("a")).await;
    assert_eq!(
        (taken.status.as_u16(), &taken.headers["location"]),
        (202, &"/v1/jobs/job-1".parse().unwrap())
    );
    let job = state_becomes(&app, "job-1", "running").await;
    assert_eq!(job["spec"]["scenario"], "static-observer");
    let progress = until(async || {
        let job = get(&app, "/v1/jobs/job-1").await.json();
        (job["progress"]["total"] == 10).then_some(job["progress"].clone())
    });
    assert_eq!(progress.await["message"], "pretending");
    order.send(Ok(())).unwrap();
    state_becomes(&app, "job-1", "succeeded").await;

    post(&app, JOBS, &collect("b")).await;
    order.send(Err(Failure::Failed("the disk is full".to_owned()))).unwrap();
    assert_eq!(
        state_becomes(&app, "job-2", "failed").await["error"],
        "the disk is full"
    );
    let all = get(&app, JOBS).await.json();
    let ids: Vec<&Value> = all["jobs"].as_array().unwrap().iter().map(|job| &job["id"]).collect();
    assert_eq!(ids, ["job-2", "job-1"]);
}

#[tokio::test]
async fn jobs_can_be_cancelled_once_and_only_so_many_may_wait() {
    let dir = tempfile::tempdir().unwrap();
    let (app, _order) = puppet_app(dir.path(), true);
    post(&app, JOBS, &collect("a")).await;
    state_becomes(&app, "job-1", "running").await;
    for name in ["b", "c"] {
        assert_eq!(post(&app, JOBS, &collect(name)).await.status, 202);
    }
    let refused = post(&app, JOBS, &collect("d")).await;
    assert_eq!(
        refused.detail(503),
        "2 jobs wait already; cancel one or try again later"
    );
    assert_eq!(refused.headers["retry-after"], "1");
    let same = post(&app, "/v1/jobs/job-3/cancel", &Value::Null).await;
    assert_eq!(same.json()["state"], "cancelled");
    let taken = post(&app, JOBS, &collect("a")).await.detail(409);
    assert_eq!(
        taken,
        "name: data set \"a\" is being made by another job; choose another name"
    );
    assert_eq!(
        post(&app, "/v1/jobs/job-1/cancel", &Value::Null).await.json()["cancelling"],
        true
    );
    state_becomes(&app, "job-1", "cancelled").await;
    let again = post(&app, "/v1/jobs/job-1/cancel", &Value::Null).await.detail(409);
    assert_eq!(again, "job job-1 has been cancelled; it cannot be cancelled any more");
    assert_eq!(
        get(&app, "/v1/jobs/job-77").await.detail(404),
        "there is no job \"job-77\""
    );
}

#[tokio::test]
async fn stopping_cancels_jobs_and_does_not_wait_for_one_that_will_not_end() {
    for heeds_cancel in [true, false] {
        let dir = tempfile::tempdir().unwrap();
        let (app, order) = puppet_app(dir.path(), heeds_cancel);
        let server = run(app.clone()).await;
        post(&app, JOBS, &collect("a")).await;
        post(&app, JOBS, &collect("b")).await;
        state_becomes(&app, "job-1", "running").await;
        let started = Instant::now();
        server.stop().await;
        assert!(started.elapsed() < Duration::from_secs(10));
        let expected = if heeds_cancel { "cancelled" } else { "running" };
        assert_eq!(get(&app, "/v1/jobs/job-1").await.json()["state"], expected);
        assert_eq!(get(&app, "/v1/jobs/job-2").await.json()["state"], "cancelled");
        assert!(post(&app, JOBS, &collect("c")).await.detail(503).contains("stopping"));
        order.send(Ok(())).ok();
    }
}

#[tokio::test]
async fn a_job_that_cannot_be_done_is_refused_when_it_is_asked_for() {
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
        (collect("../up"), 422, "name: \"../up\" is no name"),
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
            train(json!({"settings": {"fit": {"stepz": 1}}})),
            422,
            "unknown field `stepz`",
        ),
        (train(json!({"colour": 1})), 422, "unknown field `colour`"),
        (
            json!({"kind": "dream"}),
            422,
            "unknown variant `dream`, expected `collect` or `train`",
        ),
    ] {
        let answer = post(&app, JOBS, &body).await.detail(status);
        assert!(answer.contains(detail), "{answer}");
    }
    assert_eq!(get(&app, JOBS).await.json()["jobs"], json!([]));
}

#[tokio::test]
async fn a_collected_data_set_trains_a_model_that_serves_at_once() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let mut seen = collect("seen");
    seen["trials"] = json!(40);
    let id = post(&app, JOBS, &seen).await.json()["id"].as_str().unwrap().to_owned();
    let done = state_becomes(&app, &id, "succeeded").await;
    assert_eq!(
        (&done["progress"]["done"], &done["progress"]["total"]),
        (&json!(40), &json!(40))
    );
    let exists = post(&app, JOBS, &seen).await.detail(409);
    assert_eq!(exists, "name: data set \"seen\" exists; choose another name");

    let settings = json!({
        "model": {"features": 8, "hidden": 8},
        "data": {"windows": 8, "validation_windows": 4},
        "pretrain": {"steps": 3, "batch_size": 4},
        "fit": {"steps": 3, "batch_size": 4},
        "run": {"validate_every_steps": 2, "checkpoint_every_steps": 2},
    });
    let train = json!({"kind": "train", "name": "fresh", "preset": "paper", "dataset": "seen", "settings": settings});
    let taken = post(&app, JOBS, &train).await;
    assert_eq!(taken.status, 202, "{}", taken.json());
    let done = state_becomes(&app, taken.json()["id"].as_str().unwrap(), "succeeded").await;
    assert!(
        done["losses"]["train"].is_number() && done["losses"]["validation"].is_number(),
        "{done}"
    );

    let description = get(&app, "/v1/models/fresh").await.json();
    assert_eq!(description["lineage"]["dataset"], "static-observer-40-seed-0");
    let misfit = post(&app, "/v1/models/fresh/predict", &json!({"frames": context()}))
        .await
        .detail(422);
    assert!(
        misfit.contains("frames[0] is 16×12 px; model \"fresh\" takes 64×64"),
        "{misfit}"
    );
    let preview = get(&app, "/v1/models/fresh/preview.png").await;
    assert_eq!(preview.status, 200);
    let again = post(&app, JOBS, &train).await.detail(409);
    assert_eq!(again, "name: model \"fresh\" exists; choose another name");
    assert!(dir.path().join("models/fresh/manifest.json").is_file());
}
