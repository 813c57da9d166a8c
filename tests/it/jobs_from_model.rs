//! Jobs that start from a version of a model, or evaluate it.

use std::path::Path;

use axum::body::Body;
use axum::http::Request;
use foreframe::server::{App, ServerConfig};
use foreframe_core::nn::{ChannelScale, Conditioning};
use foreframe_core::registry::manifest;
use foreframe_core::types::Channel;
use foreframe_data::dataset::DatasetInfo;
use foreframe_train::training::{TrainConfig, check_start};
use serde_json::{Value, json};

use crate::jobs_end_to_end::{JOBS, collect_data_set, run_job, train, wait_for_version};
use crate::service::{app, get, job_becomes, model, poll_until, post, send, spec, with_data};

#[tokio::test]
async fn a_training_goes_on_from_a_model() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    collect_data_set(&app).await;
    let further = |more: Value| {
        let mut body = json!({"kind": "train", "name": "further", "from": "fresh", "dataset": "seen",
            "settings": {"sequence": {"steps": 2}}});
        body.as_object_mut().unwrap().extend(more.as_object().unwrap().clone());
        body
    };
    for path in [JOBS, "/v1/jobs/estimate"] {
        let unknown = post(&app, path, &further(json!({}))).await.detail(422);
        assert!(
            unknown.starts_with("from: there is no model \"fresh\"; there are: "),
            "{unknown}"
        );
    }

    // The version that the job before it makes, with its settings but for its pre-training.
    assert_eq!(post(&app, JOBS, &train("fresh", 2)).await.status, 202);
    let second = run_job(&app, &further(json!({"after": "job-2"}))).await;
    assert_eq!(second["spec"]["from_version"], 1, "{second}");
    assert_eq!(second["progress"]["total"], 2, "{second}");
    let manifest = std::fs::read(dir.path().join("models/further/1/manifest.json")).unwrap();
    let manifest: Value = serde_json::from_slice(&manifest).unwrap();
    let (training, command) = (&manifest["training"], manifest["command"].as_str().unwrap());
    assert_eq!(
        (
            &training["from"]["model"],
            &training["from"]["version"],
            &training["model"]["hidden"]
        ),
        (&json!("fresh"), &json!(1), &json!(8))
    );
    assert!(command.contains("\"from_version\":1"), "{command}");

    // The active version, with a sweep; and what it would need.
    wait_for_version(&app, "fresh", 1).await;
    let estimate = post(&app, "/v1/jobs/estimate", &further(json!({}))).await.json();
    assert_eq!(estimate["steps"], 2);
    let swept = run_job(&app, &further(json!({"sweep": {"seed": [1, 2]}}))).await;
    assert_eq!(swept["result"]["sweep"].as_array().unwrap().len(), 2, "{swept}");

    let wrong = json!({"settings": {"sequence": {"stepz": 1}}});
    for path in [JOBS, "/v1/jobs/estimate"] {
        let refused = post(&app, path, &further(wrong.clone())).await.detail(422);
        assert!(
            refused.starts_with("settings: ") && refused.contains("stepz"),
            "{refused}"
        );
    }
    let both = post(&app, JOBS, &further(json!({"preset": "paper"}))).await.detail(422);
    assert!(both.starts_with("from: a training starts either"), "{both}");
    let version = post(&app, JOBS, &further(json!({"from_version": 9}))).await.detail(422);
    assert_eq!(version, "from_version: there is no version \"9\"; there are: 1");
}

#[tokio::test]
async fn memory_is_checked_when_the_model_to_start_from_is_there() {
    let dir = tempfile::tempdir().unwrap();
    let config = ServerConfig {
        job_memory_mib: 1024,
        ..ServerConfig::default()
    };
    let app = app(dir.path(), config);
    collect_data_set(&app).await;
    run_job(&app, &train("fresh", 2)).await;
    let mut large = json!({"kind": "train", "name": "large", "from": "fresh", "dataset": "seen", "after": "job-2",
        "settings": {"sequence": {"steps": 2, "batch_size": 4096}}});
    assert_eq!(post(&app, JOBS, &large).await.status, 202);
    let failed = poll_until(async || {
        let job = get(&app, "/v1/jobs/job-3").await.json();
        (job["state"] == "failed").then_some(job)
    })
    .await;
    let expected = "settings: the training needs at least ";
    assert!(failed["error"].as_str().unwrap().starts_with(expected), "{failed}");
    large["from_version"] = json!(1);
    assert!(post(&app, JOBS, &large).await.detail(422).starts_with(expected));

    // Principal components, of which weights that are there have no need, take memory.
    let needs = async |body: Value| {
        let estimate = post(&app, "/v1/jobs/estimate", &body).await.json();
        estimate["memory_mib"].as_u64().unwrap()
    };
    let further = json!({"kind": "train", "name": "large", "from": "fresh", "dataset": "seen"});
    assert!(needs(further).await < needs(train("fresh", 2)).await);
}

/// A long training from version 2 of `fresh`, which has two versions; the first one is active.
async fn long_training_from_second_version(app: &App) -> Value {
    collect_data_set(app).await;
    for version in [1, 2] {
        assert_eq!(run_job(app, &train("fresh", 2)).await["result"]["version"], version);
    }
    json!({"kind": "train", "name": "further", "from": "fresh", "from_version": 2, "dataset": "seen",
        "settings": {"sequence": {"steps": 200}, "run": {"validate_every_steps": 50, "checkpoint_every_steps": 100}}})
}

/// Resumes a training whose version to start from was deleted before its first checkpoint; with shared `objects`, on a machine that has
/// nothing of it.
async fn resume_without_the_version(objects: Option<String>) {
    let dir = tempfile::tempdir().unwrap();
    let config = with_data(dir.path(), ServerConfig::default());
    model(&config.models_dir, "plain", spec(Conditioning::None));
    let is_shared = objects.is_some();
    let config = ServerConfig {
        objects_url: objects,
        ..config
    };
    let app = App::open(config).await.unwrap();
    let training = long_training_from_second_version(&app).await;
    assert_eq!(post(&app, JOBS, &training).await.status, 202);
    job_becomes(&app, "job-4", |job| job["progress"]["done"].as_u64() > Some(8)).await;
    let delete = Request::delete("/v1/models/fresh/versions/2")
        .body(Body::empty())
        .unwrap();
    assert_eq!(send(&app, delete).await.status, 204);
    post(&app, "/v1/jobs/job-4/cancel", &Value::Null).await;
    job_becomes(&app, "job-4", |job| job["state"] == "cancelled").await;
    post(&app, JOBS, &training).await.detail(422);
    if is_shared {
        std::fs::remove_dir_all(dir.path().join("runs/job-4")).unwrap();
    }
    assert_eq!(post(&app, "/v1/jobs/job-4/resume", &Value::Null).await.status, 202);
    job_becomes(&app, "job-4", |job| job["state"] == "succeeded").await;
    let log = get(&app, "/v1/jobs/job-4/logs").await.json().to_string();
    // The first attempt began with step 0, the second one did not.
    let begun = |from: &str| log.matches(from).count();
    assert_eq!(
        [begun("sequence from step "), begun("sequence from step 0,")],
        [2, 1],
        "{log}"
    );
    let manifest = std::fs::read(dir.path().join("models/further/1/manifest.json")).unwrap();
    let manifest: Value = serde_json::from_slice(&manifest).unwrap();
    assert_eq!(manifest["training"]["from"]["version"], 2, "{manifest}");
}

#[tokio::test]
async fn a_training_goes_on_though_its_version_to_start_from_was_deleted() {
    resume_without_the_version(None).await;
}

#[tokio::test]
async fn the_shared_store_has_the_version_to_start_from() {
    let objects = tempfile::tempdir().unwrap();
    resume_without_the_version(Some(objects.path().display().to_string())).await;
}

#[tokio::test]
async fn a_training_after_an_evaluation_starts_from_the_active_version() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    long_training_from_second_version(&app).await;
    let evaluate = json!({"kind": "evaluate", "model": "fresh", "version": 2, "dataset": "seen", "windows": 40,
        "resamples": 100});
    assert_eq!(run_job(&app, &evaluate).await["result"]["version"], 2);
    let further = json!({"kind": "train", "name": "further", "from": "fresh", "dataset": "seen", "after": "job-4",
        "settings": {"sequence": {"steps": 2}}});
    let trained = run_job(&app, &further).await;
    assert_eq!(trained["spec"]["from_version"], 1, "{trained}");
}

#[tokio::test]
async fn a_version_that_a_waiting_job_names_is_not_deleted() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let training = long_training_from_second_version(&app).await;
    let long = json!({"kind": "collect", "name": "long", "scenario": "static-observer", "trials": 100_000});
    let evaluation = json!({"kind": "evaluate", "model": "fresh", "version": 2, "dataset": "seen", "windows": 40,
        "resamples": 100});
    for body in [&long, &training, &evaluation] {
        assert_eq!(post(&app, JOBS, body).await.status, 202);
    }
    let delete = async || {
        let delete = Request::delete("/v1/models/fresh/versions/2");
        send(&app, delete.body(Body::empty()).unwrap()).await
    };
    for job in ["job-5", "job-6"] {
        let in_use =
            format!("version 2 of model \"fresh\" is in use by {job}; wait until that job has ended, or cancel it");
        assert_eq!(delete().await.detail(409), in_use);
        post(&app, &format!("{JOBS}/{job}/cancel"), &Value::Null).await;
    }
    assert_eq!(delete().await.status, 204);
    post(&app, &format!("{JOBS}/job-4/cancel"), &Value::Null).await;
}

#[tokio::test]
async fn all_parts_use_the_version_that_was_active_when_the_job_was_submitted() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    long_training_from_second_version(&app).await;
    wait_for_version(&app, "fresh", 1).await;
    // No part starts before it.
    let long = json!({"kind": "collect", "name": "long", "scenario": "static-observer", "trials": 100_000});
    assert_eq!(post(&app, JOBS, &long).await.status, 202);
    let swept = json!({"kind": "train", "name": "swept", "from": "fresh", "dataset": "seen",
        "settings": {"sequence": {"steps": 2}}, "sweep": {"seed": [1, 2]}});
    let evaluated =
        json!({"kind": "evaluate", "model": "fresh", "dataset": "seen", "windows": 100, "resamples": 100, "parts": 2});
    let mut waiting = Vec::new();
    for (body, field) in [(swept, "from_version"), (evaluated, "version")] {
        let job = post(&app, JOBS, &body).await.json();
        assert_eq!(job["spec"][field], 1, "{job}");
        waiting.push((job["id"].as_str().unwrap().to_owned(), field));
    }
    let activated = post(&app, "/v1/models/fresh/versions/2/activate", &Value::Null).await;
    assert_eq!(activated.json()["active_version"], 2);
    for (id, field) in &waiting {
        let parts = get(&app, &format!("{JOBS}?part_of={id}")).await.json();
        let versions: Vec<&Value> = parts["jobs"]
            .as_array()
            .unwrap()
            .iter()
            .map(|part| &part["spec"][*field])
            .collect();
        assert_eq!(versions, [&json!(1), &json!(1)], "{parts}");
    }
    cancel_all(&app, 4).await;
}

/// Cancels all jobs from this one on, the last one first, so that none begins.
async fn cancel_all(app: &App, first: usize) {
    let listed = get(app, JOBS).await.json();
    for job in listed["jobs"].as_array().unwrap() {
        let id = job["id"].as_str().unwrap();
        let number: usize = id.trim_start_matches("job-").parse().unwrap();
        if number >= first {
            assert_eq!(
                post(app, &format!("{JOBS}/{id}/cancel"), &Value::Null).await.status,
                202
            );
        }
    }
}

#[tokio::test]
async fn an_evaluation_keeps_the_version_that_it_began_with() {
    let dir = tempfile::tempdir().unwrap();
    let config = ServerConfig {
        job_lease_ms: 1000,
        ..ServerConfig::default()
    };
    let app = app(dir.path(), config);
    long_training_from_second_version(&app).await;
    let evaluate = json!({"kind": "evaluate", "model": "fresh", "dataset": "seen", "windows": 40, "resamples": 10_000});
    assert_eq!(post(&app, JOBS, &evaluate).await.status, 202);
    job_becomes(&app, "job-4", |job| job["spec"]["version"] == 1).await;
    post(&app, "/v1/jobs/job-4/cancel", &Value::Null).await;
    let ended = job_becomes(&app, "job-4", |job| job["state"] != "running").await;
    let activated = post(&app, "/v1/models/fresh/versions/2/activate", &Value::Null).await;
    assert_eq!(activated.json()["active_version"], 2);
    if ended["state"] == "cancelled" {
        assert_eq!(post(&app, "/v1/jobs/job-4/resume", &Value::Null).await.status, 202);
    }
    let ended = job_becomes(&app, "job-4", |job| job["state"] == "succeeded").await;
    assert_eq!(ended["result"]["version"], 1, "{ended}");
}

#[tokio::test]
async fn a_model_that_does_not_fit_is_refused_at_once() {
    let dir = tempfile::tempdir().unwrap();
    let config = ServerConfig {
        data_dir: dir.path().to_owned(),
        ..ServerConfig::default()
    };
    let app = App::open(config).await.unwrap();
    collect_data_set(&app).await;
    // Nothing that follows begins.
    let long = json!({"kind": "collect", "name": "long", "scenario": "static-observer", "trials": 100_000});
    assert_eq!(post(&app, JOBS, &long).await.status, 202);
    let further = |from: &str, more: Value| {
        let mut body = json!({"kind": "train", "name": "further", "from": from, "dataset": "seen"});
        body.as_object_mut().unwrap().extend(more.as_object().unwrap().clone());
        body
    };
    for (body, start) in [
        (
            further("static", json!({"settings": {"model": {"hidden": 16}}})),
            "from: the training cannot start from the model \"static\": ",
        ),
        (
            further("static", json!({"sweep": {"model.hidden": [16, 32]}})),
            "from: the training cannot start from the model \"static\": ",
        ),
        (
            json!({"kind": "adapt", "name": "further", "dataset": "seen", "settings": {"model": {"flow": {"channels": 16}}}}),
            "from: the training cannot start from the model \"rooms\": ",
        ),
        (
            json!({"kind": "train", "name": "further", "dataset": "seen", "preset": "static-flow",
                "settings": {"model": {"flow": {"channels": 0}}}}),
            "settings: model specification: flow.channels is 0; it must be 1 to 512",
        ),
        (
            json!({"kind": "train", "name": "further", "dataset": "seen", "preset": "static-flow",
                "sweep": {"model.context": [5, 1000]}}),
            "settings: model specification: context is 1000; it must be 1 to ",
        ),
        (
            further("static", json!({"from_version": "x"})),
            "from_version: invalid type: string \"x\"",
        ),
        (
            further("static", json!({"settings": {"name": "other"}})),
            "settings.name: the model has",
        ),
        (
            further("static", json!({"sweep": {"name": ["other"]}})),
            "sweep.name: the model has",
        ),
        (
            further("static", json!({"from_version": 2, "after": "job-2"})),
            "from_version: there is no version \"2\" yet; if job-2 makes it, leave out from_version",
        ),
    ] {
        let refused = post(&app, JOBS, &body).await.detail(422);
        assert!(refused.starts_with(start), "{refused}");
        if body["kind"] == "train" {
            let refused = post(&app, "/v1/jobs/estimate", &body).await.detail(422);
            assert!(refused.starts_with(start), "{refused}");
        }
    }
    for from in ["static", "paper", "moving", "static-flow", "moving-flow", "rooms"] {
        let taken = post(&app, JOBS, &further(from, json!({}))).await;
        assert_eq!(taken.status, 202, "{from}: {}", taken.json());
    }
    cancel_all(&app, 2).await;
}

#[test]
fn a_model_starts_only_from_one_with_the_same_channels() {
    let base = manifest::read(Path::new("models/moving")).unwrap();
    let config = TrainConfig::of_model(&base, []).unwrap();
    let channels = |scales: &[ChannelScale]| -> Vec<Channel> {
        let channel = |scale: &ChannelScale| Channel {
            name: scale.name.clone(),
            unit: scale.unit.clone(),
        };
        scales.iter().map(channel).collect()
    };
    let fitting = DatasetInfo {
        name: "seen".to_owned(),
        frame_width_px: 64,
        frame_height_px: 64,
        frame_period_s: 0.2,
        action_channels: channels(&base.spec.actions),
        state_channels: channels(&base.spec.states),
        ..DatasetInfo::default()
    };
    check_start(&config, &fitting, &base).unwrap();
    let mut lacking = fitting.clone();
    lacking.action_channels.clear();
    let refused = check_start(&config, &lacking, &base).unwrap_err().to_string();
    assert!(
        refused.contains("has no actions") && refused.contains("use a preset or a model that fits"),
        "{refused}"
    );
    let mut others = fitting.clone();
    others.action_channels[0].unit = "km/h".to_owned();
    let refused = check_start(&config, &others, &base).unwrap_err().to_string();
    assert!(refused.contains("it takes the action ["), "{refused}");
    let mut larger = fitting;
    larger.frame_width_px = 80;
    let refused = check_start(&config, &larger, &base).unwrap_err().to_string();
    assert!(refused.contains("it needs the same frame size"), "{refused}");
}
