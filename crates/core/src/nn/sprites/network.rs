//! The forward pass.

use candle_core::{Device, Tensor};
use rayon::prelude::*;

use super::motion::{SpriteMotion, Ways};
use super::pictures::{placed, reversed, together, united};
use super::separation::{Separated, Separation};
use crate::nn::error::NnError;
use crate::nn::model_tensors::ModelTensors;
use crate::nn::ops::activated_convolution::{Activation, activated_convolution};
use crate::nn::ops::convolution::Convolution3;
use crate::nn::ops::image_geometry::ConvShape;
use crate::nn::ops::pixel_shuffle::{pixel_shuffle, pixel_unshuffle};
use crate::nn::plain::layers::sigmoid;
use crate::nn::precision::Precision;
use crate::nn::spec::{ModelSpec, SpriteSpec};

/// What the network gives for N windows. Tensors about sprites have 2 N rows: the first sprites of all windows, then the second ones.
#[derive(Clone, Debug)]
pub struct SpritePrediction {
    /// The predicted frames `[N, horizon, P]`.
    pub frames: Tensor,
    /// The context's frames as the sprites show them `[N, context, P]`.
    pub context: Tensor,
    /// How far each sprite will have moved since the last frame, to the right and down in pixels `[2 N, horizon, 2]`.
    pub moves: Tensor,
    /// How much each block of the last frame says of a sprite's motion `[2 N, H/4 · W/4]`; each row sums to 1.
    pub trust: Tensor,
}

/// The sprites of N windows, and how they moved and will move.
struct Moving {
    /// `[2 N, H, W]`
    sprites: Tensor,
    /// As in [`Separated`].
    earlier: Tensor,
    trust: Tensor,
    ways: Ways,
}

/// The network: its weights and what they are for.
#[derive(Clone, Debug)]
pub(in crate::nn) struct SpriteNetwork {
    spec: ModelSpec,
    separation: Separation,
    content: [Convolution3; 3],
    motion: SpriteMotion,
}

impl SpriteNetwork {
    /// The network of these tensors.
    pub(in crate::nn) fn new(spec: ModelSpec, sizes: SpriteSpec, tensors: &ModelTensors) -> Self {
        let content = |part| tensors.convolution(&format!("sprites.content.{part}"), ConvShape::PLAIN);
        Self {
            separation: Separation::new(sizes, tensors),
            content: ["first", "second", "output"].map(content),
            motion: SpriteMotion::new(tensors),
            spec,
        }
    }

    /// Packs the weights of all layers as they are now, for fast prediction.
    pub(in crate::nn) fn pack(&mut self, precision: Precision) -> Result<(), NnError> {
        for convolution in &mut self.content {
            convolution.pack(precision)?;
        }
        self.separation.pack(precision)?;
        self.motion.pack(precision)
    }

    /// All that training learns from, of windows of frames `[N, context, P]`.
    pub(in crate::nn) fn predict(&self, frames: &Tensor) -> Result<SpritePrediction, NnError> {
        let moving = self.moving(frames)?;
        let still = Tensor::zeros((moving.sprites.dim(0)?, 1, 2), moving.earlier.dtype(), &Device::Cpu)?;
        let so_far = Tensor::cat(&[&reversed(&moving.earlier)?, &still], 1)?;
        let context = placed(&moving.sprites, &so_far, &so_far.ones_like()?)?;
        Ok(SpritePrediction {
            frames: self.coming(&moving, self.spec.horizon)?,
            context: together(&context, self.spec.image_size())?,
            moves: moving.ways.moves,
            trust: moving.trust,
        })
    }

    /// Frames `[N, steps, P]` that follow the windows `windows[n]` of frames `[B, context, P]`. Beyond the horizon, each horizon follows
    /// the frames predicted before it.
    pub(in crate::nn) fn predict_rollouts(
        &self,
        frames: &Tensor,
        windows: &[u32],
        steps: usize,
    ) -> Result<Tensor, NnError> {
        let (context, horizon) = (self.spec.context, self.spec.horizon);
        let mut known = frames.clone();
        while known.dim(1)? < context + steps {
            let done = known.dim(1)? - context;
            let last = known.narrow(1, done, context)?;
            let asked = horizon.min(steps - done);
            known = Tensor::cat(&[&known, &self.frames(&last, asked)?], 1)?;
        }
        let predicted = known.narrow(1, context, steps)?.contiguous()?;
        Ok(predicted.index_select(&Tensor::new(windows, &Device::Cpu)?, 0)?)
    }

    /// The first `steps` frames that follow the windows of frames `[N, context, P]`, as pixels of 0 to 1.
    fn frames(&self, frames: &Tensor, steps: usize) -> Result<Tensor, NnError> {
        let together = |frames: &Tensor| self.coming(&self.moving(frames)?, steps);
        let windows = frames.dim(0)?;
        if self.separation.is_trained() || windows == 1 {
            return Ok(together(frames)?.clamp(0f32, 1f32)?);
        }
        // One window after another, so that what lies between two layers stays in the processor's cache.
        let each = (0..windows).into_par_iter();
        let parts = each.map(|window| together(&frames.narrow(0, window, 1)?));
        Ok(Tensor::cat(&parts.collect::<Result<Vec<_>, NnError>>()?, 0)?.clamp(0f32, 1f32)?)
    }

    fn moving(&self, frames: &Tensor) -> Result<Moving, NnError> {
        let size = self.spec.image_size();
        let frames = frames.contiguous()?;
        let seen = self.separation.separate(&frames, size)?;
        let sprites = self.whole_sprites(&frames, &seen)?;
        Ok(Moving {
            ways: self.motion.ways(&sprites, &seen.earlier, size, self.spec.horizon)?,
            sprites,
            earlier: seen.earlier,
            trust: seen.trust,
        })
    }

    /// The first `steps` frames to come. They teach how the sprites move; what these look like, the context's frames teach.
    fn coming(&self, moving: &Moving, steps: usize) -> Result<Tensor, NnError> {
        let ahead = |values: &Tensor| values.narrow(1, 0, steps);
        let Ways { moves, widths } = &moving.ways;
        let coming = placed(&moving.sprites.detach(), &ahead(moves)?, &ahead(widths)?)?;
        together(&coming, self.spec.image_size())
    }

    /// The sprites `[2 N, H, W]`, with what the other one hides.
    fn whole_sprites(&self, frames: &Tensor, seen: &Separated) -> Result<Tensor, NnError> {
        let size = self.spec.image_size();
        let (windows, context, _) = frames.dims3()?;
        let frames = frames.reshape((windows, context, size.height, size.width))?;
        let earlier = reversed(&frames.narrow(1, 0, context - 1)?)?;
        let last = frames.narrow(1, context - 1, 1)?;
        let twice = |values: &Tensor| Tensor::cat(&[values, values], 0);
        let back = seen.earlier.neg()?;
        let followed = placed(&twice(&earlier)?, &back, &back.ones_like()?)?;
        let read = Tensor::cat(&[&twice(&last)?, &followed, &seen.parts.unsqueeze(1)?], 1)?;
        let read = pixel_unshuffle(&read.permute((0, 2, 3, 1))?.contiguous()?)?;
        let [first, second, output] = &self.content;
        let inner = activated_convolution(first, &read, Activation::None, None)?;
        let inner = activated_convolution(second, &inner, Activation::Silu, None)?;
        let hidden = pixel_shuffle(&activated_convolution(output, &inner, Activation::Silu, None)?)?;
        let hidden = sigmoid(&(hidden.reshape(seen.parts.shape())? - 4.0)?)?;
        united(&[seen.parts.clone(), hidden])
    }
}
