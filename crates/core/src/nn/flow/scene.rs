//! What the surroundings look like without what moves in them: a learned function of where the camera stands and looks.
//!
//! With a camera model and a measured pose, each 2×2 block of pixels is described by what its ray meets in a learned
//! room ([`super::room_geometry`]). Otherwise by its place in the frame, the state and the motion. For a camera that stands it is one
//! learned image.

use candle_core::{Device, Tensor};
use candle_nn::Module as _;

use super::blocks::centred;
use super::encoder_views::EncoderViews;
use super::rollout_rows::RolloutRows;
use super::room_geometry::{RAY_VALUES, RoomScale, RoomSides, RoomViews};
use crate::frame::warp::CameraModel;
use crate::nn::error::NnError;
use crate::nn::geometry::camera::{CameraPose, Viewer};
use crate::nn::geometry::state_channels::StateChannels;
use crate::nn::ops::compose::{SCENE_CHANNELS, SCENE_FEATURES};
use crate::nn::ops::linear::{Activation, Linear};
use crate::nn::ops::modulation::silu;
use crate::nn::ops::sampling::ImageSize;
use crate::nn::spec::{MIN_CHANNEL_STD, ModelSpec};
use crate::nn::tensor_source::TensorSource;
use crate::nn::tensors::with_values;

/// Octaves of sines and cosines of a block's column and row.
const OCTAVES: usize = 4;
const PLACE_VALUES: usize = 2 * 2 * OCTAVES + 2;
/// Added to the content, so that an untrained scene is middle gray.
const MIDDLE_GRAY: f64 = 0.5;

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
    kind: SceneKind,
    /// Three linear layers with `SiLU` between them.
    layers: Vec<Linear>,
    /// The room's sides `[6]`.
    room: Option<Tensor>,
    /// One value per block and channel `[H/2 · W/2, SCENE_CHANNELS]`.
    image: Option<Tensor>,
}

impl Scene {
    pub(super) fn new(
        spec: &ModelSpec,
        camera: Option<CameraModel>,
        tensors: &dyn TensorSource,
    ) -> Result<Self, NnError> {
        let kind = SceneKind::of(spec, camera);
        let layers = match kind {
            SceneKind::Image => Vec::new(),
            _ => ["inputs", "hidden", "output"]
                .iter()
                .map(|name| tensors.linear(&format!("flow.scene.{name}"), Activation::None))
                .collect::<Result<_, NnError>>()?,
        };
        let is_room = matches!(kind, SceneKind::Room(..));
        Ok(Self {
            kind,
            layers,
            room: is_room.then(|| tensors.tensor("flow.scene.room")).transpose()?,
            image: (!is_room).then(|| tensors.tensor("flow.scene.image")).transpose()?,
        })
    }

    /// The scene at each item, `[M, H/2, W/2, SCENE_CHANNELS]`.
    pub(super) fn forward(
        &self,
        spec: &ModelSpec,
        rows: &RolloutRows,
        motion: &Tensor,
        poses: &[CameraPose],
    ) -> Result<Tensor, NnError> {
        match self.kind {
            SceneKind::Room(scale, camera) => self.room_seen(spec, scale, camera, poses),
            SceneKind::Places => {
                let scaled = rows.scaled_states(spec);
                let items: Vec<&[f32]> = (0..poses.len())
                    .map(|item| scaled[item / spec.horizon].as_slice())
                    .collect();
                self.places_seen(spec, &items, &motion.flatten(0, 1)?)
            }
            SceneKind::Image => self.image_seen(spec, poses.len()),
        }
    }

    /// The content at each context's last frame, `[contexts, H/2, W/2, 4]`, without gradients.
    pub(super) fn content_now(&self, spec: &ModelSpec, contexts: &EncoderViews) -> Result<Vec<f32>, NnError> {
        let count = contexts.count();
        let scene = match self.kind {
            SceneKind::Room(scale, camera) => self.room_seen(spec, scale, camera, &contexts.poses)?,
            SceneKind::Places => {
                let states: Vec<Vec<f32>> = contexts.states.iter().map(|state| spec.scaled_state(state)).collect();
                let states: Vec<&[f32]> = states.iter().map(Vec::as_slice).collect();
                let motion = Tensor::zeros((count, 3), candle_core::DType::F32, &Device::Cpu)?;
                self.places_seen(spec, &states, &motion)?
            }
            SceneKind::Image => self.image_seen(spec, count)?,
        };
        let content = scene.narrow(3, SCENE_FEATURES, SCENE_CHANNELS - SCENE_FEATURES)?;
        Ok(with_values(&content.detach(), <[f32]>::to_vec)?)
    }

    /// Where each pixel of the room was seen from the pose before, `[M, P, 2]`; `None` where no room is learned.
    pub(super) fn room_places(
        &self,
        viewer: Viewer,
        poses: &[CameraPose],
        before: &[CameraPose],
    ) -> Result<Option<Vec<f32>>, NnError> {
        let (SceneKind::Room(scale, _), Some(room)) = (self.kind, &self.room) else {
            return Ok(None);
        };
        let views = RoomViews {
            scale,
            rays: viewer.rays(),
            poses: poses.to_vec(),
        };
        Ok(Some(views.places_before(RoomSides::of(room)?, viewer, before)))
    }

    fn room_seen(
        &self,
        spec: &ModelSpec,
        scale: RoomScale,
        camera: CameraModel,
        poses: &[CameraPose],
    ) -> Result<Tensor, NnError> {
        let half = spec.image_size().shrunk(2);
        let room = self
            .room
            .as_ref()
            .ok_or_else(|| candle_core::Error::Msg("a room has six learned sides".to_owned()))?;
        let views = RoomViews {
            scale,
            rays: Viewer::new(camera, half).rays(),
            poses: poses.to_vec(),
        };
        Self::shaped(&self.run(&views.describe(room)?)?, half)
    }

    fn places_seen(&self, spec: &ModelSpec, states: &[&[f32]], motion: &Tensor) -> Result<Tensor, NnError> {
        let half = spec.image_size().shrunk(2);
        let items = states.len();
        let places = place_values(half);
        let mut known = Vec::new();
        for state in states {
            for place in places.chunks_exact(PLACE_VALUES) {
                known.extend_from_slice(place);
                known.extend_from_slice(state);
            }
        }
        let width = known.len() / (items * half.pixels());
        let known = Tensor::from_vec(known, (items * half.pixels(), width), &Device::Cpu)?;
        let motion = motion
            .unsqueeze(1)?
            .expand((items, half.pixels(), 3))?
            .reshape((items * half.pixels(), 3))?;
        let seen = Self::shaped(&self.run(&Tensor::cat(&[&known, &motion], 1)?)?, half)?;
        let Some(image) = &self.image else { return Ok(seen) };
        Ok(seen.broadcast_add(&image.reshape((1, half.height, half.width, SCENE_CHANNELS))?)?)
    }

    fn image_seen(&self, spec: &ModelSpec, items: usize) -> Result<Tensor, NnError> {
        let half = spec.image_size().shrunk(2);
        let image = self
            .image
            .as_ref()
            .ok_or_else(|| candle_core::Error::Msg("a standing camera's scene is an image".to_owned()))?;
        let image = image.reshape((1, half.height, half.width, SCENE_CHANNELS))?;
        let shape = (items, half.height, half.width, SCENE_CHANNELS);
        Ok((image.broadcast_as(shape)?.contiguous()? + MIDDLE_GRAY)?)
    }

    fn run(&self, described: &Tensor) -> Result<Tensor, NnError> {
        let mut values = described.clone();
        for (index, layer) in self.layers.iter().enumerate() {
            if index > 0 {
                values = silu(&values)?;
            }
            values = layer.forward(&values)?;
        }
        Ok((values + MIDDLE_GRAY)?)
    }

    fn shaped(values: &Tensor, half: ImageSize) -> Result<Tensor, NnError> {
        Ok(values.reshape(((), half.height, half.width, SCENE_CHANNELS))?)
    }
}

/// Sines, cosines and values of each block's column and row, `[H/2 · W/2, PLACE_VALUES]`.
fn place_values(half: ImageSize) -> Vec<f32> {
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
