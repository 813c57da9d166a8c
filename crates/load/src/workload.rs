//! Frames and requests made from the frames in `examples`, in the form that a model takes.

use std::fs;

use foreframe::server::protocol::{ClientMessage, FrameMessage};
use foreframe::server::{ImageBytes, ImageFormat};
use foreframe_core::frame::codec;
use foreframe_core::nn::ModelSpec;
use foreframe_core::registry::manifest;
use serde_json::{Value, json};
use tokio_tungstenite::tungstenite::Message;

use crate::http::Request;
use crate::project;

const FRAMES: usize = 15;
/// Each component of the actions and states.
pub(crate) const EXAMPLE_VALUE: f32 = 0.1;
const BOUNDARY: &str = "frame-by-frame";

/// The frames of `examples` and the model that they are sent to.
pub(crate) struct Workload {
    model: String,
    spec: ModelSpec,
    /// The frames as PNG files.
    files: Vec<Vec<u8>>,
    /// The frames as raw pixels.
    images: Vec<Vec<u8>>,
}

impl Workload {
    pub(crate) fn of(model: &str) -> Self {
        let project = project::root();
        let manifest = manifest::read(&project.join("models").join(model)).expect("the model is shipped");
        let file = |index| fs::read(project.join(format!("examples/frames/frame-{index:03}.png"))).unwrap();
        let files: Vec<Vec<u8>> = (0..FRAMES).map(file).collect();
        let pixels = |file: &Vec<u8>| codec::decode(file).unwrap().pixels().to_vec();
        Self {
            model: model.to_owned(),
            spec: manifest.spec,
            images: files.iter().map(pixels).collect(),
            files,
        }
    }

    pub(crate) fn model(&self) -> &str {
        &self.model
    }

    pub(crate) fn spec(&self) -> &ModelSpec {
        &self.spec
    }

    /// The pixels of a frame of `examples`; the frames repeat.
    pub(crate) fn pixels(&self, index: usize) -> &[u8] {
        &self.images[index % FRAMES]
    }

    /// Frames that a session takes before its first prediction.
    pub(crate) fn context(&self) -> u64 {
        self.spec.context as u64
    }

    /// The stream message with frame `seq`.
    pub(crate) fn frame(&self, seq: u64) -> Message {
        message(&ClientMessage::Frame(FrameMessage {
            steps: None,
            seq,
            timestamp_us: 0,
            image: ImageBytes(self.images[seq as usize % FRAMES].clone()),
            format: ImageFormat::Raw,
            action: self.spec.action_inputs().map(|count| vec![EXAMPLE_VALUE; count]),
            state: self.spec.state_inputs().map(|count| vec![EXAMPLE_VALUE; count]),
            plan: None,
        }))
    }

    /// A prediction request in JSON with base64 images.
    pub(crate) fn predict_json(&self) -> Request {
        Request::json(&self.predict_path(), &self.context_body())
    }

    /// The body of that request.
    pub(crate) fn context_body(&self) -> Value {
        let mut body = self.conditioning();
        let images = self.files.iter().take(self.spec.context);
        body["frames"] = images.map(|file| json!(ImageBytes(file.clone()))).collect();
        body
    }

    /// The same request as a multipart form.
    pub(crate) fn predict_form(&self) -> Request {
        let mut body = Vec::new();
        let head = |name: &str| format!("--{BOUNDARY}\r\ncontent-disposition: form-data; name=\"{name}\"\r\n\r\n");
        for file in self.files.iter().take(self.spec.context) {
            body.extend([head("frames").as_bytes(), file, b"\r\n"].concat());
        }
        let end = format!("{}{}\r\n--{BOUNDARY}--\r\n", head("request"), self.conditioning());
        body.extend(end.as_bytes());
        let content_type = format!("multipart/form-data; boundary={BOUNDARY}");
        Request::post(&self.predict_path(), &content_type, &body)
    }

    fn predict_path(&self) -> String {
        format!("/v1/models/{}/predict", self.model)
    }

    fn conditioning(&self) -> Value {
        let mut conditioning = json!({});
        if let Some(count) = self.spec.action_inputs() {
            conditioning["plan"] = json!(vec![vec![EXAMPLE_VALUE; count]; self.spec.horizon]);
        }
        if let Some(count) = self.spec.state_inputs() {
            conditioning["state"] = json!(vec![EXAMPLE_VALUE; count]);
        }
        conditioning
    }
}

/// A message of the binary sub-protocol.
pub(crate) fn message(message: &ClientMessage) -> Message {
    Message::binary(rmp_serde::to_vec_named(message).unwrap())
}
