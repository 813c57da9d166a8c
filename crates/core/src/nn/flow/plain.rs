//! The flow network in candle's own tensor operations: the reference of the other modules of this folder, and the path of graphics
//! cards. All steps of all rollouts are computed together. Small things stay on the CPU: the wheels' integral and where the state says
//! that the camera stands.
//!
//! Reading order: `cameras` and `motion` → `composition` → `depth_views`, `reprojection`, `memory` and `depth`, or `room`, `scene`, `direct` and
//! `recurrent`.

mod cameras;
mod composition;
mod depth;
mod depth_views;
mod direct;
mod memory;
mod motion;
mod recurrent;
mod reprojection;
mod room;
mod scene;
mod speed_head;

use std::ops::Range;

use candle_core::{Device, Tensor};

use super::network::{FlowNetwork, FlowPrediction, Surroundings};
use super::rollout_rows::RolloutRows;
use crate::nn::error::NnError;
use crate::nn::plain::convolution::convolution;
use crate::nn::plain::layers::{linear_per_place, modulated_silu, perceptron, pixel_shuffle};

/// Rollouts that are predicted together at most, which bounds the memory of the device.
const ROWS_TOGETHER: usize = 128;

/// What is known of the items: the first steps of rollouts, rollout after rollout. There are M.
struct ItemsAhead {
    /// How the camera will have moved since the last frame at all steps, `[N, horizon, 3]`.
    motion: Tensor,
    /// The same of the items, `[M, 3]`.
    item_motion: Tensor,
    /// Scales and shifts of each item's modulated layers, `[M, …]`.
    modulation: Tensor,
    /// The context of each item.
    context_of: Vec<u32>,
    /// The row of each item's rollout.
    row_of: Vec<usize>,
    /// Rollouts and steps of each.
    shape: [usize; 2],
}

impl ItemsAhead {
    /// The items' rows of something that there is for each context.
    fn of_contexts(&self, values: &Tensor) -> Result<Tensor, NnError> {
        let contexts = Tensor::new(self.context_of.as_slice(), values.device())?;
        Ok(values.contiguous()?.index_select(&contexts, 0)?)
    }

    /// Something of each item `[M, P]` as `[N, steps, P]`.
    fn in_rows(&self, values: &Tensor) -> Result<Tensor, NnError> {
        let [rows, steps] = self.shape;
        Ok(values.reshape((rows, steps, ()))?)
    }
}

impl FlowNetwork {
    /// As [`FlowNetwork::predict`]. Without gradients, the result is on the CPU.
    pub(super) fn plain_predict(&self, rows: &RolloutRows, steps: usize) -> Result<FlowPrediction, NnError> {
        if self.is_trained() {
            return self.plain_predict_rows(rows, steps);
        }
        let first_rows = (0..rows.count()).step_by(ROWS_TOGETHER);
        let parts = first_rows.map(|first| first..(first + ROWS_TOGETHER).min(rows.count()));
        let predict = |part: Range<usize>| self.plain_predict_rows(&rows.part(part), steps)?.on_cpu();
        FlowPrediction::joined(&parts.map(predict).collect::<Result<Vec<_>, NnError>>()?)
    }

    fn plain_predict_rows(&self, rows: &RolloutRows, steps: usize) -> Result<FlowPrediction, NnError> {
        match &self.surroundings {
            Surroundings::Seen(depth) => self.plain_predict_with_depth(&self.see_speeds(rows)?, depth, steps),
            Surroundings::Remembered(scene) if self.sizes.layers.recurrent => {
                self.plain_predict_recurrently(rows, scene, steps)
            }
            Surroundings::Remembered(scene) => self.plain_predict_directly(rows, scene, steps),
        }
    }

    fn device(&self) -> &Device {
        self.mix.weight.device()
    }

    /// What is known of the first `steps` of the rollouts before their frames are computed.
    fn ahead(&self, rows: &RolloutRows, steps: usize) -> Result<ItemsAhead, NnError> {
        let count = rows.count();
        let motion = self.motion.plain_forward(rows, self.device())?;
        let modulation = self.plain_modulate(rows, &motion)?;
        let of_steps = |of_all: &Tensor| of_all.narrow(1, 0, steps)?.contiguous()?.flatten(0, 1);
        let contexts = rows.context_of().into_iter();
        Ok(ItemsAhead {
            item_motion: of_steps(&motion)?,
            modulation: of_steps(&modulation)?,
            motion,
            context_of: contexts
                .flat_map(|context| std::iter::repeat_n(context, steps))
                .collect(),
            row_of: (0..count).flat_map(|row| std::iter::repeat_n(row, steps)).collect(),
            shape: [count, steps],
        })
    }

    /// Scales and shifts of the modulated layers `[N, horizon, …]`.
    fn plain_modulate(&self, rows: &RolloutRows, motion: &Tensor) -> Result<Tensor, NnError> {
        let mut inputs = rows.step_inputs()?.to_device(self.device())?;
        if self.motion.is_moving() {
            inputs = Tensor::cat(&[&inputs, &motion.flatten(0, 1)?], 1)?;
        }
        let modulation = perceptron(&self.modulation, &inputs)?;
        Ok(modulation.reshape((rows.count(), self.spec.horizon, ()))?)
    }

    /// Features of each context `[contexts, C, H/4, W/4]` and those of the first layer `[contexts, …, H/2, W/2]`, from the encoder's
    /// inputs `[contexts, …, H/2, W/2]`. The first layer adds `added`.
    fn plain_encode(&self, inputs: &Tensor, added: Option<&Tensor>) -> Result<[Tensor; 2], NnError> {
        let first = plus(convolution(&self.stem, inputs)?, added)?.silu()?;
        let mut coarse = convolution(&self.halving, &first)?;
        for [before, after] in &self.blocks {
            let inner = convolution(before, &coarse.silu()?)?;
            coarse = (coarse + convolution(after, &inner.silu()?)?)?;
        }
        Ok([coarse, first])
    }

    /// The items' states `[M, C, H/4, W/4]` after the decoder's modulated blocks, from what they are mixed of.
    fn plain_state(&self, mixed: &Tensor, modulation: &Tensor) -> Result<Tensor, NnError> {
        self.plain_refined(linear_per_place(&self.mix, mixed)?, modulation)
    }

    /// The states after the modulated blocks.
    fn plain_refined(&self, mut state: Tensor, modulation: &Tensor) -> Result<Tensor, NnError> {
        let channels = self.sizes.layers.channels;
        for (index, [first, second]) in self.refine.iter().enumerate() {
            let modulation = |part: usize| modulation.narrow(1, (2 * index + part) * 2 * channels, 2 * channels);
            let inner = convolution(first, &modulated_silu(&state, &modulation(0)?)?)?;
            state = (&state + convolution(second, &modulated_silu(&inner, &modulation(1)?)?)?)?;
        }
        Ok(state)
    }

    /// The fine layer's values `[M, …, H/2, W/2]` from the items' states and what else it reads, plus `added`.
    fn plain_fine(
        &self,
        state: &Tensor,
        [moved, beside]: [&Tensor; 2],
        added: Option<&Tensor>,
    ) -> Result<Tensor, NnError> {
        let enlarged = pixel_shuffle(&linear_per_place(&self.enlarge, &state.silu()?)?)?;
        let fine = convolution(&self.fine, &Tensor::cat(&[&enlarged, moved, beside], 1)?)?;
        Ok(plus(fine, added)?)
    }

    /// The head's values of each pixel `[M, HEAD_VALUES, P]` from those of the fine layer.
    fn plain_head(&self, fine: &Tensor) -> Result<Tensor, NnError> {
        Ok(pixel_shuffle(&convolution(&self.head, &fine.silu()?)?)?.flatten_from(2)?)
    }
}

fn plus(values: Tensor, added: Option<&Tensor>) -> candle_core::Result<Tensor> {
    match added {
        Some(added) => values + added,
        None => Ok(values),
    }
}

impl FlowPrediction {
    /// Everything on the CPU.
    fn on_cpu(&self) -> Result<Self, NnError> {
        let moved = |tensor: &Tensor| tensor.to_device(&Device::Cpu);
        Ok(Self {
            frames: moved(&self.frames)?,
            scene: self.scene.as_ref().map(moved).transpose()?,
            motion: moved(&self.motion)?,
            movers: self.movers.as_ref().map(moved).transpose()?,
            speeds: self.speeds.as_ref().map(moved).transpose()?,
        })
    }
}
