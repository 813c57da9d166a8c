//! Plans over HTTP: what a goal leads to, bad goals and budgets, and the same search in the library.

use std::cell::Cell;
use std::path::Path;
use std::time::{Duration, Instant};

use foreframe::server::ServerConfig;
use foreframe::server::protocol::{ClientMessage, Codec, FrameMessage};
use foreframe_core::frame::codec;
use foreframe_core::nn::{Conditioning, ModelSpec};
use foreframe_core::planning::{
    ActionLimit, CandidateKind, PlanSettings, Planner, PlannerInput, SolverKind, SolverSettings,
};
use foreframe_core::registry::{self, Model};
use foreframe_core::serving::{ConditioningInput, Task, compute_task};
use foreframe_core::types::RobotState;
use serde_json::{Value, json};

use crate::client::{Client, SessionHandle, numbered_frame};
use crate::service::{
    Answer, CONTEXT, HORIZON, app, context, frame, model, png, post, post_text, run, slow_spec, spec, start, with_data,
};

const PLAN: &str = "/v1/models/moving/plan";

fn limits() -> Value {
    json!([{"low": 0.0, "high": 0.5}, {"low": -0.8, "high": 0.8}])
}

/// A request with a search within the limits.
fn request(goal: Value, search: Value) -> Value {
    let mut body =
        json!({"frames": context(), "state": [0.5], "goal": goal, "search": {"limits": limits(), "budget_ms": 10_000}});
    for (name, value) in search.as_object().unwrap() {
        body["search"][name] = value.clone();
    }
    body
}

fn ahead() -> Value {
    json!({"position_m": [0.5, 0.1]})
}

/// What does not depend on the time.
fn found(answer: &Answer) -> Value {
    assert_eq!(answer.status, 200, "{}", String::from_utf8_lossy(&answer.body));
    let mut found = answer.json();
    assert!(found["time_ms"].as_f64().unwrap() > 0.0);
    found.as_object_mut().unwrap().remove("time_ms");
    found
}

#[tokio::test]
async fn a_plan_leads_towards_its_goal() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    for kind in ["random-shooting", "cem", "mppi"] {
        let mut body = request(ahead(), json!({"solver": {"kind": kind, "seed": 7}}));
        body["with_frames"] = json!(true);
        let answer = found(&post(&app, PLAN, &body).await);
        let plan = &answer["plan"];
        assert_eq!(
            (&plan["kind"], &answer["safe"]),
            (&json!("drawn"), &json!(true)),
            "{kind}"
        );
        let way = plan["way"].as_array().unwrap();
        assert_eq!(
            (way.len(), plan["frames"].as_array().unwrap().len()),
            (HORIZON, HORIZON)
        );
        let [forward, left] = [0, 1].map(|part| way[HORIZON - 1][part].as_f64().unwrap());
        assert!(forward > 0.12 && left > 0.0, "{kind}: {way:?}");
        let distance = plan["costs"]["goal_distance"].as_f64().unwrap();
        assert!((distance - (0.5 - forward).hypot(0.1 - left)).abs() < 1e-4);
        assert_eq!(
            (&answer["samples"], &answer["iterations"]),
            (&json!(256 * 4 + 1), &json!(4))
        );
        assert_eq!(
            answer,
            found(&post(&app, PLAN, &body).await),
            "the same seed gives the same answer"
        );
    }
}

#[tokio::test]
async fn the_present_plan_and_stopping_are_candidates() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let kinds = |answer: &Value| -> Vec<String> {
        let others = answer["runners_up"].as_array().unwrap();
        let all = std::iter::once(&answer["plan"]).chain(others);
        all.map(|plan| plan["kind"].as_str().unwrap().to_owned()).collect()
    };
    let mut body = request(ahead(), json!({"solver": {"samples": 1, "iterations": 1}}));
    body["present"] = json!([[0.1, 0.0]]);
    let answer = found(&post(&app, PLAN, &body).await);
    let known = kinds(&answer);
    assert!(
        ["stop", "present"]
            .iter()
            .all(|kind| known.iter().any(|known| known == kind)),
        "{known:?}"
    );
    // Where the robot is, nothing is better than to stop.
    let here = request(json!({"position_m": [0.0, 0.0], "heading_rad": 0.0}), json!({}));
    let mut here = here;
    here["state"] = json!([0.0]);
    let answer = found(&post(&app, PLAN, &here).await);
    let first = answer["plan"]["actions"][0][0].as_f64().unwrap();
    assert!(first < 0.06, "{answer}");
}

#[tokio::test]
async fn a_goal_image_is_reached_by_predicted_frames() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let search = json!({"solver": {"samples": 20, "iterations": 2}, "costs": {"smoothness": 0}});
    let answer = found(&post(&app, PLAN, &request(json!({"image": png(&frame(99))}), search)).await);
    assert_eq!((&answer["samples"], &answer["predicted"]), (&json!(41), &json!(41)));
    let costs = answer["plan"]["costs"].as_object().unwrap();
    assert_eq!(costs.keys().collect::<Vec<_>>(), ["goal_image"]);
    let cost = |plan: &Value| plan["cost"].as_f64().unwrap();
    let others = answer["runners_up"].as_array().unwrap();
    assert!(others.iter().all(|other| cost(other) >= cost(&answer["plan"])));
}

#[tokio::test]
async fn bad_goals_and_budgets_are_refused_with_the_field() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    for (goal, search, detail) in [
        (
            json!({}),
            json!({}),
            "goal is empty; give position_m, heading_rad or image",
        ),
        (
            json!({"position_m": [2000.0, 0.0]}),
            json!({}),
            "goal.position_m[0] is 2000; it must be -1000 to 1000",
        ),
        (
            json!({"position_m": [1.0, 2.0, 3.0]}),
            json!({}),
            "goal.position_m has too many entries, or a comma or bracket is missing",
        ),
        (
            ahead(),
            json!({"budget_ms": 0}),
            "budget_ms is 0; it must be 1 to 10000",
        ),
        (
            ahead(),
            json!({"budget_ms": 60_000}),
            "budget_ms is 60000; it must be 1 to 10000",
        ),
        (
            ahead(),
            json!({"solver": {"samples": 0}}),
            "solver.samples is 0; it must be 1 to 4096",
        ),
        (
            ahead(),
            json!({"steps": 51}),
            "steps is 51; this server predicts 1 to 50",
        ),
        (
            ahead(),
            json!({"costs": {"clearance": 2.0}}),
            "costs.clearance cannot be computed: the model estimates no depth",
        ),
        (
            ahead(),
            json!({"costs": {"goal_image": 2.0}}),
            "costs.goal_image cannot be computed: the goal has no image",
        ),
        (
            ahead(),
            json!({"limits": [{"low": 0.0, "high": 1.0}]}),
            "limits has 1 entries; model \"moving\" has 2 action channels",
        ),
        (
            ahead(),
            json!({"limits": null}),
            "model \"moving\" is not calibrated, so the ranges of its actions are not known; give limits",
        ),
    ] {
        assert_eq!(post(&app, PLAN, &request(goal, search)).await.detail(422), detail);
    }
    let image = json!({"image": png(&foreframe_core::frame::Frame::new(4, 4, vec![0; 16]).unwrap())});
    let detail = post(&app, PLAN, &request(image, json!({}))).await.detail(422);
    assert!(detail.starts_with("goal.image is 4×4 px"), "{detail}");
    let plain = post(&app, "/v1/models/plain/plan", &request(ahead(), json!({}))).await;
    assert_eq!(
        plain.detail(422),
        "model \"plain\" takes no actions, so there is nothing to plan"
    );
    let unknown = post(&app, PLAN, &request(ahead(), json!({"costs": {"speed": 1.0}}))).await;
    assert!(unknown.detail(422).contains("unknown variant `speed`"));
}

fn slow(dir: &std::path::Path) -> Model {
    let slow = ModelSpec {
        conditioning: Conditioning::StateAction,
        ..slow_spec()
    };
    model(dir, "slow", slow)
}

#[tokio::test]
async fn the_budget_is_kept_and_the_answer_is_to_stop_if_nothing_was_judged() {
    let dir = tempfile::tempdir().unwrap();
    let config = ServerConfig {
        max_batch: 512,
        ..ServerConfig::default()
    };
    let app = start(with_data(dir.path(), config), vec![slow(dir.path())]);
    // Another client's rollouts are being predicted, all together, so nothing comes back in time.
    let plans: Vec<Value> = (0..500).map(|_| json!([[0.1, 0.1], [0.1, 0.1]])).collect();
    let many = json!({"frames": context(), "state": [0.5], "plans": plans});
    let busy = post(&app, "/v1/models/slow/rollouts", &many);
    let plan = async {
        tokio::time::sleep(std::time::Duration::from_millis(20)).await;
        let body = request(json!({"image": png(&frame(3))}), json!({"budget_ms": 1}));
        let begun = Instant::now();
        (post(&app, "/v1/models/slow/plan", &body).await, begun.elapsed())
    };
    let (_, (answer, took)) = tokio::join!(busy, plan);
    let answer = found(&answer);
    assert_eq!((&answer["safe"], &answer["reason"]), (&json!(false), &json!("no-time")));
    assert_eq!(answer["plan"]["kind"], "stop");
    assert!(took.as_millis() < 2000, "{took:?}");
}

#[test]
fn a_plan_out_of_the_training_is_not_chosen_though_it_was_not_predicted() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let model = registry::load(&root.join("models/moving-flow")).unwrap();
    let request: Value = serde_json::from_slice(&std::fs::read(root.join("examples/request.json")).unwrap()).unwrap();
    let state: RobotState = serde_json::from_value(request["state"].clone()).unwrap();
    let image = |place: usize| {
        codec::decode(&std::fs::read(root.join(format!("examples/frames/frame-00{place}.png"))).unwrap())
    };
    let frames: Vec<_> = (0..5).map(|place| image(place).unwrap()).collect();
    let far = ActionLimit {
        low: -5.0,
        high: 5.0,
        max_change: None,
    };
    for seed in 1..=5 {
        let settings = PlanSettings {
            solver: SolverSettings {
                kind: SolverKind::RandomShooting,
                seed,
                ..SolverSettings::default()
            },
            limits: Some(vec![far; 2]),
            budget: Some(Duration::from_millis(100)),
            ..PlanSettings::default()
        };
        let input = PlannerInput {
            goal: serde_json::from_value(ahead()).unwrap(),
            settings,
            state: Some(state.clone()),
            ..PlannerInput::default()
        };
        let mut planner = Planner::new(&model, input).unwrap();
        // After the search there is no time to predict what it found.
        let elapsed = Cell::new(Duration::ZERO);
        let clock = || elapsed.replace(elapsed.get() + Duration::from_millis(10));
        while let Some(batch) = planner.next_batch(&clock).unwrap() {
            let inputs =
                ConditioningInput::of_plans(batch.plans, Some(state.clone()), Some(5), &model.manifest).unwrap();
            let task = Task::rollout(frames.clone(), Vec::new(), None, inputs, &model.manifest).unwrap();
            planner
                .record(compute_task(&model, &task).unwrap(), Duration::from_secs(1))
                .unwrap();
        }
        let choice = planner.finish();
        assert_eq!((choice.predicted, choice.best.kind), (1, CandidateKind::Stop));
        let [others, best] = [&choice.runners_up[..], std::slice::from_ref(&choice.best)]
            .map(|plans| plans.iter().map(|plan| plan.novelty.unwrap()).collect::<Vec<f32>>());
        assert!(
            !others.is_empty() && others.iter().all(|&novelty| novelty > 0.99),
            "{others:?}"
        );
        assert!(best[0] < 0.98, "{best:?}");
    }
}

#[tokio::test]
async fn a_plan_is_answered_as_a_picture() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let body = request(ahead(), json!({})).to_string();
    let sheet = post_text(&app, PLAN, body.clone(), "image/png").await;
    assert!(codec::decode(&sheet.body).unwrap().height() > 100);
    assert!(
        post_text(&app, PLAN, body, "image/gif")
            .await
            .body
            .starts_with(b"GIF89a")
    );
}

#[tokio::test]
async fn a_session_plans_from_its_last_frame() {
    let dir = tempfile::tempdir().unwrap();
    let with_actions = spec(Conditioning::Action);
    let config = with_data(dir.path(), ServerConfig::default());
    let app = start(config, vec![model(dir.path(), "moving", with_actions)]);
    let server = run(app.clone()).await;
    let session = SessionHandle::of(&post(&app, "/v1/sessions", &json!({"model": "moving"})).await.json());
    let mut client = Client::connect(server.address, &session.path("/stream"), Codec::Json)
        .await
        .unwrap();
    let body = json!({"goal": ahead(), "search": {"limits": limits(), "budget_ms": 10_000}});
    let early = post(&app, &session.path("/plan"), &body).await.detail(409);
    assert!(early.starts_with("the session has 0 of the 3 frames"), "{early}");
    for seq in 0..CONTEXT as u64 {
        let message = FrameMessage {
            action: Some(vec![0.2, 0.1]),
            ..numbered_frame(seq)
        };
        client.ask(&ClientMessage::Frame(message)).await;
    }
    let answer = found(&post(&app, &session.path("/plan"), &body).await);
    assert_eq!(answer["safe"], true);
    let all = std::iter::once(&answer["plan"]).chain(answer["runners_up"].as_array().unwrap());
    let present = all.clone().find(|plan| plan["kind"] == "present");
    // The action of the last frame, held, is the plan that the robot follows.
    assert_eq!(
        present.map(|plan| plan["actions"].clone()),
        Some(json!([[0.2, 0.1], [0.2, 0.1]]))
    );
    server.stop().await;
}
