//! Predicts the rollouts of a batch with the flow network, in either of its forms.

use candle_core::Tensor;

use super::network::{FlowNetwork, FlowPrediction, Surroundings};
use super::rollout_rows::RolloutRows;
use crate::nn::conditioning::ConditioningTensors;
use crate::nn::error::NnError;

/// Rollouts that are computed together without gradients, so that many take no more memory than few.
const ROLLOUTS_AT_ONCE: usize = 16;

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
        if rows.count() <= ROLLOUTS_AT_ONCE || self.is_trained() {
            return self.predict_rows(&rows, steps);
        }
        let mut parts = Vec::new();
        for first in (0..rows.count()).step_by(ROLLOUTS_AT_ONCE) {
            let part = rows.part(first..rows.count().min(first + ROLLOUTS_AT_ONCE));
            parts.push(self.predict_rows(&part, steps)?);
        }
        let joined = |of: fn(&FlowPrediction) -> &Tensor| Tensor::cat(&parts.iter().map(of).collect::<Vec<_>>(), 0);
        let scenes: Vec<&Tensor> = parts.iter().filter_map(|part| part.scene.as_ref()).collect();
        Ok(FlowPrediction {
            frames: joined(|part| &part.frames)?,
            scene: (!scenes.is_empty()).then(|| Tensor::cat(&scenes, 0)).transpose()?,
            motion: joined(|part| &part.motion)?,
        })
    }

    fn predict_rows(&self, rows: &RolloutRows, steps: usize) -> Result<FlowPrediction, NnError> {
        match &self.surroundings {
            Surroundings::Seen(depth) => self.predict_with_depth(rows, steps, depth),
            Surroundings::Remembered(scene) if self.sizes.layers.recurrent => {
                self.predict_recurrently(rows, steps, scene)
            }
            Surroundings::Remembered(scene) => self.predict_directly(rows, steps, scene),
        }
    }
}
