//! What the surroundings look like without what moves in them: a learned function of where the camera stands and looks.
//!
//! With a camera model and a measured pose, each 2×2 block of pixels is described by what its ray meets in a learned
//! room ([`super::room_geometry`]). Otherwise by its place in the frame, the state and the motion. For a camera that stands it is one
//! learned image.

use candle_core::{DType, Device, Tensor};

use super::blocks::content_blocks;
use super::encoder_views::EncoderViews;
use super::ray_description::RAY_VALUES;
use super::rollout_rows::RolloutRows;
use super::room_geometry::{RoomScale, RoomSides, RoomViews, ViewInRoom};
use crate::frame::warp::CameraModel;
use crate::nn::error::NnError;
use crate::nn::geometry::camera::{CameraPose, Viewer};
use crate::nn::geometry::state_channels::StateChannels;
use crate::nn::model_tensors::ModelTensors;
use crate::nn::ops::compose::SCENE_CHANNELS;
use crate::nn::ops::linear::Linear;
use crate::nn::ops::modulation::{PackedPerceptron, perceptron};
use crate::nn::ops::sampling::{ImageSize, centred};
use crate::nn::precision::Precision;
use crate::nn::spec::{MIN_CHANNEL_STD, ModelSpec};
use crate::nn::tensors::with_values;

/// Octaves of sines and cosines of a block's column and row.
const OCTAVES: usize = 4;
pub(super) const PLACE_VALUES: usize = 2 * 2 * OCTAVES + 2;
/// Added to the content, so that an untrained scene is middle gray.
pub(super) const MIDDLE_GRAY: f64 = 0.5;

/// How the surroundings are described.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum SceneKind {
    /// By the learned room, seen through the camera model.
    Room(RoomScale, CameraModel),
    /// By place, state and motion.
    Places,
    /// The camera stands: by nothing.
    Image,
}

impl SceneKind {
    /// What a model's channels and camera allow.
    pub(super) fn of(spec: &ModelSpec, camera: Option<CameraModel>) -> Self {
        let is_moving = spec.action_inputs().is_some();
        match (StateChannels::of(spec).pose, camera) {
            (Some([x, y, ..]), Some(camera)) if is_moving => {
                let (x, y) = (&spec.states[x], &spec.states[y]);
                let scale = RoomScale {
                    middle: [x.mean, y.mean],
                    unit: f32::midpoint(x.std, y.std).max(MIN_CHANNEL_STD),
                };
                Self::Room(scale, camera)
            }
            _ if is_moving => Self::Places,
            _ => Self::Image,
        }
    }

    /// The name of the tensor that says what is seen, or where the room's sides are.
    pub(super) fn tensor_name(self) -> &'static str {
        match self {
            Self::Room(..) => "flow.scene.room",
            Self::Places | Self::Image => "flow.scene.image",
        }
    }

    /// Inputs of the learned function; none for an image.
    pub(super) fn inputs(self, spec: &ModelSpec) -> Option<usize> {
        match self {
            Self::Room(..) => Some(RAY_VALUES),
            Self::Places => Some(PLACE_VALUES + spec.state_inputs().unwrap_or(0) + 3),
            Self::Image => None,
        }
    }
}

/// The learned function.
#[derive(Clone, Debug)]
pub(super) struct Scene {
    pub(super) kind: SceneKind,
    /// Three linear layers with `SiLU` between them; none for an image.
    pub(super) layers: Vec<Linear>,
    /// The room's sides `[6]`; else one value per block and channel `[H/2 · W/2, SCENE_CHANNELS]`.
    pub(super) learned: Tensor,
}

/// From where a scene is seen.
struct SceneViews<'a> {
    /// The scaled state of each view.
    states: Vec<&'a [f32]>,
    /// Yaw, ahead and left of each since the last frame `[M, 3]`.
    motion: Tensor,
    poses: &'a [CameraPose],
    /// The camera of each, where it is known.
    cameras: Vec<Option<CameraModel>>,
}

impl Scene {
    pub(super) fn new(spec: &ModelSpec, camera: Option<CameraModel>, tensors: &ModelTensors) -> Self {
        let kind = SceneKind::of(spec, camera);
        let names = ["flow.scene.inputs", "flow.scene.hidden", "flow.scene.output"];
        let names = names.iter().filter(|_| kind != SceneKind::Image);
        Self {
            kind,
            layers: names.map(|name| tensors.linear(name)).collect(),
            learned: tensors.tensor(kind.tensor_name()),
        }
    }

    /// Packs the layers' weights for prediction.
    pub(super) fn pack(&mut self, precision: Precision) -> Result<(), NnError> {
        let precision = match self.kind {
            SceneKind::Room(..) => precision.of_convolutions(),
            SceneKind::Places | SceneKind::Image => precision.at_least_bf16(),
        };
        for layer in &mut self.layers {
            layer.pack(precision)?;
        }
        Ok(())
    }

    /// The scene at items with these motions `[M, 3]`, `[M, H/2, W/2, SCENE_CHANNELS]`. `row_of`: the row of each item's rollout.
    pub(super) fn forward(
        &self,
        rows: &RolloutRows,
        row_of: &[usize],
        motion: &Tensor,
        poses: &[CameraPose],
    ) -> Result<Tensor, NnError> {
        let scaled: Vec<Vec<f32>> = (0..rows.count())
            .map(|row| rows.spec.scaled_state(rows.state(row)))
            .collect();
        let views = SceneViews {
            states: row_of.iter().map(|&row| scaled[row].as_slice()).collect(),
            motion: motion.clone(),
            poses,
            cameras: row_of.iter().map(|&row| rows.camera(row)).collect(),
        };
        self.seen(rows.spec, &views)
    }

    /// The content at each context's last frame, `[contexts, H/2, W/2, 4]`, without gradients.
    pub(super) fn content_now(&self, contexts: &EncoderViews) -> Result<Vec<f32>, NnError> {
        let spec = contexts.spec;
        let scaled: Vec<Vec<f32>> = contexts.states.iter().map(|state| spec.scaled_state(state)).collect();
        let views = SceneViews {
            states: scaled.iter().map(Vec::as_slice).collect(),
            motion: Tensor::zeros((contexts.count(), 3), DType::F32, &Device::Cpu)?,
            poses: &contexts.poses,
            cameras: contexts.cameras.clone(),
        };
        let content = content_blocks(&self.seen(spec, &views)?)?;
        Ok(with_values(&content.detach(), <[f32]>::to_vec)?)
    }

    /// Where each pixel of the room was seen from the pose before, `[M, P, 2]`; `None` where no room is learned.
    pub(super) fn room_places(
        &self,
        viewer: Viewer,
        poses: &[CameraPose],
        before: &[CameraPose],
    ) -> Result<Option<Vec<f32>>, NnError> {
        let SceneKind::Room(scale, camera) = self.kind else {
            return Ok(None);
        };
        let views = RoomViews {
            scale,
            views: ViewInRoom::of(poses, &vec![camera; poses.len()], camera, viewer.size()),
        };
        Ok(Some(views.places_before(RoomSides::of(&self.learned)?, viewer, before)))
    }

    fn seen(&self, spec: &ModelSpec, views: &SceneViews) -> Result<Tensor, NnError> {
        let half = spec.image_size().shrunk(2);
        let shape = (views.poses.len(), half.height, half.width, SCENE_CHANNELS);
        let image = || self.learned.reshape((1, half.height, half.width, SCENE_CHANNELS));
        Ok(match self.kind {
            SceneKind::Room(scale, camera) => {
                let cameras: Vec<CameraModel> = views.cameras.iter().map(|own| own.unwrap_or(camera)).collect();
                let views = RoomViews {
                    scale,
                    views: ViewInRoom::of(views.poses, &cameras, camera, half),
                };
                if let Some(layers) = PackedPerceptron::of(&self.layers) {
                    let mut seen = views.described_to(&layers, RoomSides::of(&self.learned)?);
                    for value in &mut seen {
                        *value += MIDDLE_GRAY as f32;
                    }
                    return Ok(Tensor::from_vec(seen, shape, &Device::Cpu)?);
                }
                let seen = perceptron(&self.layers, &views.describe(&self.learned)?)?;
                (seen + MIDDLE_GRAY)?.reshape(shape)?
            }
            SceneKind::Places => {
                let seen = perceptron(&self.layers, &Self::known_of_places(half, views)?)?;
                (seen + MIDDLE_GRAY)?.reshape(shape)?.broadcast_add(&image()?)?
            }
            SceneKind::Image => (image()?.broadcast_as(shape)?.contiguous()? + MIDDLE_GRAY)?,
        })
    }

    /// Place, state and motion of each block of each view.
    fn known_of_places(half: ImageSize, views: &SceneViews) -> Result<Tensor, NnError> {
        let (items, blocks) = (views.states.len(), half.pixels());
        let places = place_values(half);
        let mut known = Vec::new();
        for state in &views.states {
            for place in places.chunks_exact(PLACE_VALUES) {
                known.extend_from_slice(place);
                known.extend_from_slice(state);
            }
        }
        let known = Tensor::from_vec(known, (items * blocks, ()), &Device::Cpu)?;
        let motion = views.motion.unsqueeze(1)?.expand((items, blocks, 3))?;
        Ok(Tensor::cat(&[&known, &motion.reshape((items * blocks, 3))?], 1)?)
    }
}

/// Sines, cosines and values of each block's column and row, `[H/2 · W/2, PLACE_VALUES]`.
pub(super) fn place_values(half: ImageSize) -> Vec<f32> {
    let mut values = Vec::with_capacity(half.pixels() * PLACE_VALUES);
    for row in 0..half.height {
        for column in 0..half.width {
            for at in [centred(column, half.width), centred(row, half.height)] {
                values.push(at);
                for octave in 0..OCTAVES {
                    let (sin, cos) = (std::f32::consts::FRAC_PI_2 * (1 << octave) as f32 * at).sin_cos();
                    values.extend([sin, cos]);
                }
            }
        }
    }
    values
}
