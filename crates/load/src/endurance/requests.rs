//! Clients of the ordinary load that change nothing: predictions, rollouts and pictures.

use std::sync::Arc;
use std::time::{Duration, Instant};

use foreframe::server::ImageBytes;
use foreframe_core::frame::Frame;
use foreframe_core::registry::Model;
use foreframe_core::serving::{PredictionInput, predict};
use foreframe_core::types::{Action, RobotState};
use serde_json::{Value, json};
use tokio::time::sleep;

use super::recording::are_equal_png;
use super::shared::{EnduranceRun, RunClient};
use crate::http::Request;
use crate::workload::{EXAMPLE_VALUE, Workload};

const PREDICTION_PERIOD: Duration = Duration::from_millis(200);
const ROLLOUT_PERIOD: Duration = Duration::from_secs(1);
const PICTURE_PERIOD: Duration = Duration::from_millis(250);
/// The base data set, which stays for the whole run.
pub(super) const BASE: &str = "seen";
/// Different episodes that are shown, in turn.
const EPISODES: u64 = 10;
/// Plans of a rollout request. All are the same, so all rollouts are the same prediction.
const PLANS: usize = 16;

/// The prediction that the library makes of the workload's request.
pub(super) fn expected(workload: &Workload, model: &Model) -> Vec<Frame> {
    let spec = workload.spec();
    let frame = |index| {
        Frame::new(
            spec.frame_width_px,
            spec.frame_height_px,
            workload.pixels(index).to_vec(),
        )
    };
    let values = |count: usize| vec![EXAMPLE_VALUE; count];
    let action = spec
        .action_inputs()
        .map(|count| Action::try_from(values(count)).unwrap());
    let input = PredictionInput {
        frames: (0..spec.context).map(|index| frame(index).unwrap()).collect(),
        state: spec
            .state_inputs()
            .map(|count| RobotState::try_from(values(count)).unwrap()),
        plan: action.map(|action| vec![action; spec.horizon]),
        ..PredictionInput::default()
    };
    predict(model, &[&input]).unwrap().remove(0).frames
}

/// Sends predictions and checks them. Returns when each was sent and how long it took.
pub(super) async fn predictions(run: Arc<EnduranceRun>, expected: Arc<Vec<Frame>>) -> Vec<(Instant, Duration)> {
    let (mut client, request) = (RunClient::new(&run, "predictions"), run.workload.predict_json());
    let mut times = Vec::new();
    while !run.is_over() {
        let sent = Instant::now();
        if let Some(answer) = client.ask(&request).await
            && (answer.is_refusal() || client.expect(&answer, &[200]))
            && answer.status == 200
        {
            times.push((sent, sent.elapsed()));
            if !are_equal_png(&images(&answer.json()["frames"]), &expected) {
                run.fault("a prediction over HTTP was not the library's");
            }
        }
        sleep(PREDICTION_PERIOD.saturating_sub(sent.elapsed())).await;
    }
    times
}

/// Sends rollout requests and checks every rollout.
pub(super) async fn rollouts(run: Arc<EnduranceRun>, expected: Arc<Vec<Frame>>) {
    let mut client = RunClient::new(&run, "rollouts");
    let mut body = run.workload.context_body();
    body["plans"] = json!(vec![body["plan"].clone(); PLANS]);
    body.as_object_mut().unwrap().remove("plan");
    let request = Request::json(&format!("/v1/models/{}/rollouts", run.workload.model()), &body);
    while !run.is_over() {
        if let Some(answer) = client.ask(&request).await
            && !answer.is_refusal()
            && client.expect(&answer, &[200])
        {
            let answer = answer.json();
            let rollouts = answer["rollouts"].as_array().cloned().unwrap_or_default();
            let are_right = rollouts
                .iter()
                .all(|rollout| are_equal_png(&images(rollout), &expected));
            if rollouts.len() != PLANS || !are_right {
                run.fault("a rollout was not the library's");
            }
        }
        sleep(ROLLOUT_PERIOD).await;
    }
}

/// Asks for animations of the base data set's episodes.
pub(super) async fn pictures(run: Arc<EnduranceRun>, mut episode: u64) {
    let mut client = RunClient::new(&run, "pictures");
    while !run.is_over() {
        let path = format!("/v1/datasets/{BASE}/episodes/{}/preview.gif", episode % EPISODES);
        episode += 1;
        if let Some(answer) = client.ask(&Request::get(&path)).await
            && !answer.is_refusal()
            && client.expect(&answer, &[200])
            && !answer.body.starts_with(b"GIF8")
        {
            run.fault("a picture is no GIF");
        }
        sleep(PICTURE_PERIOD).await;
    }
}

fn images(list: &Value) -> Vec<ImageBytes> {
    serde_json::from_value(list.clone()).unwrap_or_default()
}
