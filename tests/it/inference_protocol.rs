//! The Open Inference Protocol on the wire; `tests/python/inference_protocol.py` uses the client that its users have.

use axum::body::Body;
use axum::http::Request;
use foreframe::server::{App, ServerConfig};
use serde_json::{Value, json};

use crate::service::{Answer, CONTEXT, HEIGHT, WIDTH, app, context, frame, get, post, send};

const INFER: &str = "/v2/models/moving/infer";
const LENGTH: &str = "inference-header-content-length";

fn pixels() -> Vec<u8> {
    (0..CONTEXT as u8)
        .flat_map(|index| frame(index * 10).pixels().to_vec())
        .collect()
}

fn head(frames: Value) -> Value {
    let mut input = json!({"name": "frames", "shape": [CONTEXT, HEIGHT, WIDTH], "datatype": "UINT8"});
    input
        .as_object_mut()
        .unwrap()
        .extend(frames.as_object().unwrap().clone());
    json!({
        "id": "7",
        "inputs": [
            input,
            {"name": "state", "shape": [1], "datatype": "FP32", "data": [0.5]},
            {"name": "plan", "shape": [2, 2], "datatype": "FP32", "data": [[0.5, -0.5], [0.5, -0.5]]},
        ],
    })
}

async fn send_with(app: &App, length: Option<&str>, body: Vec<u8>) -> Answer {
    let mut request = Request::post(INFER);
    if let Some(length) = length {
        request = request.header(LENGTH, length);
    }
    send(app, request.body(Body::from(body)).unwrap()).await
}

/// The words of an error.
fn error(answer: &Answer, status: u16) -> String {
    assert_eq!(answer.status, status, "{}", String::from_utf8_lossy(&answer.body));
    assert_eq!(answer.headers["content-type"], "application/json");
    let body = answer.json();
    assert_eq!(body.as_object().unwrap().len(), 1);
    body["error"].as_str().unwrap().to_owned()
}

#[tokio::test]
async fn tensors_are_json_or_bytes_and_give_the_prediction_of_a_request() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let request = json!({"frames": context(), "state": [0.5], "plan": [[0.5, -0.5], [0.5, -0.5]], "format": "png"});
    let expected = post(&app, "/v1/models/moving/predict", &request).await;
    assert_eq!(expected.status, 200);

    let text = head(json!({"data": pixels()})).to_string();
    let by_text = send_with(&app, None, text.into_bytes()).await.json();
    let predicted = &by_text["outputs"][0];
    assert_eq!(
        (
            &by_text["id"],
            &by_text["model_version"],
            &predicted["name"],
            &predicted["shape"]
        ),
        (
            &json!("7"),
            &json!("1"),
            &json!("predicted"),
            &json!([2, HEIGHT, WIDTH])
        )
    );

    let mut binary = head(json!({"parameters": {"binary_data_size": pixels().len()}}));
    binary["parameters"] = json!({"binary_data_output": true});
    let header = binary.to_string().into_bytes();
    let length = header.len().to_string();
    let answer = send_with(&app, Some(&length), [header, pixels()].concat()).await;
    assert_eq!(answer.status, 200);
    let length: usize = answer.headers[LENGTH].to_str().unwrap().parse().unwrap();
    let found: Vec<Value> = answer.body[length..].iter().map(|pixel| json!(pixel)).collect();
    assert_eq!(predicted["data"].as_array().unwrap(), &found);
}

#[tokio::test]
async fn requests_that_cannot_be_used_are_refused_with_their_tensor() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    for (length, body) in [(None, "{"), (Some("9"), "{}"), (Some("-1"), "{}"), (Some("x"), "{}")] {
        error(&send_with(&app, length, body.into()).await, 400);
    }
    let extra = head(json!({"data": pixels()})).to_string();
    let answer = send_with(&app, Some(&extra.len().to_string()), format!("{extra}ab").into()).await;
    assert_eq!(error(&answer, 400), "2 bytes follow the last input");
    for (frames, words) in [
        (json!({"data": [1, 2]}), "input \"frames\" holds 2 values"),
        (json!({"data": ["a"]}), "numbers in lists"),
        (json!({"data": [[[300]]], "shape": [1, 1, 1]}), "holds 300; uint8"),
        (json!({"parameters": {"binary_data_size": 9}}), "has 9 bytes; 0 follow"),
        (json!({"parameters": {"shared_memory_region": "a"}}), "shared memory"),
        (json!({"datatype": "BYTES", "data": []}), "is BYTES"),
        (json!({"shape": [1u64 << 40, 1u64 << 40], "data": []}), "too large"),
        (
            json!({"shape": [9], "data": [0, 0, 0, 0, 0, 0, 0, 0, 0]}),
            "has the shape [9]",
        ),
        (json!({"shape": [0, HEIGHT, WIDTH], "data": []}), "takes"),
    ] {
        let answer = send_with(&app, None, head(frames).to_string().into_bytes()).await;
        let found = error(&answer, 422);
        assert!(found.contains(words), "{found}");
    }
    // As many values as the shape has, in lists of another shape.
    let columns: Vec<Vec<Vec<u8>>> = vec![vec![vec![0; CONTEXT]; WIDTH as usize]; HEIGHT as usize];
    let answer = send_with(&app, None, head(json!({"data": columns})).to_string().into_bytes()).await;
    let (found, expected) = ([HEIGHT, WIDTH, CONTEXT as u32], [CONTEXT as u32, HEIGHT, WIDTH]);
    assert_eq!(
        error(&answer, 422),
        format!("input \"frames\" has lists of the shape {found:?}; its shape is {expected:?}")
    );
    let mut both = head(json!({"data": pixels()}));
    let plans = json!({"name": "plans", "shape": [1, 2, 2], "datatype": "FP32", "data": [0, 0, 0, 0]});
    both["inputs"].as_array_mut().unwrap().push(plans);
    let found = error(&send_with(&app, None, both.to_string().into_bytes()).await, 422);
    assert_eq!(found, "plan and plans are both given; give one");
    assert!(error(&get(&app, "/v2/models/nothing").await, 404).contains("no model"));
    assert!(error(&get(&app, "/v2/nothing").await, 404).contains("nothing at this path"));
}
