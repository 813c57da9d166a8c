//! What the server sends to openpi's client: maps whose tensors are arrays of `NumPy`.

use serde::Serialize;

use super::numpy::SentArray;
use crate::server::stream::protocol::{ServerMessage, Timing};
use foreframe_core::nn::ModelSpec;
use foreframe_core::registry::Manifest;

/// The first message: what the client may send.
#[derive(Serialize)]
pub(super) struct OpenpiMetadata<'a> {
    server: &'static str,
    /// The model of this connection until an observation names another.
    model: &'a str,
    version: u32,
    /// Its inputs and outputs.
    spec: &'a ModelSpec,
    /// The names that an observation may give.
    models: Vec<&'a str>,
}

impl<'a> OpenpiMetadata<'a> {
    pub(super) fn new(manifest: &'a Manifest, models: Vec<&'a str>) -> Self {
        Self {
            server: env!("CARGO_PKG_NAME"),
            model: manifest.name.as_str(),
            version: manifest.version,
            spec: &manifest.spec,
            models,
        }
    }
}

/// The answer to `reset`.
#[derive(Serialize)]
pub(super) struct ResetStatus {
    status: &'static str,
}

impl ResetStatus {
    pub(super) const DONE: Self = Self {
        status: "reset successful",
    };
}

/// The answer to an observation.
#[derive(Serialize)]
pub(super) struct OpenpiAnswer<'a> {
    model: &'a str,
    version: u32,
    /// How many more observations the context needs before there is a prediction.
    missing: usize,
    #[serde(flatten)]
    prediction: Option<PredictedArrays>,
}

#[derive(Serialize)]
struct PredictedArrays {
    /// `[steps, height, width]`, uint8.
    frames: SentArray,
    /// `[horizon]`; absent if the model is not calibrated, like the next two.
    #[serde(skip_serializing_if = "Option::is_none")]
    expected_mse: Option<SentArray>,
    /// `[horizon, 2]`.
    #[serde(skip_serializing_if = "Option::is_none")]
    mse_band_90: Option<SentArray>,
    #[serde(skip_serializing_if = "Option::is_none")]
    novelty: Option<f32>,
    /// Absent if no frame is beyond what the model was trained for.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    beyond_training: Vec<bool>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    warnings: Vec<String>,
    timing: Timing,
}

impl<'a> OpenpiAnswer<'a> {
    pub(super) fn new(message: ServerMessage, manifest: &'a Manifest) -> Self {
        let (missing, prediction) = match message {
            ServerMessage::Buffering { have, need, .. } => (need - have, None),
            other => (0, PredictedArrays::of(other, &manifest.spec)),
        };
        Self {
            model: manifest.name.as_str(),
            version: manifest.version,
            missing,
            prediction,
        }
    }
}

impl PredictedArrays {
    /// `None` if the message is no prediction.
    fn of(message: ServerMessage, spec: &ModelSpec) -> Option<Self> {
        let ServerMessage::Prediction {
            frames,
            expected_mse,
            mse_band_90,
            novelty,
            beyond_training,
            warnings,
            timing,
            ..
        } = message
        else {
            return None;
        };
        let shape = vec![
            frames.len(),
            spec.frame_height_px as usize,
            spec.frame_width_px as usize,
        ];
        let (errors, bands) = (expected_mse.len(), mse_band_90.len());
        Some(Self {
            frames: SentArray::of_bytes(shape, frames.into_iter().flat_map(|frame| frame.0).collect()),
            expected_mse: (errors > 0).then(|| SentArray::of_numbers(vec![errors], expected_mse)),
            mse_band_90: (bands > 0).then(|| SentArray::of_numbers(vec![bands, 2], mse_band_90.into_iter().flatten())),
            novelty,
            beyond_training,
            warnings,
            timing,
        })
    }
}
