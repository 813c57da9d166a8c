//! The simulator over HTTP.

use axum::body::Body;
use axum::http::Request;
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use foreframe::server::{App, ServerConfig};
use foreframe_core::frame::codec;
use foreframe_core::types::{Action, Seed};
use foreframe_sim::{Environment, PlanarPose, Scenario, TrialParameters, WorldConfig};
use serde_json::{Value, json};

use crate::service::{Answer, app, post, send};

async fn create(app: &App, body: Value) -> Answer {
    post(app, "/v1/environments", &body).await
}

async fn step(app: &App, id: &str, action: Value) -> Answer {
    post(app, &format!("/v1/environments/{id}/step"), &json!({"action": action})).await
}

fn pixels(observation: &Value) -> Vec<u8> {
    let bytes = STANDARD.decode(observation["frame"].as_str().unwrap()).unwrap();
    codec::decode(&bytes).unwrap().pixels().to_vec()
}

#[tokio::test]
async fn an_environment_returns_what_the_simulator_returns() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let created = create(&app, json!({"scenario": "moving-observer", "seed": 7})).await;
    assert_eq!(created.status, 201);
    let body = created.json();
    let id = body["id"].as_str().unwrap();
    assert_eq!(created.headers["location"], format!("/v1/environments/{id}"));
    let limits = &body["action_bounds"];
    assert_eq!((&limits[0]["low"], &limits[0]["high"]), (&json!(-0.7), &json!(0.7)));
    let mut local = Environment::new(Scenario::MovingObserver, WorldConfig::default()).unwrap();
    let (first, trial) = local.reset(Some(Seed(7))).unwrap();
    assert_eq!(pixels(&body["observation"]), first.frame.pixels());
    assert_eq!(
        serde_json::from_value::<TrialParameters>(body["info"]["trial"].clone()).unwrap(),
        trial
    );
    for _ in 0..3 {
        let stepped = step(&app, id, json!([0.3, -0.2])).await.json();
        let expected = local.step(&Action::try_from(vec![0.3, -0.2]).unwrap()).unwrap();
        assert_eq!(pixels(&stepped["observation"]), expected.observation.frame.pixels());
        let state: Vec<f32> = serde_json::from_value(stepped["observation"]["state"].clone()).unwrap();
        assert_eq!(state, expected.observation.state.as_slice());
        let poses: Vec<PlanarPose> = serde_json::from_value(stepped["info"]["poses"].clone()).unwrap();
        let world = local.world().unwrap();
        assert_eq!(poses, [vec![world.observer_pose()], world.other_robot_poses()].concat());
        assert_eq!(stepped["reward"].as_f64().unwrap() as f32, expected.reward);
    }
}

#[tokio::test]
async fn an_ended_episode_needs_a_reset() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let world = json!({"max_duration_s": 0.6, "frame_width_px": 16, "frame_height_px": 16});
    let body = create(&app, json!({"scenario": "crowded", "world": world}))
        .await
        .json();
    let id = body["id"].as_str().unwrap();
    let first = step(&app, id, json!([0, 0])).await.json();
    let last = step(&app, id, json!([0, 0])).await.json();
    assert_eq!((&first["truncated"], &last["truncated"]), (&json!(false), &json!(true)));
    let detail = step(&app, id, json!([0, 0])).await.detail(409);
    assert!(detail.contains("reset"), "{detail}");
    let path = format!("/v1/environments/{id}/reset");
    let next = post(&app, &path, &json!({})).await.json();
    assert_eq!(next["info"]["trial"]["trial"], 1);
    let again = post(&app, &path, &json!({"seed": 0})).await.json();
    assert_eq!(pixels(&again["observation"]), pixels(&body["observation"]));
}

#[tokio::test]
async fn invalid_environment_requests_are_refused_with_the_field() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    for (body, part) in [
        (json!({"scenario": "crowdd"}), "static-observer"),
        (json!({"scenario": "crowded", "colour": 1}), "colour"),
        (
            json!({"scenario": "crowded", "world": {"frame_width_px": 4096}}),
            "512×512",
        ),
        (
            json!({"scenario": "crowded", "world": {"frame_period_s": 9.0}}),
            "frame_period_s",
        ),
    ] {
        let detail = create(&app, body).await.detail(422);
        assert!(detail.contains(part), "{detail}");
    }
    let body = create(&app, json!({"scenario": "crowded"})).await.json();
    let id = body["id"].as_str().unwrap();
    let detail = step(&app, id, json!([0.1])).await.detail(422);
    assert!(detail.starts_with("action:"), "{detail}");
    // Too large for f32.
    step(&app, id, json!([0.1, 1e39])).await.detail(400);
    step(&app, "env-99", json!([0, 0])).await.detail(404);
}

#[tokio::test]
async fn environments_are_limited_and_deleting_one_frees_its_place() {
    let dir = tempfile::tempdir().unwrap();
    let config = ServerConfig {
        max_environments: 1,
        ..ServerConfig::default()
    };
    let app = app(dir.path(), config);
    let small = json!({"scenario": "crowded", "world": {"frame_width_px": 16, "frame_height_px": 16}});
    let id = create(&app, small.clone()).await.json()["id"].clone();
    let refused = create(&app, small.clone()).await;
    assert_eq!(refused.headers["retry-after"], "1");
    refused.detail(503);
    let path = format!("/v1/environments/{}", id.as_str().unwrap());
    let deleted = send(&app, Request::delete(&path).body(Body::empty()).unwrap()).await;
    assert_eq!(deleted.status, 204);
    assert_eq!(create(&app, small).await.status, 201);
}

#[tokio::test]
async fn an_idle_environment_is_deleted() {
    let dir = tempfile::tempdir().unwrap();
    let config = ServerConfig {
        environment_idle_ms: 1,
        ..ServerConfig::default()
    };
    let app = app(dir.path(), config);
    let body = create(&app, json!({"scenario": "static-observer"})).await.json();
    tokio::time::sleep(std::time::Duration::from_millis(2)).await;
    let detail = step(&app, body["id"].as_str().unwrap(), json!([0, 0]))
        .await
        .detail(404);
    assert!(detail.contains("is dropped"), "{detail}");
}

#[tokio::test]
async fn at_the_limit_a_new_environment_replaces_the_idlest() {
    let dir = tempfile::tempdir().unwrap();
    let config = ServerConfig {
        max_environments: 2,
        environment_evict_ms: 0,
        ..ServerConfig::default()
    };
    let app = app(dir.path(), config);
    let small = json!({"scenario": "crowded", "world": {"frame_width_px": 16, "frame_height_px": 16}});
    let mut ids = Vec::new();
    for _ in 0..20 {
        let created = create(&app, small.clone()).await;
        assert_eq!(created.status, 201);
        ids.push(created.json()["id"].as_str().unwrap().to_owned());
    }
    step(&app, &ids[17], json!([0, 0])).await.detail(404);
    for id in &ids[18..] {
        assert_eq!(step(&app, id, json!([0, 0])).await.status, 200);
    }
}
