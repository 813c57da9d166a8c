//! Damaged checkpoints of a training job.

use foreframe::server::ServerConfig;
use serde_json::{Value, json};

use crate::service::{app, get, job_becomes, post};

const JOBS: &str = "/v1/jobs";

fn train() -> Value {
    let settings = json!({
        "model": {"features": 8, "hidden": 8},
        "data": {"windows": 8, "validation_windows": 4},
        "pretrain": {"steps": 2, "batch_size": 4},
        "sequence": {"steps": 200, "batch_size": 4},
        "run": {"validate_every_steps": 50, "checkpoint_every_steps": 2},
    });
    json!({"kind": "train", "name": "m", "preset": "paper", "dataset": "seen", "settings": settings})
}

#[tokio::test]
async fn a_training_resumes_from_the_previous_checkpoint_if_the_latest_is_damaged() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let seen = json!({"kind": "collect", "name": "seen", "scenario": "static-observer", "trials": 40});
    post(&app, JOBS, &seen).await;
    job_becomes(&app, "job-1", |job| job["state"] == "succeeded").await;
    let run = dir.path().join("runs/job-2");
    post(&app, JOBS, &train()).await;
    for damage in [flip, truncate] {
        job_becomes(&app, "job-2", |job| {
            job["state"] == "running" && job["progress"]["done"].as_u64() > Some(8)
        })
        .await;
        post(&app, "/v1/jobs/job-2/cancel", &Value::Null).await;
        job_becomes(&app, "job-2", |job| job["state"] == "cancelled").await;
        let path = run.join("checkpoint.safetensors");
        std::fs::write(&path, damage(std::fs::read(&path).unwrap())).unwrap();
        assert!(
            post(&app, "/v1/jobs/job-2/resume", &Value::Null)
                .await
                .status
                .is_success()
        );
    }
    job_becomes(&app, "job-2", |job| job["state"] == "succeeded").await;
    let log = get(&app, "/v1/jobs/job-2/logs").await.json();
    let lines: Vec<&str> = log["lines"]
        .as_array()
        .unwrap()
        .iter()
        .filter_map(|line| line["line"].as_str())
        .collect();
    let damaged = |line: &&&str| **line == "the latest checkpoint is damaged; resuming from the previous one";
    assert_eq!(lines.iter().filter(damaged).count(), 2, "{lines:?}");
}

fn flip(mut checkpoint: Vec<u8>) -> Vec<u8> {
    let last = checkpoint.len() - 3;
    checkpoint[last] ^= 1;
    checkpoint
}

fn truncate(mut checkpoint: Vec<u8>) -> Vec<u8> {
    checkpoint.truncate(checkpoint.len() / 2);
    checkpoint
}
