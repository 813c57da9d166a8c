//! The layers that estimate depth, and what the decoder reads beside what was moved by it.
// A closure's vector instructions reach what is inlined into it, and only that.
#![allow(clippy::inline_always)]

use candle_core::{Device, Shape, Tensor};

use super::blocks::{coarse_places, sampled_blocks};
use super::depth_views::{DepthViews, KNOWN_VALUES};
use super::reprojection::PLACE_VALUES;
use crate::nn::error::NnError;
use crate::nn::fused::{FusedOperation, Operand, apply};
use crate::nn::model_tensors::ModelTensors;
use crate::nn::ops::activated_convolution::{Activation, activated_convolution};
use crate::nn::ops::activation::{exp_with, tanh};
use crate::nn::ops::convolution::Convolution3;
use crate::nn::ops::image_geometry::ConvShape;
use crate::nn::ops::joining::joined_to_shuffled;
use crate::nn::ops::linear::{Linear, per_place};
use crate::nn::ops::modulation::silu;
use crate::nn::ops::pixel_shuffle::pixel_shuffle;
use crate::nn::ops::sampling::{ImageSize, PixelPlaces};
use crate::nn::precision::Precision;
use crate::nn::tensors::with_values;
use crate::vectorized::{vectorized, vectorized_by};

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
        let enlarged = silu(&per_place(&self.enlarge, &silu(coarse)?)?)?;
        let logarithm = activated_convolution(
            &self.output,
            &joined_to_shuffled([&enlarged, first])?,
            Activation::None,
            None,
        )?;
        let logarithm = pixel_shuffle(&logarithm)?.flatten_from(1)?;
        let before = Tensor::from_slice(&views.depths, logarithm.dims(), &Device::Cpu)?;
        Ok(apply(Deepened, [&logarithm, &before])?)
    }
}

/// Depths `[N, P]` before anything is learned, times e^(`MAX_LOGARITHM` · tanh of what is learned). Gradients go to the latter.
struct Deepened;

impl FusedOperation<2> for Deepened {
    const NAME: &'static str = "deepen";

    fn forward(&self, [learned, before]: [Operand; 2]) -> candle_core::Result<(Vec<f32>, Shape)> {
        let mut depths = before.values.to_vec();
        vectorized_by(
            #[inline(always)]
            |instructions| {
                for (depth, learned) in depths.iter_mut().zip(learned.values) {
                    *depth *= exp_with(MAX_LOGARITHM as f32 * tanh(*learned), instructions);
                }
            },
        );
        Ok((depths, learned.layout.shape().clone()))
    }

    fn backward(
        &self,
        [learned, _]: [Operand; 2],
        depths: Operand,
        gradient: Operand,
    ) -> candle_core::Result<[Option<Vec<f32>>; 2]> {
        let mut for_learned = gradient.values.to_vec();
        vectorized(
            #[inline(always)]
            || {
                for ((gradient, depth), learned) in for_learned.iter_mut().zip(depths.values).zip(learned.values) {
                    let share = tanh(*learned);
                    *gradient *= depth * MAX_LOGARITHM as f32 * (1.0 - share * share);
                }
            },
        );
        Ok([Some(for_learned), None])
    }
}

/// Where the items' pixels were seen, without gradients.
pub(super) struct SeenPlaces {
    /// As [`reproject`](super::reprojection::reproject) gives them.
    pub(super) places: Tensor,
    /// Before the camera turned and drove, on the grid of a quarter of the sides, `[M, H/4, W/4, 2]`.
    pub(super) coarse: Vec<f32>,
}

impl SeenPlaces {
    pub(super) fn of(places: Tensor, size: ImageSize) -> Result<Self, NnError> {
        let each = PLACE_VALUES * size.pixels();
        let coarse = with_values(&places, |places| {
            let items = places.chunks_exact(each);
            items
                .flat_map(|places| coarse_places(room_of(places, size), size))
                .collect()
        })?;
        Ok(Self { places, coarse })
    }

    /// The last frames `[contexts, P]` as the items see them, as [`sampled_blocks`] says.
    pub(super) fn moved_blocks(&self, frames: &[f32], context_of: &[u32], size: ImageSize) -> Result<Tensor, NnError> {
        let moved = with_values(&self.places, |places| {
            let items = places.chunks_exact(PLACE_VALUES * size.pixels());
            sampled_blocks(frames, context_of, items.map(|places| room_of(places, size)), size)
        })?;
        Ok(moved?)
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
            let known = &views.known[context as usize * half.pixels() * KNOWN_VALUES..][..half.pixels() * KNOWN_VALUES];
            let (known, seen) = (
                known.as_chunks::<KNOWN_VALUES>().0,
                &self.coarse[item * quarter.pixels() * 2..],
            );
            // The upper left block of each place's four.
            let rows = known.chunks_exact(half.width).step_by(2);
            let places = rows.flat_map(|row| row.iter().step_by(2)).zip(seen.as_chunks::<2>().0);
            for ([column, row, inverse], &seen) in places {
                let is_seen = f32::from(u8::from(quarter.shows(seen)));
                values.extend([*column, *row, *inverse, is_seen]);
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
        let mut values = vec![0.0; context_of.len() * half.pixels() * FINE_VALUES];
        with_values(&self.places, |places| {
            let items = values
                .chunks_exact_mut(half.pixels() * FINE_VALUES)
                .zip(places.chunks_exact(PLACE_VALUES * pixels));
            for ((values, places), &context) in items.zip(context_of) {
                let known = &views.known[context as usize * half.pixels() * KNOWN_VALUES..];
                let (room, depths) = (room_of(places, size), &places[4 * pixels..]);
                let (values, known) = (
                    values.as_chunks_mut::<FINE_VALUES>().0,
                    known.as_chunks::<KNOWN_VALUES>().0,
                );
                let rows = values.chunks_exact_mut(half.width).zip(known.chunks_exact(half.width));
                for (row, (values, known)) in rows.enumerate() {
                    for (column, (values, [x, y, inverse])) in values.iter_mut().zip(known).enumerate() {
                        // The block's upper left pixel.
                        let pixel = 2 * (row * size.width + column);
                        let outside = (size.outside(room.at(pixel)) / OUTSIDE_PX).min(MAX_OUTSIDE);
                        *values = [*x, *y, *inverse, 1.0 / depths[pixel].max(LEAST_DEPTH_M), outside];
                    }
                }
            }
        })?;
        Ok(Tensor::from_vec(
            values,
            (context_of.len(), half.height, half.width, ()),
            &Device::Cpu,
        )?)
    }
}

/// Columns and rows of an item's pixels before the camera turned and drove, from its `[PLACE_VALUES, P]`.
fn room_of(places: &[f32], size: ImageSize) -> PixelPlaces<'_> {
    let pixels = size.pixels();
    PixelPlaces::Axes([2, 3].map(|value| &places[value * pixels..(value + 1) * pixels]))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::nn::gradient_check::{assert_gradients, noise, values};

    #[test]
    fn depths_are_multiplied_by_what_is_learned() {
        let (learned, before) = (noise(&[2, 30], 1), (noise(&[2, 30], 2) + 2.0).unwrap());
        let deepened = |learned: &Tensor| apply(Deepened, [learned, &before]);
        let factors = (learned.tanh().unwrap() * MAX_LOGARITHM).unwrap().exp().unwrap();
        let expected = values(&(factors * &before).unwrap());
        for (found, expected) in values(&deepened(&learned).unwrap()).into_iter().zip(expected) {
            assert!((found / expected - 1.0).abs() < 2e-6, "{found} {expected}");
        }
        assert_gradients(&[learned], 1e-2, |inputs| deepened(&inputs[0]));
    }
}
