//! Trainings as jobs that start from a model.

use foreframe::server::ServerConfig;
use serde_json::{Value, json};

use crate::jobs_end_to_end::{JOBS, collect_data_set, run_job, train, wait_for_version};
use crate::service::{app, get, poll_until, post};

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
