//! What `OpenEnv`'s tools read about an environment.

use axum::body::Bytes;
use serde::Deserialize;
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

/// A request of the Model Context Protocol.
#[derive(Deserialize)]
struct McpRequest {
    id: Option<Value>,
    method: String,
}

/// Answers the Model Context Protocol: the environment has no tools.
pub(super) async fn mcp(_: NamedScenario, body: Bytes) -> axum::Json<Value> {
    let failed = |id: Value, code: i32, message: &str| json!({"jsonrpc": "2.0", "id": id, "error": {"code": code, "message": message}});
    axum::Json(match serde_json::from_slice::<McpRequest>(&body) {
        Ok(McpRequest { id, method }) if method == "tools/list" => {
            json!({"jsonrpc": "2.0", "id": id, "result": {"tools": []}})
        }
        Ok(McpRequest { id, .. }) => failed(id.unwrap_or_default(), -32601, "this environment only has tools/list"),
        Err(_) => failed(Value::Null, -32600, "not a request of JSON-RPC"),
    })
}
