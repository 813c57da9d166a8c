//! The layers that estimate depth, and what the decoder reads beside what was moved by it.

use candle_core::{Device, Tensor};

use super::blocks::coarse_places;
use super::depth_views::{DepthViews, KNOWN_VALUES};
use super::reprojection::PLACE_VALUES;
use crate::nn::error::NnError;
use crate::nn::model_tensors::ModelTensors;
use crate::nn::ops::activated_convolution::{Activation, activated_convolution};
use crate::nn::ops::convolution::Convolution3;
use crate::nn::ops::image_geometry::ConvShape;
use crate::nn::ops::linear::{Linear, per_place};
use crate::nn::ops::modulation::silu;
use crate::nn::ops::pixel_shuffle::pixel_shuffle;
use crate::nn::ops::sampling::{ImageSize, own_places};
use crate::nn::precision::Precision;

/// Values beside the moved features from which a step's state is made: place and inverse depth, and whether the last frame
/// showed it.
pub(super) const MIXED_VALUES: usize = KNOWN_VALUES + 1;
/// Values beside the moved pixels that the fine layers read: place, inverse depths before and after learning, and how far
/// outside the last frame it is.
pub(super) const FINE_VALUES: usize = KNOWN_VALUES + 2;
/// Largest logarithm of the estimated depth over the one before anything is learned.
pub(super) const MAX_LOGARITHM: f64 = 1.5;
/// Pixels outside the frame that count as 1.
pub(super) const OUTSIDE_PX: f32 = 8.0;
/// The most that counts of them.
pub(super) const MAX_OUTSIDE: f32 = 4.0;
/// Least depth whose inverse the fine layers read, in metres.
pub(super) const LEAST_DEPTH_M: f32 = 0.05;

/// The layers that estimate depth.
#[derive(Clone, Debug)]
pub(super) struct DepthHead {
    pub(super) enlarge: Linear,
    pub(super) output: Convolution3,
}

impl DepthHead {
    pub(super) fn new(tensors: &ModelTensors) -> Self {
        Self {
            enlarge: tensors.linear("flow.depth.enlarge"),
            output: tensors.convolution("flow.depth.output", ConvShape::PLAIN),
        }
    }

    /// Packs the layers' weights for prediction.
    pub(super) fn pack(&mut self, precision: Precision) -> Result<(), NnError> {
        self.enlarge.pack(precision.at_least_bf16())?;
        Ok(self.output.pack(precision)?)
    }

    /// The depth of each pixel of the last frames `[contexts, P]`, in metres.
    pub(super) fn forward(&self, [coarse, first]: &[Tensor; 2], views: &DepthViews) -> Result<Tensor, NnError> {
        let enlarged = silu(&pixel_shuffle(&per_place(&self.enlarge, &silu(coarse)?)?)?)?;
        let logarithm = activated_convolution(
            &self.output,
            &Tensor::cat(&[&enlarged, first], 3)?,
            Activation::None,
            None,
        )?;
        let logarithm = pixel_shuffle(&logarithm)?.flatten_from(1)?;
        let factor = (logarithm.tanh()? * MAX_LOGARITHM)?.exp()?;
        let before = Tensor::from_slice(&views.depths, factor.dims(), &Device::Cpu)?;
        Ok((factor * before)?)
    }
}

/// Where the items' pixels were seen, without gradients.
pub(super) struct SeenPlaces {
    /// Before the camera turned and drove, `[M, P, 2]`.
    pub(super) room: Vec<f32>,
    /// The same on the grid of a quarter of the sides.
    pub(super) coarse: Vec<f32>,
    /// Inverse depth in the new view, `[M, P]`.
    inverse_depths: Vec<f32>,
}

impl SeenPlaces {
    pub(super) fn of(places: &[f32], size: ImageSize) -> Self {
        let (count, pixels) = (places.len() / PLACE_VALUES, places.chunks_exact(PLACE_VALUES));
        let (mut room, mut inverse_depths) = (Vec::with_capacity(2 * count), Vec::with_capacity(count));
        for place in pixels {
            room.extend_from_slice(&place[2..4]);
            inverse_depths.push(1.0 / place[4].max(LEAST_DEPTH_M));
        }
        Self {
            room,
            coarse: coarse_places(places, PLACE_VALUES, 2, size),
            inverse_depths,
        }
    }

    /// The other inputs of the step's state, beside the moved features, `[M, H/4, W/4, MIXED_VALUES]`.
    pub(super) fn beside_features(
        &self,
        views: &DepthViews,
        context_of: &[u32],
        size: ImageSize,
    ) -> Result<Tensor, NnError> {
        let (half, quarter) = (size.shrunk(2), size.shrunk(4));
        let mut values = Vec::with_capacity(context_of.len() * quarter.pixels() * MIXED_VALUES);
        for (item, &context) in context_of.iter().enumerate() {
            let known = &views.known[context as usize * half.pixels() * KNOWN_VALUES..];
            let seen = &self.coarse[item * quarter.pixels() * 2..];
            for (place, own) in own_places(quarter).chunks_exact(2).enumerate() {
                // The upper left block of the place's four.
                let block = 2 * own[1] as usize * half.width + 2 * own[0] as usize;
                values.extend_from_slice(&known[block * KNOWN_VALUES..(block + 1) * KNOWN_VALUES]);
                let is_seen = quarter.shows([seen[2 * place], seen[2 * place + 1]]);
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
    pub(super) fn beside_pixels(
        &self,
        views: &DepthViews,
        context_of: &[u32],
        size: ImageSize,
    ) -> Result<Tensor, NnError> {
        let (half, pixels) = (size.shrunk(2), size.pixels());
        let mut values = Vec::with_capacity(context_of.len() * half.pixels() * FINE_VALUES);
        for (item, &context) in context_of.iter().enumerate() {
            let known = &views.known[context as usize * half.pixels() * KNOWN_VALUES..];
            let mut blocks = known.chunks_exact(KNOWN_VALUES);
            for row in 0..half.height {
                for (column, known) in blocks.by_ref().take(half.width).enumerate() {
                    values.extend_from_slice(known);
                    // The block's upper left pixel.
                    let pixel = item * pixels + 2 * row * size.width + 2 * column;
                    values.push(self.inverse_depths[pixel]);
                    let outside = size.outside([self.room[2 * pixel], self.room[2 * pixel + 1]]);
                    values.push((outside / OUTSIDE_PX).min(MAX_OUTSIDE));
                }
            }
        }
        Ok(Tensor::from_vec(
            values,
            (context_of.len(), half.height, half.width, ()),
            &Device::Cpu,
        )?)
    }
}
