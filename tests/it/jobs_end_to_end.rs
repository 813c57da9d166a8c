//! Real jobs over HTTP: collection, training, evaluation, and the model versions and data sets that they create.

use std::path::Path;

use axum::body::Body;
use axum::http::Request;
use foreframe::server::{App, ServerConfig};
use foreframe_core::frame::codec;
use futures_util::FutureExt as _;
use serde_json::{Value, json};

use crate::service::{Answer, app, context, get, poll_until, post, send, store, with_data};

pub(crate) const JOBS: &str = "/v1/jobs";

/// A short training on `seen`.
pub(crate) fn train(name: &str, steps: usize) -> Value {
    let settings = json!({
        "model": {"features": 8, "hidden": 8},
        "data": {"windows": 8, "validation_windows": 4},
        "pretrain": {"steps": 3, "batch_size": 4},
        "sequence": {"steps": steps, "batch_size": 4},
        "run": {"validate_every_steps": 2, "checkpoint_every_steps": 2},
    });
    json!({"kind": "train", "name": name, "preset": "paper", "dataset": "seen", "settings": settings})
}

/// Creates a job and waits until it has succeeded.
pub(crate) async fn run_job(app: &App, body: &Value) -> Value {
    let taken = post(app, JOBS, body).await;
    assert_eq!(taken.status, 202, "{}", taken.json());
    let path = format!("{JOBS}/{}", taken.json()["id"].as_str().unwrap());
    poll_until(async || {
        let job = get(app, &path).await.json();
        assert!(job["state"] != "failed" && job["state"] != "cancelled", "{job}");
        (job["state"] == "succeeded").then_some(job)
    })
    .await
}

/// Collects `seen`.
pub(crate) async fn collect_data_set(app: &App) -> Value {
    let seen = json!({"kind": "collect", "name": "seen", "scenario": "static-observer", "trials": 40});
    run_job(app, &seen).await
}

#[tokio::test]
async fn jobs_wait_for_what_another_makes() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let after = |mut job: Value, earlier: &str| {
        job["after"] = json!(earlier);
        job
    };
    let collect = |name: &str| json!({"kind": "collect", "name": name, "scenario": "static-observer", "trials": 40});
    let evaluate = json!({"kind": "evaluate", "model": "fresh", "dataset": "seen", "windows": 8, "resamples": 100});
    for job in [
        collect("seen"),
        after(train("fresh", 2), "job-1"),
        after(evaluate.clone(), "job-2"),
    ] {
        let taken = post(&app, JOBS, &job).await;
        assert_eq!(taken.status, 202, "{}", taken.json());
    }
    let unknown = post(&app, JOBS, &after(train("fresh", 2), "job-9")).await;
    assert_eq!(unknown.detail(422), "after: there is no job \"job-9\"");
    let evaluated = poll_until(async || {
        let job = get(&app, "/v1/jobs/job-3").await.json();
        assert!(job["state"] != "failed", "{job}");
        (job["state"] == "succeeded").then_some(job)
    })
    .await;
    assert_eq!(evaluated["result"]["version"], 1);

    // What waits for a job that did not succeed fails.
    let long = json!({"kind": "collect", "name": "long", "scenario": "static-observer", "trials": 100_000});
    assert_eq!(post(&app, JOBS, &long).await.status, 202);
    let mut waiting = after(train("other", 2), "job-4");
    waiting["dataset"] = json!("long");
    assert_eq!(post(&app, JOBS, &waiting).await.status, 202);
    assert_eq!(post(&app, "/v1/jobs/job-4/cancel", &json!({})).await.status, 202);
    let failed = poll_until(async || {
        let job = get(&app, "/v1/jobs/job-5").await.json();
        (job["state"] == "failed").then_some(job)
    })
    .await;
    let expected = "job-4, for which it waited, is cancelled; resume that one, then this one";
    assert_eq!(failed["error"], expected);
}

async fn delete(app: &App, path: &str) -> Answer {
    send(app, Request::delete(path).body(Body::empty()).unwrap()).await
}

/// Waits until this version is active.
pub(crate) async fn wait_for_version(app: &App, model: &str, version: u32) -> Value {
    poll_until(async || {
        let answer = get(app, &format!("/v1/models/{model}")).await;
        let description = (answer.status == 200).then(|| answer.json())?;
        (description["active_version"] == version).then_some(description)
    })
    .await
}

#[tokio::test]
async fn a_collected_data_set_trains_a_served_model() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let collection = collect_data_set(&app).await;
    assert_eq!(
        (&collection["progress"]["done"], &collection["progress"]["total"]),
        (&json!(40), &json!(40))
    );
    let again = json!({"kind": "collect", "name": "seen", "scenario": "static-observer", "trials": 40});
    let exists = post(&app, JOBS, &again).await.detail(409);
    assert_eq!(exists, "name: data set \"seen\" exists; choose another name");

    let estimate = post(&app, "/v1/jobs/estimate", &train("fresh", 3)).await.json();
    assert_eq!(estimate["steps"], 6);
    assert!(
        (1..4096).contains(&estimate["memory_mib"].as_u64().unwrap()),
        "{estimate}"
    );
    post(&app, "/v1/jobs/estimate", &again).await.detail(422);

    let first = run_job(&app, &train("fresh", 3)).await;
    assert!(
        first["losses"]["train"].is_number() && first["losses"]["validation"].is_number(),
        "{first}"
    );
    assert_eq!(
        (&first["result"]["model"], &first["result"]["version"]),
        (&json!("fresh"), &json!(1))
    );
    let description = wait_for_version(&app, "fresh", 1).await;
    assert_eq!(description["lineage"]["dataset"], "static-observer-40-seed-1");
    let misfit = post(&app, "/v1/models/fresh/predict", &json!({"frames": context()}))
        .await
        .detail(422);
    assert!(
        misfit.contains("frames[0] is 16×12 px; model \"fresh\" takes 64×64"),
        "{misfit}"
    );
    assert_eq!(get(&app, "/v1/models/fresh/preview.png").await.status, 200);

    let curves = get(&app, "/v1/jobs/job-2/metrics").await.json();
    let points = curves["points"].as_array().unwrap();
    let stages: Vec<&str> = points.iter().map(|point| point["stage"].as_str().unwrap()).collect();
    assert_eq!(
        stages,
        ["pretrain", "pretrain", "pretrain", "sequence", "sequence", "sequence"]
    );
    let has_validation: Vec<bool> = points.iter().map(|point| point["validation"].is_number()).collect();
    assert_eq!(has_validation, [false, true, true, false, true, true]);

    // Five true frames above five predicted ones.
    let sample = get(&app, "/v1/jobs/job-2/sample.png").await;
    assert_eq!(sample.headers["content-type"], "image/png");
    let sample = codec::decode(&sample.body).unwrap();
    assert_eq!((sample.width(), sample.height()), (5 * 64 + 4 * 2, 2 * 64 + 2));
    get(&app, "/v1/jobs/job-1/sample.png").await.detail(404);

    let body = json!({"kind": "evaluate", "model": "fresh", "dataset": "seen", "windows": 40, "resamples": 100});
    let measured = run_job(&app, &body).await;
    assert!(measured["result"]["scores"]["test"]["skill"].is_number(), "{measured}");
    let described = get(&app, "/v1/models/fresh").await.json();
    assert_eq!(described["metrics"], measured["result"]["scores"]);
    let listed = get(&app, "/v1/models").await.json();
    assert_eq!(listed["models"][0]["metrics"], described["metrics"]);
    let report = get(&app, "/v1/jobs/job-3/files/report.json").await;
    assert_eq!(report.headers["content-type"], "application/json");
    assert_eq!(report.json()["stamp"]["model"], "fresh");
    let files = measured["result"]["files"].as_array().unwrap();
    let gif = files
        .iter()
        .find_map(|file| file.as_str()?.strip_suffix(".gif"))
        .unwrap();
    let gif = get(&app, &format!("/v1/jobs/job-3/files/{gif}.gif")).await;
    assert!(gif.body.starts_with(b"GIF89a"));
    for path in ["..%2F..%2Fforeframe.db", "nothing.json"] {
        assert_eq!(get(&app, &format!("/v1/jobs/job-3/files/{path}")).await.status, 404);
    }
    let body = json!({"kind": "evaluate", "model": "fresh", "version": 9, "dataset": "seen"});
    let unknown = post(&app, JOBS, &body).await.detail(422);
    assert_eq!(unknown, "version: there is no version \"9\"; there are: 1");
}

#[tokio::test]
async fn an_evaluation_that_cannot_fit_is_refused_at_once() {
    let dir = tempfile::tempdir().unwrap();
    let config = ServerConfig {
        data_dir: dir.path().to_owned(),
        ..ServerConfig::default()
    };
    let app = App::open(config).await.unwrap();
    let seen = json!({"kind": "collect", "name": "seen", "scenario": "static-observer", "trials": 2});
    run_job(&app, &seen).await;
    let evaluate = |model: &str, fields: Value| {
        let mut body = json!({"kind": "evaluate", "model": model, "dataset": "seen"});
        body.as_object_mut()
            .unwrap()
            .extend(fields.as_object().unwrap().clone());
        body
    };
    let detail = post(&app, JOBS, &evaluate("donkeycar", json!({}))).await.detail(422);
    let expected = "dataset: data set \"seen\" has ";
    assert!(
        detail.starts_with(expected) && detail.contains("model \"donkeycar\" "),
        "{detail}"
    );
    let twin = post(&app, JOBS, &evaluate("static", json!({"twin": "donkeycar"}))).await;
    assert!(twin.detail(422).starts_with(expected));
    assert_eq!(post(&app, JOBS, &evaluate("static", json!({}))).await.status, 202);
}

#[tokio::test]
async fn a_cancelled_evaluation_leaves_no_report() {
    let dir = tempfile::tempdir().unwrap();
    // The shipped models take frames of the collected size.
    let config = ServerConfig {
        data_dir: dir.path().to_owned(),
        job_lease_ms: 1000,
        ..ServerConfig::default()
    };
    let app = App::open(config).await.unwrap();
    // Enough trials that the evaluation is still running when it is cancelled.
    let seen = json!({"kind": "collect", "name": "seen", "scenario": "static-observer", "trials": 100});
    run_job(&app, &seen).await;
    let body =
        json!({"kind": "evaluate", "model": "static", "dataset": "seen", "windows": 100_000, "resamples": 10_000});
    post(&app, JOBS, &body).await;
    let becomes = async |state: &str| {
        poll_until(async || {
            let job = get(&app, "/v1/jobs/job-2").await.json();
            assert!(job["state"] != "succeeded" && job["state"] != "failed", "{job}");
            (job["state"] == state && job["progress"]["message"] != "").then_some(job)
        })
        .await
    };
    becomes("running").await;
    post(&app, "/v1/jobs/job-2/cancel", &Value::Null).await;
    let cancelled = becomes("cancelled").await;
    assert_eq!(
        (&cancelled["result"], &cancelled["error"]),
        (&Value::Null, &Value::Null)
    );
    assert!(!dir.path().join("reports/job-2").exists());
    assert_eq!(get(&app, "/v1/jobs/job-2/files/report.json").await.status, 404);
}

#[tokio::test]
async fn model_versions_are_activated_refused_and_deleted() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    collect_data_set(&app).await;
    // "plain" was shipped as version 1, which stays active until another version is activated.
    for (name, steps, version) in [("plain", 2, 2), ("plain", 4, 3), ("plain", 6, 4)] {
        let job = run_job(&app, &train(name, steps)).await;
        assert_eq!(job["result"]["version"], version);
        let progress = &job["progress"];
        assert!(
            progress["done"] == progress["total"] && progress["total"] != 0,
            "{progress}"
        );
    }
    let description = get(&app, "/v1/models/plain").await.json();
    assert_eq!(
        (&description["versions"], &description["active_version"]),
        (&json!([1, 2, 3, 4]), &json!(1))
    );

    let swapped = post(&app, "/v1/models/plain/versions/2/activate", &Value::Null)
        .await
        .json();
    assert_eq!(
        (&swapped["active_version"], &swapped["spec"]["frame_width_px"]),
        (&json!(2), &json!(64))
    );
    // The activation completes even if the client disconnects.
    let and_gone = post(&app, "/v1/models/plain/versions/1/activate", &Value::Null).now_or_never();
    assert!(and_gone.is_none());
    wait_for_version(&app, "plain", 1).await;
    poll_until(async || {
        (store(dir.path()).active_versions().await.unwrap() == [("plain".parse().unwrap(), 1)]).then_some(())
    })
    .await;
    post(&app, "/v1/models/plain/versions/2/activate", &Value::Null)
        .await
        .json();
    let weights = |version: u32| dir.path().join(format!("models/plain/{version}/model.safetensors"));
    let mut bytes = std::fs::read(weights(3)).unwrap();
    let last = bytes.len() - 1;
    bytes[last] ^= 1;
    std::fs::write(weights(3), bytes).unwrap();
    let refused = post(&app, "/v1/models/plain/versions/3/activate", &Value::Null)
        .await
        .detail(422);
    assert!(
        refused.starts_with("version 3 of model \"plain\" is refused:") && refused.contains("SHA-256"),
        "{refused}"
    );
    change_spec(&dir.path().join("models/plain/4"));
    let refused = post(&app, "/v1/models/plain/versions/4/activate", &Value::Null)
        .await
        .detail(422);
    assert!(refused.contains("do not match their manifest"), "{refused}");
    assert_eq!(get(&app, "/v1/models/plain").await.json()["active_version"], 2);

    let unknown = post(&app, "/v1/models/plain/versions/7/activate", &Value::Null)
        .await
        .detail(404);
    assert_eq!(
        unknown,
        "there is no version 7 of model \"plain\"; there are: 1, 2, 3, 4"
    );
    let active = delete(&app, "/v1/models/plain/versions/2").await.detail(409);
    assert!(
        active.contains("is active; activate another before deleting it"),
        "{active}"
    );
    assert!(
        delete(&app, "/v1/models/plain/versions/1")
            .await
            .detail(409)
            .contains("was not published")
    );
    assert_eq!(delete(&app, "/v1/models/plain/versions/4").await.status, 204);
    assert!(!weights(4).exists());
    assert_eq!(delete(&app, "/v1/models/plain/versions/4").await.status, 404);

    let config = with_data(dir.path(), ServerConfig::default());
    let next = App::open(config.clone()).await.unwrap();
    let description = get(&next, "/v1/models/plain").await.json();
    assert_eq!(
        (&description["versions"], &description["active_version"]),
        (&json!([1, 2, 3]), &json!(2))
    );
    // A version that another server activates is loaded. If it is invalid, the previous one is served, also after a restart.
    store(dir.path())
        .set_active(
            &"plain".parse().unwrap(),
            1,
            0.0,
            &foreframe_jobs::store::Author::CommandLine,
        )
        .await
        .unwrap();
    wait_for_version(&next, "plain", 1).await;
    store(dir.path())
        .set_active(
            &"plain".parse().unwrap(),
            3,
            0.0,
            &foreframe_jobs::store::Author::CommandLine,
        )
        .await
        .unwrap();
    let third = App::open(config).await.unwrap();
    assert_eq!(get(&third, "/v1/models/plain").await.json()["active_version"], 1);
    assert_eq!(run_job(&third, &train("plain", 2)).await["result"]["version"], 5);
}

/// Changes a manifest so that its shapes differ from the weights'.
fn change_spec(model_dir: &Path) {
    let path = model_dir.join("manifest.json");
    let text = std::fs::read_to_string(&path).unwrap();
    let mut manifest: Value = serde_json::from_str(&text).unwrap();
    manifest["spec"]["hidden"] = json!(9);
    std::fs::write(path, manifest.to_string()).unwrap();
}

#[tokio::test]
async fn files_of_a_cancelled_collection_can_be_deleted() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let collect = |trials: u32| json!({"kind": "collect", "name": "d", "scenario": "crowded", "trials": trials});
    post(&app, JOBS, &collect(100_000)).await;
    let becomes = async |is_reached: &dyn Fn(&Value) -> bool| {
        poll_until(async || is_reached(&get(&app, "/v1/jobs/job-1").await.json()).then_some(())).await;
    };
    becomes(&|job| job["progress"]["done"].as_u64().is_some_and(|done| done > 0)).await;
    assert_eq!(delete(&app, "/v1/datasets/d").await.status, 409);
    post(&app, "/v1/jobs/job-1/cancel", &Value::Null).await;
    becomes(&|job| job["state"] == "cancelled").await;
    let occupied = post(&app, JOBS, &collect(2)).await.detail(409);
    assert!(
        occupied.contains("trials: 100000 in the directory, 2 requested"),
        "{occupied}"
    );
    assert_eq!(delete(&app, "/v1/datasets/d").await.status, 204);
    assert_eq!(std::fs::read_dir(dir.path().join("datasets")).unwrap().count(), 0);
    run_job(&app, &collect(2)).await;
    assert_eq!(get(&app, "/v1/datasets/d").await.json()["episodes"], 2);
}

#[tokio::test]
async fn data_sets_are_described_shown_and_deleted() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    assert_eq!(get(&app, "/v1/datasets").await.json(), json!({"datasets": []}));
    collect_data_set(&app).await;
    let list = get(&app, "/v1/datasets").await.json();
    let described = get(&app, "/v1/datasets/seen").await.json();
    assert_eq!(list, json!({"datasets": [described]}));
    assert_eq!((&described["episodes"], &described["seed"]), (&json!(40), &json!(1)));
    assert_eq!(described["content_hash"].as_str().unwrap().len(), 64);

    let picture = async |path: &str| get(&app, &format!("/v1/datasets/seen/episodes/{path}")).await;
    assert!(picture("39/preview.png").await.body.starts_with(b"\x89PNG"));
    let first = picture("0/preview.gif").await;
    assert!(first.body.starts_with(b"GIF89a") && first.headers["content-type"] == "image/gif");
    assert_ne!(picture("1/preview.gif").await.body, first.body);
    let absent = picture("40/preview.png").await.detail(404);
    assert!(absent.starts_with("there is no episode 40 in"), "{absent}");
    assert_eq!(picture("x/preview.png").await.status, 400);
    let unknown = get(&app, "/v1/datasets/..%2Fseen").await.detail(404);
    assert!(unknown.ends_with("there are: seen"), "{unknown}");

    let part = picture("39?from=10&limit=3").await.json();
    assert!(
        part["from"] == 10 && part["frame_count"].as_u64().unwrap() > 13,
        "{part}"
    );
    for name in ["frames", "times_s", "actions", "states"] {
        assert_eq!(part[name].as_array().unwrap().len(), 3, "{name}");
    }
    assert_eq!(part["states"][0].as_array().unwrap().len(), 6);
    assert_eq!(picture("39").await.json()["frames"][11], part["frames"][1]);
    assert_eq!(picture("39?from=99").await.json()["frames"], json!([]));
    picture("40").await.detail(404);
    let limits = picture("0?limit=301").await.detail(422);
    assert_eq!(limits, "limit is 301; it must be 1 to 300");
    let page = get(&app, "/v1/datasets/seen/inspection").await;
    assert!(String::from_utf8(page.body).unwrap().contains("Contact sheet"));
    assert!(
        page.headers["content-security-policy"]
            .to_str()
            .unwrap()
            .starts_with("default-src 'none'")
    );

    // Imported again with another frame period: the same content, but another animation.
    let metadata = dir.path().join("datasets/seen/meta/foreframe.json");
    let before = std::fs::read_to_string(&metadata).unwrap();
    let mut described: Value = serde_json::from_str(&before).unwrap();
    described["frame_period_s"] = json!(1.0);
    std::fs::write(&metadata, described.to_string()).unwrap();
    assert_ne!(picture("0/preview.gif").await.body, first.body);
    std::fs::write(&metadata, before).unwrap();
    assert_eq!(picture("0/preview.gif").await.body, first.body);

    let mut long = train("slow", 100_000);
    long["settings"]["run"] = json!({});
    post(&app, JOBS, &long).await;
    let needed = delete(&app, "/v1/datasets/seen").await.detail(409);
    assert_eq!(
        needed,
        "data set \"seen\" is in use by job-2; wait until that job has ended, or cancel it"
    );
    post(&app, "/v1/jobs/job-2/cancel", &Value::Null).await;
    poll_until(async || (get(&app, "/v1/jobs/job-2").await.json()["state"] == "cancelled").then_some(())).await;
    assert_eq!(delete(&app, "/v1/datasets/seen").await.status, 204);
    assert!(!dir.path().join("datasets/seen").exists());
    assert_eq!(delete(&app, "/v1/datasets/seen").await.status, 404);
}
