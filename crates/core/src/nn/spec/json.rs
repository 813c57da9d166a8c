//! The JSON form of a specification: one object, in which the fields of a network stand beside those of all models. When it
//! is read, the fields of the other networks are ignored; they are not written.

use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize, Serializer};

use super::channels::ChannelScale;
use super::dense::DenseSpec;
use super::flow::{FlowLayers, FlowSpec};
use super::model::{Architecture, ModelSpec};
use super::sprites::SpriteSpec;
use crate::frame::preprocess::Preprocess;
use crate::frame::warp::CameraModel;
use crate::nn::options::{ArchitectureKind, Conditioning, PredictorOutput, Reconstruction};

/// All dimensions of a model, and the meaning of its inputs.
#[derive(Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[cfg_attr(feature = "schema", schema(as = ModelSpec))]
#[serde(deny_unknown_fields)]
struct ModelSpecJson {
    /// The kind of network.
    #[serde(
        default = "ArchitectureKind::dense",
        skip_serializing_if = "ArchitectureKind::is_dense"
    )]
    architecture: ArchitectureKind,
    /// Width of a frame in pixels.
    frame_width_px: u32,
    /// Height of a frame in pixels.
    frame_height_px: u32,
    /// Seconds from one frame to the next.
    frame_period_s: f64,
    /// How frames are converted to the model's value range.
    preprocess: Preprocess,
    /// Number of context frames.
    context: usize,
    /// Number of predicted frames.
    horizon: usize,
    /// Features of a frame, F; absent for the other networks.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schema(nullable = false))]
    features: Option<usize>,
    /// Hidden units of each LSTM, H; absent for the other networks.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schema(nullable = false))]
    hidden: Option<usize>,
    /// How the context frames are reconstructed; absent for the other networks.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[cfg_attr(feature = "schema", schema(nullable = false))]
    reconstruction: Option<Reconstruction>,
    /// What the predictor gives at each step; absent for the other networks.
    #[serde(
        default = "PredictorOutput::residual",
        skip_serializing_if = "PredictorOutput::is_residual"
    )]
    predictor_output: PredictorOutput,
    /// The inputs of a prediction besides the context frames.
    conditioning: Conditioning,
    /// Components of an action in the training data; used only if `conditioning` includes actions.
    actions: Vec<ChannelScale>,
    /// Components of a state in the training data; used only if `conditioning` includes the state.
    states: Vec<ChannelScale>,
    /// Layer sizes of the flow network; absent for the other networks.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    flow: Option<FlowLayers>,
    /// Layer sizes of the sprite network; absent for the other networks.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    sprites: Option<SpriteSpec>,
    /// The camera model, if it is known. Only the flow network uses it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    camera: Option<CameraModel>,
}

impl ModelSpecJson {
    fn of(spec: &ModelSpec) -> Self {
        let (dense, flow) = (spec.dense(), spec.flow());
        Self {
            architecture: spec.architecture.kind(),
            frame_width_px: spec.frame_width_px,
            frame_height_px: spec.frame_height_px,
            frame_period_s: spec.frame_period_s,
            preprocess: spec.preprocess,
            context: spec.context,
            horizon: spec.horizon,
            features: dense.map(|dense| dense.features),
            hidden: dense.map(|dense| dense.hidden),
            reconstruction: dense.map(|dense| dense.reconstruction),
            predictor_output: dense.map_or_else(PredictorOutput::residual, |dense| dense.predictor_output),
            conditioning: spec.conditioning,
            actions: spec.actions.clone(),
            states: spec.states.clone(),
            flow: flow.map(|flow| flow.layers),
            sprites: spec.sprites().copied(),
            camera: flow.and_then(|flow| flow.camera),
        }
    }

    /// The sizes of the network that is named. Errors: the name of a missing field.
    fn architecture(&self) -> Result<Architecture, &'static str> {
        Ok(match self.architecture {
            ArchitectureKind::Dense => Architecture::Dense(DenseSpec {
                features: self.features.ok_or("features")?,
                hidden: self.hidden.ok_or("hidden")?,
                reconstruction: self.reconstruction.ok_or("reconstruction")?,
                predictor_output: self.predictor_output,
            }),
            ArchitectureKind::Flow => Architecture::Flow(FlowSpec {
                layers: self.flow.unwrap_or_default(),
                camera: self.camera,
            }),
            ArchitectureKind::Sprites => Architecture::Sprites(self.sprites.unwrap_or_default()),
        })
    }
}

impl Serialize for ModelSpec {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        ModelSpecJson::of(self).serialize(serializer)
    }
}

impl<'de> Deserialize<'de> for ModelSpec {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let json = ModelSpecJson::deserialize(deserializer)?;
        Ok(Self {
            architecture: json.architecture().map_err(D::Error::missing_field)?,
            frame_width_px: json.frame_width_px,
            frame_height_px: json.frame_height_px,
            frame_period_s: json.frame_period_s,
            preprocess: json.preprocess,
            context: json.context,
            horizon: json.horizon,
            conditioning: json.conditioning,
            actions: json.actions,
            states: json.states,
        })
    }
}

#[cfg(feature = "schema")]
impl utoipa::PartialSchema for ModelSpec {
    fn schema() -> utoipa::openapi::RefOr<utoipa::openapi::schema::Schema> {
        ModelSpecJson::schema()
    }
}

#[cfg(feature = "schema")]
impl utoipa::ToSchema for ModelSpec {
    fn name() -> std::borrow::Cow<'static, str> {
        ModelSpecJson::name()
    }

    fn schemas(schemas: &mut Vec<(String, utoipa::openapi::RefOr<utoipa::openapi::schema::Schema>)>) {
        ModelSpecJson::schemas(schemas);
    }
}
