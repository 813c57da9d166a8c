//! Which pixels of the last frame are of which sprite, and how the sprites moved in the context.

use candle_core::Tensor;

use super::layers::SPRITES;
use super::reading::Reading;
use crate::nn::error::NnError;
use crate::nn::model_tensors::ModelTensors;
use crate::nn::ops::activated_convolution::{Activation, activated_convolution};
use crate::nn::ops::convolution::Convolution3;
use crate::nn::ops::image_geometry::ConvShape;
use crate::nn::ops::linear::{Linear, per_place};
use crate::nn::ops::modulation::silu;
use crate::nn::ops::pixel_shuffle::pixel_shuffle;
use crate::nn::ops::sampling::ImageSize;
use crate::nn::plain::layers::sigmoid;
use crate::nn::precision::Precision;
use crate::nn::spec::SpriteSpec;

/// The layers. The encoder works on the grid of a quarter of the sides.
#[derive(Clone, Debug)]
pub(super) struct Separation {
    stem: Convolution3,
    halving: Convolution3,
    tracks: Linear,
    blocks: Vec<[Convolution3; 2]>,
    trust: Linear,
    enlarge: Linear,
    fine: Convolution3,
    head: Convolution3,
}

/// What is seen of N windows.
pub(super) struct Separated {
    /// The sprites in the last frames, without what is hidden `[2 N, H, W]`.
    pub(super) parts: Tensor,
    /// How much each block says of a sprite's motion `[2 N, H/4 · W/4]`.
    pub(super) trust: Tensor,
    /// How far each sprite was from its place in the last frame, frame by frame, latest first `[2 N, context − 1, 2]`.
    pub(super) earlier: Tensor,
}

impl Separation {
    pub(super) fn new(sizes: SpriteSpec, tensors: &ModelTensors) -> Self {
        let convolution = |name: &str, shape| tensors.convolution(&format!("sprites.{name}"), shape);
        let linear = |name: &str| tensors.linear(&format!("sprites.{name}"));
        let block = |index: usize| {
            let first = ConvShape::dilated(1 << (index % 3));
            let name = format!("encoder.{index}");
            [("first", first), ("second", ConvShape::PLAIN)]
                .map(|(part, shape)| convolution(&format!("{name}.{part}"), shape))
        };
        Self {
            stem: convolution("stem", ConvShape::PLAIN),
            halving: convolution("halving", ConvShape::HALVING),
            tracks: linear("tracks"),
            blocks: (0..sizes.encoder_blocks).map(block).collect(),
            trust: linear("trust"),
            enlarge: linear("enlarge"),
            fine: convolution("fine", ConvShape::PLAIN),
            head: convolution("head", ConvShape::PLAIN),
        }
    }

    /// Packs the weights of all layers as they are now, for fast prediction.
    pub(super) fn pack(&mut self, precision: Precision) -> Result<(), NnError> {
        let convolutions = [&mut self.stem, &mut self.halving, &mut self.fine, &mut self.head].into_iter();
        for convolution in convolutions.chain(self.blocks.iter_mut().flatten()) {
            convolution.pack(precision)?;
        }
        for linear in [&mut self.tracks, &mut self.trust, &mut self.enlarge] {
            linear.pack(precision.at_least_bf16())?;
        }
        Ok(())
    }

    /// Whether gradients go to the weights.
    pub(super) fn is_trained(&self) -> bool {
        self.stem.weight.track_op()
    }

    /// Separates the sprites in windows of frames `[N, context, P]`.
    pub(super) fn separate(&self, frames: &Tensor, size: ImageSize) -> Result<Separated, NnError> {
        let quarter = size.shrunk(4);
        let (windows, context, _) = frames.dims3()?;
        let reading = Reading::new(frames, size)?;
        let first = silu(&activated_convolution(
            &self.stem,
            &reading.inputs,
            Activation::None,
            None,
        )?)?;
        let coarse = self.encoded(&first, &reading.scaled_tracks(quarter)?)?;
        let share = self.share(&first, &coarse, &reading.apart, quarter)?;
        let last = frames.narrow(1, context - 1, 1)?;
        let last = last.reshape((windows, size.height, size.width))?;
        let first_parts = (&last * share.reshape(last.shape())?)?;
        let parts = Tensor::cat(&[&first_parts, &(&last - &first_parts)?], 0)?;

        let rows = (SPRITES * windows, quarter.pixels());
        let of_sprites = |values: &Tensor| -> candle_core::Result<Tensor> {
            let values = values.reshape((windows, quarter.pixels(), SPRITES))?;
            values.permute((2, 0, 1))?.contiguous()?.reshape(rows)
        };
        let trust = of_sprites(&per_place(&self.trust, &coarse)?)?;
        let trust = (((trust / 4.0)?.tanh()? * 4.0)? - of_sprites(&reading.apart)?.sqr()?)?.exp()?;
        let light = parts.reshape((SPRITES * windows, quarter.height, 4, quarter.width, 4))?;
        let trust = ((trust * light.sum(4)?.sum(2)?.reshape(rows)?)? + 1e-4)?;
        let trust = trust.broadcast_div(&trust.sum_keepdim(1)?)?;
        let moved = reading.tracks.narrow(3, 0, 2)?;
        let moved = moved.reshape((windows, quarter.pixels(), ()))?;
        let earlier = trust.unsqueeze(1)?.matmul(&Tensor::cat(&[&moved, &moved], 0)?)?;
        Ok(Separated {
            parts,
            trust,
            earlier: earlier.reshape((SPRITES * windows, context - 1, 2))?,
        })
    }

    /// What the encoder makes of the first layer's output and the tracks.
    fn encoded(&self, first: &Tensor, tracks: &Tensor) -> Result<Tensor, NnError> {
        let halved = activated_convolution(&self.halving, first, Activation::None, None)?;
        let mut coarse = (halved + per_place(&self.tracks, tracks)?)?;
        for [before, after] in &self.blocks {
            let inner = activated_convolution(before, &coarse, Activation::Silu, None)?;
            coarse = activated_convolution(after, &inner, Activation::Silu, Some(&coarse))?;
        }
        Ok(silu(&coarse)?)
    }

    /// The first sprite's share of each pixel of the last frame. What follows the first way belongs to the first sprite, unless the
    /// encoder says otherwise.
    fn share(&self, first: &Tensor, coarse: &Tensor, apart: &Tensor, quarter: ImageSize) -> Result<Tensor, NnError> {
        let enlarged = pixel_shuffle(&per_place(&self.enlarge, coarse)?)?;
        let fine = Tensor::cat(&[&enlarged, first], 3)?;
        let fine = activated_convolution(&self.fine, &fine, Activation::None, None)?;
        let logits = pixel_shuffle(&activated_convolution(&self.head, &fine, Activation::Silu, None)?)?;
        let nearer = (apart.narrow(2, 1, 1)? - apart.narrow(2, 0, 1)?)?;
        let nearer = nearer.reshape(((), quarter.height, 1, quarter.width, 1))?;
        let nearer = nearer.repeat((1, 1, 4, 1, 4))?;
        Ok(sigmoid(&((logits * 2.0)?.reshape(nearer.shape())? + nearer)?)?)
    }
}
