//! What `OpenEnv`'s tools read about an environment.

use axum::body::Bytes;
use axum::http::StatusCode;
use axum::response::{IntoResponse as _, Response};
use serde_json::{Value, json};

use super::NamedScenario;
use foreframe_core::types::Channel;
use foreframe_sim::robot::{MAX_ANGULAR_RAD_S, MAX_LINEAR_M_S};
use foreframe_sim::{Scenario, action_channels, state_channels};

/// JSON schemas of actions, observations and states.
pub(super) fn schema() -> Value {
    let channels = |channels: Vec<Channel>| {
        let named = |channel: &Channel| format!("{} ({})", channel.name, channel.unit);
        channels.iter().map(named).collect::<Vec<_>>().join(", ")
    };
    let numbers =
        |description: String| json!({"type": "array", "items": {"type": "number"}, "description": description});
    let mut action = numbers(format!(
        "{}; limited to ±{MAX_LINEAR_M_S} and ±{MAX_ANGULAR_RAD_S}",
        channels(action_channels())
    ));
    action["minItems"] = json!(2);
    action["maxItems"] = json!(2);
    json!({
        "action": {"type": "object", "required": ["action"], "properties": {"action": action}},
        "observation": {
            "type": "object",
            "required": ["frame", "state", "terminated", "truncated", "info"],
            "properties": {
                "frame": {"type": "string", "contentEncoding": "base64", "contentMediaType": "image/png"},
                "state": numbers(channels(state_channels())),
                "terminated": {"type": "boolean", "description": "the other robot has reached its goal"},
                "truncated": {"type": "boolean", "description": "the time of the episode is over"},
                "info": {"type": "object"},
            },
        },
        "state": {
            "type": "object",
            "properties": {
                "episode_id": {"type": ["string", "null"]},
                "step_count": {"type": "integer", "minimum": 0},
                "scenario": {"type": "string"},
            },
        },
    })
}

/// Name and purpose.
pub(super) fn metadata(scenario: Scenario) -> Value {
    json!({
        "name": scenario.name(),
        "description": "a simulated robot with a camera, among other robots; keep the other robot in view",
        "version": env!("CARGO_PKG_VERSION"),
    })
}

/// The paths of an environment, as `OpenEnv`'s own servers list them.
pub(super) fn openapi(scenario: Scenario) -> Value {
    let operation = |summary: &str| json!({"summary": summary, "responses": {"200": {"description": "The answer"}}});
    json!({
        "openapi": "3.1.0",
        "info": {"title": scenario.name(), "version": env!("CARGO_PKG_VERSION")},
        "paths": {
            "/reset": {"post": operation("Begins an episode in an environment of its own")},
            "/step": {"post": operation("The first step of an episode in an environment of its own")},
            "/state": {"get": operation("The state of an environment before its first episode")},
            "/schema": {"get": operation("JSON schemas of actions, observations and states")},
            "/metadata": {"get": operation("Name and purpose")},
            "/health": {"get": operation("Whether the environment can be used")},
            "/mcp": {"post": operation("The environment's tools: none")},
        },
    })
}

// The errors of JSON-RPC.
const PARSE_ERROR: i32 = -32700;
const INVALID_REQUEST: i32 = -32600;
const METHOD_NOT_FOUND: i32 = -32601;

/// Answers the Model Context Protocol: the environment has no tools. A notification gets an empty answer.
pub(super) async fn mcp(_: NamedScenario, body: Bytes) -> Response {
    match mcp_answer(&body) {
        Some(answer) => axum::Json(answer).into_response(),
        None => StatusCode::ACCEPTED.into_response(),
    }
}

/// `None` for a notification.
fn mcp_answer(body: &[u8]) -> Option<Value> {
    let failed = |id: Value, code: i32, message: &str| {
        Some(json!({"jsonrpc": "2.0", "id": id, "error": {"code": code, "message": message}}))
    };
    let Ok(request) = serde_json::from_slice::<Value>(body) else {
        return failed(Value::Null, PARSE_ERROR, "the body is not JSON");
    };
    let invalid = || failed(Value::Null, INVALID_REQUEST, "not a request of JSON-RPC 2.0");
    let (Some("2.0"), Some(method)) = (request["jsonrpc"].as_str(), request["method"].as_str()) else {
        return invalid();
    };
    // An id that is null is an id; without one, nobody waits for the answer.
    match request.get("id") {
        None => None,
        Some(id @ (Value::String(_) | Value::Number(_) | Value::Null)) => match method {
            "tools/list" => Some(json!({"jsonrpc": "2.0", "id": id, "result": {"tools": []}})),
            _ => failed(id.clone(), METHOD_NOT_FOUND, "this environment only has tools/list"),
        },
        Some(_) => invalid(),
    }
}
