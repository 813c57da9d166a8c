//! Sweeps: as jobs with parts over HTTP, and on the command line.

use foreframe::server::ServerConfig;
use serde_json::{Value, json};

use crate::process::{output, text};
use crate::service::{app, get, poll_until, post};

async fn ended(app: &foreframe::server::App, id: &str) -> Value {
    let path = format!("/v1/jobs/{id}");
    poll_until(async || {
        let job = get(app, &path).await.json();
        ["succeeded", "failed", "cancelled"]
            .contains(&job["state"].as_str().unwrap())
            .then_some(job)
    })
    .await
}

#[tokio::test]
async fn a_sweep_trains_every_combination_and_the_best_becomes_active() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let collect = json!({"kind": "collect", "name": "seen", "scenario": "static-observer", "trials": 40});
    post(&app, "/v1/jobs", &collect).await;
    let settings = json!({
        "model": {"hidden": 8},
        "data": {"windows": 8, "validation_windows": 4},
        "pretrain": {"steps": 3, "batch_size": 4},
        "sequence": {"steps": 2, "batch_size": 4},
    });
    let mut sweep = json!({"kind": "train", "name": "swept", "preset": "paper", "dataset": "seen", "after": "job-1",
        "settings": settings, "sweep": {"seed": [1, 2], "model.features": [4, 8]}});
    let taken = post(&app, "/v1/jobs", &sweep).await.json();
    assert_eq!(
        taken["parts"],
        json!({"total": 4, "done": 0, "running": 0, "failed": 0})
    );
    let job = ended(&app, "job-2").await;
    assert_eq!(job["parts"], json!({"total": 4, "done": 4, "running": 0, "failed": 0}));
    let points = job["result"]["sweep"].as_array().unwrap();
    let errors: Vec<f64> = points
        .iter()
        .map(|point| point["validation_mse"].as_f64().unwrap())
        .collect();
    assert!(errors.len() == 4 && errors.is_sorted(), "{errors:?}");
    let mut versions: Vec<u64> = points.iter().map(|point| point["version"].as_u64().unwrap()).collect();
    // A server loads the new version soon after the job has ended.
    let model = poll_until(async || {
        let answer = get(&app, "/v1/models/swept").await;
        (answer.status == 200).then(|| answer.json())
    });
    assert_eq!(model.await["active_version"], versions[0]);
    versions.sort_unstable();
    assert_eq!(versions, [1, 2, 3, 4]);
    let of = |job: &Value| {
        [&job["settings"]["model.features"], &job["settings"]["seed"]].map(|value| value.as_u64().unwrap())
    };
    let mut settings: Vec<_> = points.iter().map(of).collect();
    settings.sort_unstable();
    assert_eq!(settings, [[4, 1], [4, 2], [8, 1], [8, 2]]);

    let part = get(&app, "/v1/jobs/job-3").await.json();
    assert_eq!(
        (&part["part_of"], &part["spec"]["settings"]["model"]),
        (&json!("job-2"), &json!({"hidden": 8, "features": 4}))
    );
    let count = async |path: &str| get(&app, path).await.json()["jobs"].as_array().unwrap().len();
    assert_eq!((count("/v1/jobs").await, count("/v1/jobs?part_of=job-2").await), (2, 4));

    sweep["sweep"] = json!({"seed": (0..65).collect::<Vec<_>>()});
    let refused = post(&app, "/v1/jobs", &sweep).await.detail(422);
    assert_eq!(refused, "sweep: 65 trainings are too many; a sweep has at most 64");
}

#[tokio::test]
async fn a_sweep_shows_its_failed_parts() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let collect = json!({"kind": "collect", "name": "seen", "scenario": "static-observer", "trials": 40});
    post(&app, "/v1/jobs", &collect).await;
    let settings = json!({"model": {"hidden": 8, "features": 4}, "pretrain": {"steps": 3}, "sequence": {"steps": 2}});
    // No data set of 40 trials has a million windows.
    let sweep = json!({"kind": "train", "name": "swept", "preset": "paper", "dataset": "seen", "after": "job-1",
        "settings": settings, "sweep": {"data.windows": [1_000_000, 8]}});
    assert_eq!(post(&app, "/v1/jobs", &sweep).await.status, 202);
    let job = ended(&app, "job-2").await;
    assert_eq!(
        job["parts"],
        json!({"total": 2, "done": 1, "running": 0, "failed": 1}),
        "{job}"
    );
    let points = &job["result"]["sweep"];
    assert_eq!(
        (&points[0]["state"], &points[1]["state"]),
        (&json!("succeeded"), &json!("failed"))
    );
    assert!(points[1]["error"].as_str().unwrap().contains("1000000"), "{points}");
}

#[test]
fn train_sweeps_on_the_command_line_and_continues() {
    let dir = tempfile::tempdir().unwrap();
    let run = |line: &str| {
        let done = output(dir.path(), &line.split(' ').collect::<Vec<_>>());
        assert!(done.status.success(), "{line}: {}", text(&done.stderr));
        text(&done.stdout)
    };
    run("collect --data-dir d --trials 40 --frame-size 8 --threads 1");
    let small =
        "train --data-dir d --set data.windows=40 --set sequence.steps=2 --set pretrain.steps=2 --set model.hidden=4";
    let command = format!("{small} --set model.features=4 --sweep seed=1,2");
    let table = run(&command);
    let lines: Vec<&str> = table.lines().collect();
    assert_eq!(lines.len(), 4, "{table}");
    assert!(lines[0].starts_with("validation MSE  step  settings  run"), "{table}");
    assert!(
        lines[1].contains("  seed=") && lines[1].contains("runs/paper/seed="),
        "{table}"
    );
    assert!(
        lines[3].starts_with("next: foreframe publish runs/paper/seed="),
        "{table}"
    );
    let best = lines[3].trim_start_matches("next: foreframe ");
    assert_eq!(run(&command), table);
    assert_eq!(run(&format!("{command},3")).lines().count(), 5);
    assert!(run(best).starts_with("published paper@"));
}
