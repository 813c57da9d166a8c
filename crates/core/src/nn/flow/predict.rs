//! Predicts the rollouts of a batch with the flow network, in any of its forms, on all threads of the pool that it is called in.
//!
//! What depends only on the context is computed once for all rollouts that follow it. The rollouts are then computed few at a
//! time, so that what lies between two layers stays in the processor's cache, and many take no more memory than few.

use std::ops::Range;

use candle_core::Tensor;
use rayon::prelude::*;

use super::network::{FlowNetwork, FlowPrediction, Surroundings};
use super::rollout_rows::RolloutRows;
use crate::nn::conditioning::ConditioningTensors;
use crate::nn::error::NnError;

/// Rollouts of one context that are computed together without gradients.
const ROLLOUTS_TOGETHER: usize = 1;

impl FlowNetwork {
    /// N rollouts of B windows of frames `[B, context, P]`, with the frames of the first `steps` only: rollout n follows
    /// window `windows[n]` under row n of the conditioning. Errors: `Shape`, `Missing`.
    pub(in crate::nn) fn predict(
        &self,
        frames: &Tensor,
        windows: &[u32],
        conditioning: &ConditioningTensors,
        steps: usize,
    ) -> Result<FlowPrediction, NnError> {
        let rows = RolloutRows::new(&self.spec, frames, windows, conditioning)?;
        if self.is_trained() {
            return self.predict_rows(&rows, steps);
        }
        in_parts(&rows, rows.of_one_context(), |rows| self.predict_rows(rows, steps))
    }

    fn predict_rows(&self, rows: &RolloutRows, steps: usize) -> Result<FlowPrediction, NnError> {
        match &self.surroundings {
            Surroundings::Seen(depth) => {
                let seen = self.see_depth(rows, depth)?;
                self.in_small_parts(rows, |rows| self.predict_with_depth(rows, steps, &seen))
            }
            Surroundings::Remembered(scene) if self.sizes.layers.recurrent => {
                self.predict_recurrently(rows, steps, scene)
            }
            Surroundings::Remembered(scene) => {
                let seen = self.see(rows, scene)?;
                self.in_small_parts(rows, |rows| self.predict_directly(rows, steps, scene, &seen))
            }
        }
    }

    /// Without gradients, few of the rollouts of one context at a time; else all together.
    fn in_small_parts(
        &self,
        rows: &RolloutRows,
        predict: impl Fn(&RolloutRows) -> Result<FlowPrediction, NnError> + Sync,
    ) -> Result<FlowPrediction, NnError> {
        if self.is_trained() {
            return predict(rows);
        }
        let firsts = (0..rows.count()).step_by(ROLLOUTS_TOGETHER);
        let parts = firsts.map(|first| first..rows.count().min(first + ROLLOUTS_TOGETHER));
        in_parts(rows, parts.collect(), predict)
    }
}

/// The predictions of parts of the rollouts, joined.
fn in_parts(
    rows: &RolloutRows,
    mut parts: Vec<Range<usize>>,
    predict: impl Fn(&RolloutRows) -> Result<FlowPrediction, NnError> + Sync,
) -> Result<FlowPrediction, NnError> {
    if parts.len() <= 1 {
        return predict(rows);
    }
    let parts = parts.par_drain(..).map(|part| predict(&rows.part(part)));
    let parts = parts.collect::<Result<Vec<FlowPrediction>, NnError>>()?;
    let joined = |of: fn(&FlowPrediction) -> &Tensor| Tensor::cat(&parts.iter().map(of).collect::<Vec<_>>(), 0);
    let if_given = |of: fn(&FlowPrediction) -> Option<&Tensor>| {
        let given: Vec<&Tensor> = parts.iter().filter_map(of).collect();
        (!given.is_empty()).then(|| Tensor::cat(&given, 0)).transpose()
    };
    Ok(FlowPrediction {
        frames: joined(|part| &part.frames)?,
        scene: if_given(|part| part.scene.as_ref())?,
        motion: joined(|part| &part.motion)?,
        movers: if_given(|part| part.movers.as_ref())?,
    })
}
