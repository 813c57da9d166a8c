//! The flow network: it moves the pixels of the last frame instead of computing new ones.
//!
//! An encoder reads the last frames once, in the last one's view. Then, for each predicted step: `motion` says how
//! the camera will have moved, the encoder's features are sampled as that camera sees them, a block of convolutions that
//! is modulated by actions, state and step refines them, and `compose` mixes moved pixels with new content. The content
//! comes from the `scene`, a learned function of the camera's pose that remembers what the surroundings look like. In the
//! `recurrent` form, each step continues from the one before it.
//!
//! Sizes beside those of [`crate::nn`]: M items (N futures of K steps each, step after step), C channels on the grid of a
//! quarter of the frame's sides.

use candle_core::{Device, Tensor};

use super::compose::{Composition, SCENE_CHANNELS, SCENE_FEATURES};
use super::conditioned::ConditioningTensors;
use super::conv::{ConvShape, convolve};
use super::dense::{Activation, Dense};
use super::flow_inputs::{EncoderViews, FutureRows, fold_pixels, repeated, sampled_blocks};
use super::modulation::{modulated_silu, silu};
use super::motion::MotionHead;
use super::pixel_shuffle::{pixel_shuffle, pixel_unshuffle};
use super::rays::{CameraPose, Viewer, own_places, turning_places};
use super::sampling::{ImageSize, sample_features};
use super::scene::Scene;
use super::tensors::with_values;
use super::{FlowLayers, ModelSpec, NnError};

mod recurrent;

/// Futures that are computed together without gradients, so that many take no more memory than few.
const FUTURES_AT_ONCE: usize = 16;

/// What the network gives for a batch.
#[derive(Clone, Debug)]
pub struct FlowPrediction {
    /// The predicted frames `[N, steps, P]`, those of the whole horizon unless fewer were asked for.
    pub frames: Tensor,
    /// What the scene alone looks like `[N, horizon, P]`, without what moves in it.
    pub scene: Tensor,
    /// How the camera will have moved since the last frame: yaw, ahead, left `[N, horizon, 3]`, in radians and metres.
    pub motion: Tensor,
}

/// A 3×3 convolution.
#[derive(Clone, Debug)]
pub(super) struct Convolution3 {
    weight: Tensor,
    bias: Tensor,
    shape: ConvShape,
}

impl Convolution3 {
    fn forward(&self, x: &Tensor) -> Result<Tensor, NnError> {
        Ok(convolve(x, &self.weight, &self.bias, self.shape)?)
    }
}

/// Finds a model's layers among its parameters.
pub(super) trait Layers {
    /// The tensor of that name. Errors: `TensorMissing`, `TensorShape`.
    fn tensor(&self, name: &str) -> Result<Tensor, NnError>;

    /// The dense layer of that name, without activation.
    fn dense(&self, name: &str) -> Result<Dense, NnError> {
        let (weight, bias) = (format!("{name}.weight"), format!("{name}.bias"));
        Ok(Dense::new(
            self.tensor(&weight)?,
            self.tensor(&bias)?,
            Activation::Linear,
        ))
    }

    /// The convolution of that name.
    fn convolution(&self, name: &str, shape: ConvShape) -> Result<Convolution3, NnError> {
        Ok(Convolution3 {
            weight: self.tensor(&format!("{name}.weight"))?,
            bias: self.tensor(&format!("{name}.bias"))?,
            shape,
        })
    }
}

/// The network. Holds weights only.
#[derive(Clone, Debug)]
pub(super) struct FlowModel {
    layers: FlowLayers,
    stem: Convolution3,
    halving: Convolution3,
    blocks: Vec<[Convolution3; 2]>,
    scene: Scene,
    motion: MotionHead,
    modulation: [Dense; 2],
    mix: Dense,
    refine: Vec<[Convolution3; 2]>,
    enlarge: Dense,
    fine: Convolution3,
    head: Convolution3,
}

impl FlowModel {
    pub(super) fn new(spec: &ModelSpec, find: &dyn Layers) -> Result<Self, NnError> {
        let layers = spec.flow_layers();
        let blocks = (0..layers.encoder_blocks).map(|index| {
            let convolution = |part, shape| find.convolution(&format!("flow.encoder.{index}.{part}"), shape);
            Ok([
                convolution("first", ConvShape::dilated(1 << (index % 3)))?,
                convolution("second", ConvShape::PLAIN)?,
            ])
        });
        let refine = (0..layers.decoder_blocks).map(|index| {
            let convolution = |part, shape| find.convolution(&format!("flow.decoder.{index}.{part}"), shape);
            Ok([
                convolution("first", ConvShape::PLAIN)?,
                convolution("second", ConvShape::PLAIN)?,
            ])
        });
        Ok(Self {
            layers,
            stem: find.convolution("flow.stem", ConvShape::PLAIN)?,
            halving: find.convolution("flow.halving", ConvShape::HALVING)?,
            blocks: blocks.collect::<Result<_, NnError>>()?,
            scene: Scene::new(spec, find)?,
            motion: MotionHead::new(spec, find)?,
            modulation: [
                find.dense("flow.modulation.inputs")?,
                find.dense("flow.modulation.output")?,
            ],
            mix: find.dense(&format!("flow.{}", layers.mix_name()))?,
            refine: refine.collect::<Result<_, NnError>>()?,
            enlarge: find.dense("flow.enlarge")?,
            fine: find.convolution("flow.fine", ConvShape::PLAIN)?,
            head: find.convolution("flow.head", ConvShape::PLAIN)?,
        })
    }

    /// N futures of B windows of frames `[B, context, P]`: future n follows window `windows[n]` under row n of the
    /// conditioning. Errors: `Shape`, `Missing`.
    pub(super) fn predict(
        &self,
        spec: &ModelSpec,
        frames: &Tensor,
        windows: &[u32],
        conditioning: &ConditioningTensors,
    ) -> Result<FlowPrediction, NnError> {
        self.predict_first(spec, (frames, windows), conditioning, spec.horizon)
    }

    /// As [`FlowModel::predict`], with the frames of the first `steps` only.
    pub(super) fn predict_first(
        &self,
        spec: &ModelSpec,
        (frames, windows): (&Tensor, &[u32]),
        conditioning: &ConditioningTensors,
        steps: usize,
    ) -> Result<FlowPrediction, NnError> {
        let rows = FutureRows::new(spec, frames, windows, conditioning)?;
        if rows.count() <= FUTURES_AT_ONCE || self.stem.weight.track_op() {
            return self.predict_rows(spec, &rows, steps);
        }
        let (mut frames, mut scene, mut motion) = (Vec::new(), Vec::new(), Vec::new());
        for first in (0..rows.count()).step_by(FUTURES_AT_ONCE) {
            let part = rows.part(first..rows.count().min(first + FUTURES_AT_ONCE));
            let part = self.predict_rows(spec, &part, steps)?;
            frames.push(part.frames);
            scene.push(part.scene);
            motion.push(part.motion);
        }
        Ok(FlowPrediction {
            frames: Tensor::cat(&frames, 0)?,
            scene: Tensor::cat(&scene, 0)?,
            motion: Tensor::cat(&motion, 0)?,
        })
    }

    fn predict_rows(&self, spec: &ModelSpec, rows: &FutureRows, steps: usize) -> Result<FlowPrediction, NnError> {
        if self.layers.recurrent {
            return self.predict_recurrently(spec, rows, steps);
        }
        let (count, horizon, size) = (rows.count(), spec.horizon, spec.image_size());
        let (half, quarter) = (size.shrunk(2), size.shrunk(4));
        let motion = self.motion.forward(spec, rows)?;
        let contexts = rows.contexts(spec);
        let coarse = self.encode(spec, &contexts)?;

        let motions = with_values(&motion, motion_rows)?;
        let poses = rows.future_poses(spec, &motions);
        let scene = self.scene.forward(spec, rows, &motion, &poses)?;

        let geometry = self.places(spec, rows, &motion.flatten(0, 1)?, &poses)?;
        let context_of = repeated(&contexts.row_of, horizon);
        let warped = sample_features(&coarse, geometry.coarse, &context_of)?;
        let moved = sampled_blocks(&contexts.last_frames, &context_of, &geometry.room_or_turned, size);
        let moved = Tensor::from_vec(moved, (count * horizon, half.height, half.width, 5), &Device::Cpu)?;
        let modulation = self.modulate(spec, rows, &motion)?;
        let features = scene.narrow(3, 0, SCENE_FEATURES)?.contiguous()?;
        let mixed = Tensor::cat(&[&warped, &pixel_unshuffle(&features)?], 3)?;
        let state = self.refined(Self::per_place(&self.mix, &mixed, quarter)?, &modulation)?;
        let head = self.head(&state, &moved, &scene, quarter)?;

        let composition = Composition {
            size,
            frames: contexts.last_frames,
            frame_of: context_of,
            room_places: geometry.room,
        };
        let frames = composition.compose(&head, &scene, &geometry.turned)?;
        let content = fold_pixels(&scene.narrow(3, SCENE_FEATURES, SCENE_CHANNELS - SCENE_FEATURES)?)?;
        Ok(FlowPrediction {
            frames: frames.reshape((count, horizon, size.pixels()))?.narrow(1, 0, steps)?,
            scene: content.reshape((count, horizon, size.pixels()))?,
            motion,
        })
    }

    /// The states `[M, H/4, W/4, C]` after the decoder's modulated blocks.
    fn refined(&self, mut state: Tensor, modulation: &Tensor) -> Result<Tensor, NnError> {
        let channels = self.layers.channels;
        for (index, [first, second]) in self.refine.iter().enumerate() {
            let modulation = |part: usize| modulation.narrow(1, (2 * index + part) * 2 * channels, 2 * channels);
            let inner = first.forward(&modulated_silu(&state, &modulation(0)?)?)?;
            let inner = second.forward(&modulated_silu(&inner, &modulation(1)?)?)?;
            state = (state + inner)?;
        }
        Ok(state)
    }

    /// The head's values of each item `[M, H/2, W/2, 4 · HEAD_VALUES]` from its state, the pixels to move and the scene.
    fn head(&self, state: &Tensor, moved: &Tensor, scene: &Tensor, quarter: ImageSize) -> Result<Tensor, NnError> {
        let enlarged = pixel_shuffle(&Self::per_place(&self.enlarge, &silu(state)?, quarter)?)?;
        let inputs = Tensor::cat(&[&enlarged, moved, scene], 3)?;
        self.head.forward(&silu(&self.fine.forward(&inputs)?)?)
    }

    /// Features of each context `[contexts, H/4, W/4, C]`.
    fn encode(&self, spec: &ModelSpec, contexts: &EncoderViews) -> Result<Tensor, NnError> {
        let half = spec.image_size().shrunk(2);
        let seen = self.scene.content_now(spec, contexts)?;
        let inputs = contexts.inputs(spec, &seen);
        let inputs = Tensor::from_vec(inputs, (contexts.count(), half.height, half.width, ()), &Device::Cpu)?;
        let mut coarse = self.halving.forward(&silu(&self.stem.forward(&inputs)?)?)?;
        for [first, second] in &self.blocks {
            let inner = second.forward(&silu(&first.forward(&silu(&coarse)?)?)?)?;
            coarse = (coarse + inner)?;
        }
        Ok(coarse)
    }

    /// Scales and shifts of each item's modulated layers `[M, …]`.
    fn modulate(&self, spec: &ModelSpec, rows: &FutureRows, motion: &Tensor) -> Result<Tensor, NnError> {
        let known = rows.step_inputs(spec)?;
        let motion = motion.flatten(0, 1)?;
        let inputs = if self.motion.is_moving() {
            Tensor::cat(&[&known, &motion], 1)?
        } else {
            known
        };
        let [inputs_layer, output_layer] = &self.modulation;
        output_layer.forward(&silu(&inputs_layer.forward(&inputs)?)?)
    }

    /// A dense layer at each place of `[M, h, w, …]`.
    fn per_place(layer: &Dense, x: &Tensor, size: ImageSize) -> Result<Tensor, NnError> {
        let (items, _, _, channels) = x.dims4()?;
        let flat = layer.forward(&x.reshape((items * size.pixels(), channels))?)?;
        let outputs = flat.dim(1)?;
        Ok(flat.reshape((items, size.height, size.width, outputs))?)
    }

    /// Where each item's pixels were in the last frame.
    fn places(
        &self,
        spec: &ModelSpec,
        rows: &FutureRows,
        motion: &Tensor,
        poses: &[CameraPose],
    ) -> Result<ItemPlaces, NnError> {
        let size = spec.image_size();
        let quarter = size.shrunk(4);
        let Some(camera) = spec.camera.filter(|_| self.motion.is_moving()) else {
            return self.places_without_camera(spec, motion);
        };
        let viewer = Viewer::new(camera, size);
        let yaw = motion.narrow(1, 0, 1)?.flatten_all()?;
        let turned = turning_places(viewer, &viewer.rays(), &yaw)?;
        let coarse_viewer = Viewer::new(camera, quarter);
        let coarse_rays = coarse_viewer.rays();
        let coarse = with_values(&yaw, |yaw| {
            yaw.iter()
                .flat_map(|&yaw| coarse_viewer.turned(&coarse_rays, yaw))
                .collect()
        })?;
        let before: Vec<CameraPose> = (0..poses.len())
            .map(|item| rows.pose(spec, item / spec.horizon))
            .collect();
        let room = self.scene.room_places(viewer, poses, &before)?;
        let room_or_turned = match &room {
            Some(places) => places.clone(),
            None => turned.flatten_all()?.to_vec1()?,
        };
        Ok(ItemPlaces {
            turned,
            coarse,
            room,
            room_or_turned,
        })
    }

    /// As [`FlowModel::places`] where nothing is known of the camera: an affine map of the image learned from the motion,
    /// or every pixel where it is.
    fn places_without_camera(&self, spec: &ModelSpec, motion: &Tensor) -> Result<ItemPlaces, NnError> {
        let size = spec.image_size();
        let quarter = size.shrunk(4);
        let items = motion.dim(0)?;
        let own = Tensor::from_vec(own_places(size), (1, size.pixels(), 2), &Device::Cpu)?;
        let turned = match self.motion.affine_places(spec, motion, &own)? {
            Some(places) => places,
            None => own.broadcast_as((items, size.pixels(), 2))?.contiguous()?,
        };
        let values: Vec<f32> = turned.flatten_all()?.to_vec1()?;
        // The coarse places are the means of their blocks.
        let mut coarse = Vec::with_capacity(items * quarter.pixels() * 2);
        for item in values.chunks_exact(size.pixels() * 2) {
            for row in 0..quarter.height {
                for column in 0..quarter.width {
                    for axis in 0..2 {
                        let at =
                            |dy: usize, dx: usize| item[((4 * row + dy) * size.width + 4 * column + dx) * 2 + axis];
                        let middle = (at(1, 1) + at(2, 2) + at(1, 2) + at(2, 1)) / 4.0;
                        coarse.push((middle - 1.5) / 4.0);
                    }
                }
            }
        }
        Ok(ItemPlaces {
            turned,
            coarse,
            room: None,
            room_or_turned: values,
        })
    }
}

/// Where each item's pixels were in the last frame, columns and rows.
struct ItemPlaces {
    /// Before the camera turned, `[M, P, 2]`; gradients go to the motion.
    turned: Tensor,
    /// The same on the grid of a quarter of the sides.
    coarse: Vec<f32>,
    /// Before the camera turned and drove, for pixels of the room.
    room: Option<Vec<f32>>,
    /// The better guess of both.
    room_or_turned: Vec<f32>,
}

fn motion_rows(values: &[f32]) -> Vec<[f32; 3]> {
    values
        .chunks_exact(3)
        .map(|motion| [motion[0], motion[1], motion[2]])
        .collect()
}
