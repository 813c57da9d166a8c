//! The form of the flow network that estimates depth: what the last frame shows is placed in space, and seen from where the
//! camera will be. It remembers no place, so it serves in rooms that it never saw. All steps are computed at once.

use candle_core::{DType, Device, Tensor};
use candle_nn::Module as _;

use super::blocks::{coarse_places, sampled_blocks};
use super::depth_views::{DepthViews, PLACE_VALUES as KNOWN_VALUES};
use super::network::{FlowNetwork, FlowPrediction};
use super::reprojection::{PLACE_VALUES, Reprojection, reproject};
use super::rollout_rows::RolloutRows;
use crate::nn::error::NnError;
use crate::nn::model_tensors::ModelTensors;
use crate::nn::ops::compose::{Composition, RoomPlaces};
use crate::nn::ops::convolution::{ConvShape, Convolution3};
use crate::nn::ops::linear::Linear;
use crate::nn::ops::modulation::silu;
use crate::nn::ops::pixel_shuffle::pixel_shuffle;
use crate::nn::ops::sampling::{ImageSize, own_places, sample_features};
use crate::nn::tensors::with_values;

/// Values beside the moved features from which a step's state is made: place and inverse depth, and whether the last frame
/// showed it.
pub(super) const MIXED_VALUES: usize = KNOWN_VALUES + 1;
/// Values beside the moved pixels that the fine layers read: place, inverse depths before and after learning, and how far
/// outside the last frame it is.
pub(super) const FINE_VALUES: usize = KNOWN_VALUES + 2;
/// Largest logarithm of the estimated depth over the one before anything is learned.
const MAX_LOGARITHM: f64 = 1.5;
/// Pixels outside the frame that count as 1, and the most that count.
const OUTSIDE_PX: f32 = 8.0;
const MAX_OUTSIDE: f32 = 4.0;

/// The layers that estimate depth.
#[derive(Clone, Debug)]
pub(super) struct DepthHead {
    enlarge: Linear,
    output: Convolution3,
}

impl DepthHead {
    pub(super) fn new(tensors: &ModelTensors) -> Self {
        Self {
            enlarge: tensors.linear("flow.depth.enlarge"),
            output: tensors.convolution("flow.depth.output", ConvShape::PLAIN),
        }
    }

    /// The depth of each pixel of the last frames `[contexts, P]`, in metres.
    fn forward(&self, [coarse, first]: &[Tensor; 2], views: &DepthViews) -> Result<Tensor, NnError> {
        let enlarged = silu(&pixel_shuffle(&FlowNetwork::per_place(&self.enlarge, &silu(coarse)?)?)?)?;
        let logarithm = self.output.forward(&Tensor::cat(&[&enlarged, first], 3)?)?;
        let logarithm = pixel_shuffle(&logarithm)?.flatten_from(1)?;
        let factor = (logarithm.tanh()? * MAX_LOGARITHM)?.exp()?;
        let before = Tensor::from_slice(&views.depths, factor.dims(), &Device::Cpu)?;
        Ok((factor * before)?)
    }
}

impl FlowNetwork {
    /// All steps of the rollouts at once; gives the frames of the first `steps`.
    pub(super) fn predict_with_depth(
        &self,
        rows: &RolloutRows,
        steps: usize,
        head: &DepthHead,
    ) -> Result<FlowPrediction, NnError> {
        let (size, horizon) = (self.spec.image_size(), self.spec.horizon);
        let motion = self.motion.forward(rows)?;
        let contexts = rows.contexts(self.sizes.layers.frames_read);
        let mut views = DepthViews::of(&contexts);
        let features = self.encode(contexts.count(), std::mem::take(&mut views.inputs))?;
        let depths = head.forward(&features, &views)?;

        // Frames that are not asked for are not computed.
        let of_steps = |&context: &u32| std::iter::repeat_n(context, steps);
        let context_of: Vec<u32> = contexts.row_of.iter().flat_map(of_steps).collect();
        let asked = |per_step: &Tensor| -> Result<Tensor, NnError> {
            let per_step = per_step.reshape((rows.count(), horizon, ()))?;
            Ok(per_step.narrow(1, 0, steps)?.flatten(0, 1)?)
        };
        let reprojection = Reprojection {
            size,
            viewers: views.viewers.clone(),
            context_of: context_of.clone(),
        };
        let places = reproject(reprojection, &depths, &asked(&motion)?)?;
        let seen = with_values(&places, |places| SeenPlaces::of(places, size))?;
        let warped = sample_features(&features[0], seen.coarse.clone(), &context_of)?;
        let mixed = Tensor::cat(&[&warped, &seen.beside_features(&views, &context_of, size)?], 3)?;
        let state = Self::per_place(&self.mix, &mixed)?;
        let state = self.refined(state, &asked(&self.modulate(rows, &motion)?)?)?;
        let moved = sampled_blocks(&views.frames, &context_of, &seen.room, size)?;
        let head = self.head(&state, &moved, &seen.beside_pixels(&views, &context_of, size)?)?;

        let half = size.shrunk(2);
        let no_content = Tensor::zeros((context_of.len(), half.height, half.width, 4), DType::F32, &Device::Cpu)?;
        let composition = Composition {
            size,
            frames: views.frames,
            frame_of: context_of.clone(),
            room: RoomPlaces::Tracked,
        };
        // The composition's tensor has the place before the turn first.
        let frames = composition.compose(&head, &no_content, &places)?;
        let level = |part: usize| -> Result<Tensor, NnError> {
            let levels: Vec<f32> = context_of
                .iter()
                .map(|&context| views.levels[context as usize][part])
                .collect();
            Ok(Tensor::from_vec(levels, (context_of.len(), 1), &Device::Cpu)?)
        };
        let frames = frames.broadcast_mul(&level(1)?)?.broadcast_add(&level(0)?)?;
        Ok(FlowPrediction {
            frames: frames.reshape((rows.count(), steps, size.pixels()))?,
            scene: None,
            motion,
        })
    }
}

/// Where the items' pixels were seen, without gradients.
struct SeenPlaces {
    /// Before the camera turned and drove, `[M, P, 2]`.
    room: Vec<f32>,
    /// The same on the grid of a quarter of the sides.
    coarse: Vec<f32>,
    /// Inverse depth in the new view, `[M, P]`.
    inverse_depths: Vec<f32>,
}

impl SeenPlaces {
    fn of(places: &[f32], size: ImageSize) -> Self {
        let pixels = places.chunks_exact(PLACE_VALUES);
        Self {
            room: pixels.clone().flat_map(|place| [place[2], place[3]]).collect(),
            coarse: coarse_places(places, PLACE_VALUES, 2, size),
            inverse_depths: pixels.map(|place| 1.0 / place[4].max(0.05)).collect(),
        }
    }

    /// What the step's state is made of beside the moved features, `[M, H/4, W/4, MIXED_VALUES]`.
    fn beside_features(&self, views: &DepthViews, context_of: &[u32], size: ImageSize) -> Result<Tensor, NnError> {
        let (half, quarter) = (size.shrunk(2), size.shrunk(4));
        let mut values = Vec::with_capacity(context_of.len() * quarter.pixels() * MIXED_VALUES);
        for (item, &context) in context_of.iter().enumerate() {
            let known = &views.places[context as usize * half.pixels() * KNOWN_VALUES..];
            let seen = &self.coarse[item * quarter.pixels() * 2..];
            for (place, own) in own_places(quarter).chunks_exact(2).enumerate() {
                // The upper left block of the place's four.
                let block = 2 * own[1] as usize * half.width + 2 * own[0] as usize;
                values.extend_from_slice(&known[block * KNOWN_VALUES..(block + 1) * KNOWN_VALUES]);
                let is_seen = (-0.5..=quarter.width as f32 - 0.5).contains(&seen[2 * place])
                    && (-0.5..=quarter.height as f32 - 0.5).contains(&seen[2 * place + 1]);
                values.push(f32::from(u8::from(is_seen)));
            }
        }
        Ok(Tensor::from_vec(
            values,
            (context_of.len(), quarter.height, quarter.width, ()),
            &Device::Cpu,
        )?)
    }

    /// What the fine layers read beside the moved pixels, `[M, H/2, W/2, FINE_VALUES]`.
    fn beside_pixels(&self, views: &DepthViews, context_of: &[u32], size: ImageSize) -> Result<Tensor, NnError> {
        let (half, pixels) = (size.shrunk(2), size.pixels());
        let mut values = Vec::with_capacity(context_of.len() * half.pixels() * FINE_VALUES);
        for (item, &context) in context_of.iter().enumerate() {
            let known = &views.places[context as usize * half.pixels() * KNOWN_VALUES..];
            for block in 0..half.pixels() {
                values.extend_from_slice(&known[block * KNOWN_VALUES..(block + 1) * KNOWN_VALUES]);
                // The block's upper left pixel.
                let pixel = item * pixels + block / half.width * 2 * size.width + block % half.width * 2;
                values.push(self.inverse_depths[pixel]);
                let beyond = |at: f32, side: usize| (-at).max(at - (side as f32 - 1.0)).max(0.0);
                let outside = beyond(self.room[2 * pixel], size.width) + beyond(self.room[2 * pixel + 1], size.height);
                values.push((outside / OUTSIDE_PX).min(MAX_OUTSIDE));
            }
        }
        Ok(Tensor::from_vec(
            values,
            (context_of.len(), half.height, half.width, ()),
            &Device::Cpu,
        )?)
    }
}
