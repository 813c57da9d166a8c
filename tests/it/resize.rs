//! Frames of another size: resized where the client asks for it, else refused.

use foreframe::server::protocol::{ClientMessage, Codec, ConfigureMessage, ErrorCode, ServerMessage};
use foreframe::server::{ImageBytes, ImageFormat, ServerConfig};
use foreframe_core::frame::resize::{Resize, resize};
use foreframe_core::frame::{Frame, codec};
use serde_json::{Value, json};

use crate::client::{Client, SessionHandle, numbered_frame};
use crate::service::{CONTEXT, HEIGHT, WIDTH, app, get, png, post, run};
use crate::sessions::{code, frames};

const PREDICT: &str = "/v1/models/plain/predict";

/// A frame that no model here takes.
fn large(value: u8) -> Frame {
    let pixels = (0..60 * 60).map(|i| value.wrapping_add((i / 40) as u8)).collect();
    Frame::new(60, 60, pixels).unwrap()
}

fn large_frames() -> Vec<Frame> {
    (0..CONTEXT as u8).map(|i| large(i * 10)).collect()
}

fn files(frames: &[Frame]) -> Vec<String> {
    frames.iter().map(png).collect()
}

#[tokio::test]
async fn a_prediction_resizes_its_frames_as_asked() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    for (name, way) in [
        ("crop", Resize::Crop),
        ("letterbox", Resize::Letterbox),
        ("stretch", Resize::Stretch),
    ] {
        let resized: Vec<Frame> = large_frames()
            .iter()
            .map(|frame| resize(frame, WIDTH, HEIGHT, way).unwrap())
            .collect();
        let expected = post(&app, PREDICT, &json!({"frames": files(&resized)})).await.json();
        let body = json!({"frames": files(&large_frames()), "resize": name});
        let answer = post(&app, PREDICT, &body).await.json();
        assert!(
            answer["frames"].is_array() && answer["frames"] == expected["frames"],
            "{answer}"
        );
    }
}

#[tokio::test]
async fn rollouts_resize_their_frames_as_asked() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let body = |frames: &[Frame], resize: Option<&str>| {
        let mut body = json!({"frames": files(frames), "state": [0.0], "plans": [[[0.1, 0.0], [0.1, 0.0]]]});
        if let Some(resize) = resize {
            body["resize"] = json!(resize);
        }
        body
    };
    let resized: Vec<Frame> = large_frames()
        .iter()
        .map(|frame| resize(frame, WIDTH, HEIGHT, Resize::Crop).unwrap())
        .collect();
    let path = "/v1/models/moving/rollouts";
    let expected = post(&app, path, &body(&resized, None)).await.json();
    let answer = post(&app, path, &body(&large_frames(), Some("crop"))).await.json();
    assert!(
        answer["rollouts"].is_array() && answer["rollouts"] == expected["rollouts"],
        "{answer}"
    );
}

#[tokio::test]
async fn a_session_resizes_its_frames_as_asked() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let server = run(app.clone()).await;
    let frame_message = |seq: u64, file: Vec<u8>| {
        let mut message = numbered_frame(seq);
        message.image = ImageBytes(file);
        message.format = ImageFormat::Png;
        ClientMessage::Frame(message)
    };
    let with_resize = SessionHandle::open(&app, &json!({"model": "moving", "resize": "letterbox"})).await;
    let without = SessionHandle::open(&app, &json!({"model": "moving"})).await;
    let mut resizing = Client::connect(server.address, &with_resize.path("/stream"), Codec::Msgpack)
        .await
        .unwrap();
    let mut exact = Client::connect(server.address, &without.path("/stream"), Codec::Json)
        .await
        .unwrap();
    for (seq, frame) in large_frames().iter().enumerate() {
        let seq = seq as u64;
        let resized = resize(frame, WIDTH, HEIGHT, Resize::Letterbox).unwrap();
        let file = codec::encode_png(frame).unwrap();
        let answer = resizing.ask(&frame_message(seq, file)).await;
        let expected = exact
            .ask(&frame_message(seq, codec::encode_png(&resized).unwrap()))
            .await;
        if seq as usize + 1 == CONTEXT {
            assert_eq!(frames(&answer), frames(&expected));
        }
    }
    let state: Value = get(&app, &with_resize.path("/state")).await.json();
    assert_eq!(state["resize"], "letterbox");

    // A configure message changes it for the frames that follow.
    let seq = CONTEXT as u64;
    let file = codec::encode_png(&large(9)).unwrap();
    let refused = exact.ask(&frame_message(seq, file.clone())).await;
    assert_eq!(code(&refused), (ErrorCode::Invalid, seq));
    let configure = ClientMessage::Configure(ConfigureMessage {
        resize: Some(Resize::Stretch),
        ..ConfigureMessage::default()
    });
    exact.send(&configure).await;
    exact.send(&frame_message(seq, file)).await;
    let ServerMessage::Configured(settings) = exact.receive().await else {
        panic!("no configured")
    };
    assert_eq!(settings.resize, Some(Resize::Stretch));
    assert_eq!(frames(&exact.receive().await).len(), 2);
    server.stop().await;
}

#[tokio::test]
async fn an_image_too_large_to_resize_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let huge = png(&Frame::new(4096, 2000, vec![0; 4096 * 2000]).unwrap());
    let body = json!({"frames": vec![huge; CONTEXT], "resize": "crop"});
    let detail = post(&app, PREDICT, &body).await.detail(422);
    assert_eq!(
        detail,
        "frames[0] is 4096×2000 px; an image to resize has at most 4194304 pixels"
    );
    let unknown = post(&app, PREDICT, &json!({"frames": [], "resize": "zoom"}))
        .await
        .detail(422);
    assert!(unknown.contains("`crop`, `letterbox`, `stretch`"), "{unknown}");
}
