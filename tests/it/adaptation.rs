//! Adapting `rooms` to a car that it never saw, by the command and as a job.

use std::fmt::Write as _;
use std::path::Path;
use std::process::Output;
use std::sync::atomic::AtomicBool;

use foreframe::server::ServerConfig;
use foreframe_core::frame::codec;
use foreframe_core::nn::Conditioning;
use foreframe_data::dataset::{Dataset, Split};
use foreframe_train::evaluation::{self, EvaluationError};
use serde_json::{Value, json};

use crate::evaluation::{SIDE, spec, untrained};
use crate::fixtures::moving_squares;
use crate::process::{output, text};
use crate::service::{get, poll_until, post, start};

/// A recording of a car in a folder, `car` as a data set: frames of simulated drives, with a steering angle and a throttle of its own kind.
fn record_car(dir: &Path) {
    let arguments = "collect --scenario moving-observer --rooms varied --trials 12 --name drives";
    let collected = output(dir, &arguments.split(' ').collect::<Vec<_>>());
    assert!(collected.status.success(), "{}", text(&collected.stderr));
    write_recording(dir);
    let imported = output(
        dir,
        &["import", "recorded", "--csv", "recorded/car.csv", "--name", "car"],
    );
    assert!(imported.status.success(), "{}", text(&imported.stderr));
}

/// The frames of the data set `drives` as files, with a table of the car's actions and of where it is, and one of where it is alone.
fn write_recording(dir: &Path) {
    let drives = Dataset::open(&dir.join("data/datasets/drives")).unwrap();
    std::fs::create_dir(dir.join("recorded")).unwrap();
    let mut actions = "timestamp,file,action.angle,action.throttle,x,y,heading_cos,heading_sin\n".to_owned();
    let mut places = "timestamp,file,x,y,heading_cos,heading_sin\n".to_owned();
    for frame in 0..drives.info().frame_count {
        let png = codec::encode_png(&drives.frame(frame).unwrap()).unwrap();
        std::fs::write(dir.join(format!("recorded/{frame:04}.png")), png).unwrap();
        let [linear, angular] = [drives.action(frame)[0], drives.action(frame)[1]];
        let [x, y, cos, sin] = *drives.state(frame).first_chunk().unwrap();
        let (time_s, angle, throttle) = (frame as f64 * 0.2, -0.7 * angular, 2.0 * linear);
        let place = format!("{x},{y},{cos},{sin}");
        writeln!(actions, "{time_s:.1},{frame:04}.png,{angle},{throttle},{place}").unwrap();
        writeln!(places, "{time_s:.1},{frame:04}.png,{place}").unwrap();
    }
    std::fs::write(dir.join("recorded/car.csv"), actions).unwrap();
    std::fs::write(dir.join("recorded/places.csv"), places).unwrap();
}

/// That a command was refused with these words.
fn assert_refused(command: &str, words: &str, refused: &Output) {
    let said = text(&refused.stderr);
    assert_eq!(refused.status.code(), Some(2), "{command}");
    assert!(said.contains(words), "{command}: {said}");
}

#[test]
fn rooms_is_scored_on_a_car_and_adapted_to_it_unless_it_gets_worse() {
    let dir = tempfile::tempdir().unwrap();
    record_car(dir.path());
    let models = Path::new(env!("CARGO_MANIFEST_DIR")).join("models");
    let run = |arguments: &str| {
        let own = ["--models-dir", models.to_str().unwrap()];
        output(dir.path(), &arguments.split(' ').chain(own).collect::<Vec<_>>())
    };
    let scored = run("evaluate --model rooms --dataset car --split validation --windows 12 --nearest-windows 40");
    assert!(scored.status.success(), "{}", text(&scored.stderr));
    let said = text(&scored.stdout);
    assert!(
        said.contains("against baselines that know nothing of this data set"),
        "{said}"
    );
    let refused = run("calibrate --model rooms --dataset car");
    assert_eq!(refused.status.code(), Some(2));
    assert!(text(&refused.stderr).contains("angle"), "{}", text(&refused.stderr));

    let renamed = run("adapt car --set name=other");
    assert_refused("adapt", "use --name", &renamed);
    let short = "--set sequence.batch_size=2 --set run.warmup_steps=0 --steps 4";
    let adapted = run(&format!(
        "adapt car --mirror action.angle {short} --set sequence.learning_rate=0.0003"
    ));
    let said = format!("{}{}", text(&adapted.stdout), text(&adapted.stderr));
    for part in [
        "camera, estimated from",
        "the last frame, copied",
        "rooms as it is",
        "car-adapted",
    ] {
        assert!(said.contains(part), "{said}");
    }
    // With so large a step, it gets worse.
    let worse = run(&format!(
        "adapt car --name worse {short} --set sequence.learning_rate=0.1"
    ));
    assert_eq!(worse.status.code(), Some(2), "{}", text(&worse.stdout));
    assert!(
        text(&worse.stderr).contains("became no better than rooms"),
        "{}",
        text(&worse.stderr)
    );
    assert!(!dir.path().join("runs/worse").exists());
    // Bands for robots that it never saw.
    for option in ["--unseen drives", "--like rooms"] {
        let calibrated = run(&format!(
            "calibrate --model runs/car-adapted/model --dataset car --windows 40 {option}"
        ));
        assert!(calibrated.status.success(), "{}", text(&calibrated.stderr));
    }
    for (command, part) in [
        (
            "calibrate --model runs/car-adapted/model --dataset car --unseen car",
            "was trained on data set \"car\"",
        ),
        (
            "calibrate --model moving-flow --dataset drives --unseen car",
            "has no bands for robots that it never saw",
        ),
        (
            "calibrate --model runs/car-adapted/model --dataset car --like moving-flow",
            "has no bands for robots that it never saw",
        ),
        ("adapt car --name x --mirror angel", "no channel \"angel\""),
        (
            "adapt car --name x --remember",
            "no states x, y, heading_cos and heading_sin",
        ),
        (
            "adapt car --name x --set sequence.steps=5",
            "sequence.steps cannot be set for an adaptation: use steps",
        ),
        (
            "adapt car --name x --set model.context=4",
            "model.context cannot be set",
        ),
        (
            "adapt car --name x --set data.first_seconds=1",
            "data.first_seconds is 1; a window alone takes 2 s",
        ),
        (
            "train --preset recording --dataset car --set data.first_seconds=9 --set data.windows=4",
            "that needs data.windows = \"all\"",
        ),
    ] {
        assert_refused(command, part, &run(command));
    }
    let refused = run("adapt car --from moving-flow");
    assert_eq!(refused.status.code(), Some(2));
    assert!(
        text(&refused.stderr).contains("start from rooms"),
        "{}",
        text(&refused.stderr)
    );
}

#[test]
fn a_set_flag_ends_the_estimate_of_the_camera_and_the_judging() {
    let dataset = moving_squares(30, SIDE, 0.2);
    let model = untrained("still", spec(Conditioning::None), &dataset);
    let estimated = |is_cancelled: bool| {
        let cancelled = AtomicBool::new(is_cancelled);
        evaluation::estimate_camera(&model, &dataset, 0.6, 0.0, &cancelled)
    };
    assert!(estimated(false).unwrap().is_some());
    assert!(matches!(estimated(true), Err(EvaluationError::Cancelled)));
    let windows = evaluation::windows_of(&model, &dataset, Split::Validation).unwrap();
    let judged = |is_cancelled: bool| {
        let cancelled = AtomicBool::new(is_cancelled);
        evaluation::window_errors(&model, &dataset, &windows, 1, &cancelled)
    };
    assert_eq!(judged(false).unwrap().len(), windows.len());
    assert!(matches!(judged(true), Err(EvaluationError::Cancelled)));
}

#[test]
fn a_room_is_remembered_where_the_state_tells_the_pose() {
    let dir = tempfile::tempdir().unwrap();
    let models = Path::new(env!("CARGO_MANIFEST_DIR")).join("models");
    let run = |arguments: &str| {
        let own = ["--models-dir", models.to_str().unwrap()];
        output(dir.path(), &arguments.split(' ').chain(own).collect::<Vec<_>>())
    };
    let collected = output(
        dir.path(),
        &"collect --scenario moving-observer --trials 12 --name drives"
            .split(' ')
            .collect::<Vec<_>>(),
    );
    assert!(collected.status.success(), "{}", text(&collected.stderr));
    write_recording(dir.path());
    let remembering = "train --from rooms --dataset drives --set sequence.steps=4 --set sequence.batch_size=2 \
        --set run.warmup_steps=0 --set model.flow.memory=true --out runs/home";
    let trained = run(&format!("{remembering} --set data.hidden=0 --set data.mirror=off"));
    assert!(trained.status.success(), "{}", text(&trained.stderr));
    let scored = run("evaluate --model runs/home/model --dataset drives --windows 6 --nearest-windows 40");
    assert!(scored.status.success(), "{}", text(&scored.stderr));
    // A car's own actions, and where it is.
    let poses = "--state x --state y --state heading_cos --state heading_sin";
    for (name, csv) in [("placed", "car"), ("places", "places")] {
        let import = format!("import recorded --csv recorded/{csv}.csv --name {name} {poses}");
        let imported = output(dir.path(), &import.split(' ').collect::<Vec<_>>());
        assert!(imported.status.success(), "{}", text(&imported.stderr));
    }
    let adapted = run(
        "adapt placed --remember --name stays --steps 4 --set sequence.batch_size=2 --set run.warmup_steps=0 \
         --set sequence.learning_rate=0.0003",
    );
    assert!(adapted.status.success(), "{}", text(&adapted.stderr));
    let manifest = std::fs::read(dir.path().join("runs/stays/model/manifest.json")).unwrap();
    let manifest: Value = serde_json::from_slice(&manifest).unwrap();
    assert_eq!(manifest["spec"]["flow"]["memory"], true, "{manifest}");
    for (command, part) in [
        (remembering, "set data.mirror to off and data.hidden to 0"),
        ("adapt drives --name x --remember --mirror y", "cannot be used with"),
        (
            "adapt places --name x --remember",
            "has no actions, so no room can be remembered",
        ),
    ] {
        assert_refused(command, part, &run(command));
    }
}

#[tokio::test]
async fn a_job_adapts_rooms_and_publishes_the_model_unless_it_gets_worse() {
    let dir = tempfile::tempdir().unwrap();
    record_car(dir.path());
    let config = ServerConfig {
        data_dir: dir.path().join("data"),
        models_dir: Path::new(env!("CARGO_MANIFEST_DIR")).join("models"),
        ..ServerConfig::default()
    };
    let app = start(config, Vec::new());
    let adapt = |name: &str, learning_rate: f64| {
        let settings = json!({
            "sequence": {"batch_size": 2, "learning_rate": learning_rate},
            "run": {"warmup_steps": 0},
        });
        json!({"kind": "adapt", "name": name, "dataset": "car", "steps": 4, "mirror": ["action.angle"], "settings": settings})
    };
    let end_of = async |path: &str| {
        poll_until(async || {
            let job = get(&app, path).await.json();
            ["succeeded", "failed"]
                .iter()
                .any(|state| job["state"] == *state)
                .then_some(job)
        })
        .await
    };
    let ended = async |body: &Value| {
        let taken = post(&app, "/v1/jobs", body).await;
        assert_eq!(taken.status, 202, "{}", taken.json());
        end_of(&format!("/v1/jobs/{}", taken.json()["id"].as_str().unwrap())).await
    };
    let better = ended(&adapt("mycar", 0.0003)).await;
    assert_eq!(
        (&better["state"], &better["result"]["version"]),
        (&json!("succeeded"), &json!(1)),
        "{better}"
    );
    let errors = &better["result"]["metrics"]["adaptation"];
    assert!(errors["after"].as_f64() < errors["before"].as_f64(), "{errors}");
    let model = poll_until(async || {
        let answer = get(&app, "/v1/models/mycar").await;
        (answer.status == 200).then(|| answer.json())
    })
    .await;
    assert_eq!(model["spec"]["actions"][0]["name"], "action.angle", "{model}");
    let log = get(&app, &format!("/v1/jobs/{}/logs", better["id"].as_str().unwrap())).await;
    assert!(
        log.json().to_string().contains("camera, estimated from"),
        "{}",
        log.json()
    );

    let worse = ended(&adapt("worse", 0.1)).await;
    assert_eq!(worse["state"], "failed");
    assert!(
        worse["error"].as_str().unwrap().contains("became no better than rooms"),
        "{worse}"
    );
    assert_eq!(get(&app, "/v1/models/worse").await.status, 404);

    // A resumed job starts from the same version, though another one is active now.
    assert_eq!(worse["spec"]["from_version"], 1, "{worse}");
    let newer = ended(&adapt("rooms", 0.0003)).await;
    assert_eq!(newer["result"]["version"], 2, "{newer}");
    let activated = post(&app, "/v1/models/rooms/versions/2/activate", &Value::Null).await;
    assert_eq!(activated.json()["active_version"], 2);
    let path = format!("/v1/jobs/{}", worse["id"].as_str().unwrap());
    post(&app, &format!("{path}/resume"), &Value::Null).await;
    let again = end_of(&path).await;
    assert_eq!((&again["attempts"], &again["error"]), (&json!(2), &worse["error"]));
    assert_eq!(again["spec"], worse["spec"]);

    let refused = async |field: &str, value: Value| {
        let mut body = adapt("x", 0.001);
        body[field] = value;
        post(&app, "/v1/jobs", &body).await.detail(422)
    };
    assert!(
        refused("from", json!("moving-flow"))
            .await
            .contains("from: moving-flow does not see how fast")
    );
    assert!(
        refused("from", json!("romms"))
            .await
            .contains("there is no model \"romms\"")
    );
    assert!(refused("from_version", json!(9)).await.starts_with("from_version: "));
    assert!(
        refused("dataset", json!("cart"))
            .await
            .contains("there is no data set \"cart\"")
    );
    assert!(
        refused("mirror", json!(["angel"]))
            .await
            .contains("mirror: the data set has no channel \"angel\"")
    );
    assert!(refused("steps", json!(0)).await.starts_with("steps: 0 is out of range"));
    let mirrored = refused("remember", json!(true)).await;
    assert!(
        mirrored.contains("a mirrored room is not the one to remember"),
        "{mirrored}"
    );
    assert!(
        refused("settings", json!({"sequence": {"stepps": 1}}))
            .await
            .contains("stepps")
    );
}
