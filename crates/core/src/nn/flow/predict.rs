//! Predicts the rollouts of a batch with the flow network, in any of its forms, on all threads of the pool that it is called in.
//!
//! What depends only on the context is computed once for all rollouts that follow it. Without gradients, each step is then computed
//! on its own, so that what lies between two layers stays in the processor's cache, many rollouts take no more memory than few, and
//! several threads compute a single one. In the recurrent form, steps follow each other. Threads that have no step of their own take
//! strips of the convolutions of another's.

use std::ops::Range;

use candle_core::{Device, Tensor};
use rayon::prelude::*;

use super::network::{FlowNetwork, FlowPrediction, Surroundings};
use super::rollout_rows::RolloutRows;
use super::steps_ahead::{PredictedAhead, StepsAhead};
use crate::nn::conditioning::ConditioningTensors;
use crate::nn::error::NnError;

/// What a prediction has to give.
#[derive(Clone, Copy, Debug)]
pub(in crate::nn) struct Asked {
    /// The frames of the first steps.
    steps: usize,
    only_frames: bool,
}

impl Asked {
    /// All that the network gives.
    pub(in crate::nn) fn all(steps: usize) -> Self {
        let only_frames = false;
        Self { steps, only_frames }
    }

    /// Without the scene and the movers of each frame.
    pub(in crate::nn) fn frames(steps: usize) -> Self {
        let only_frames = true;
        Self { steps, only_frames }
    }
}

impl FlowNetwork {
    /// What is asked of N rollouts of B windows of frames `[B, context, P]`: rollout n follows window `windows[n]` under row n of the
    /// conditioning. Errors: `Shape`, `Missing`.
    pub(in crate::nn) fn predict(
        &self,
        frames: &Tensor,
        windows: &[u32],
        conditioning: &ConditioningTensors,
        Asked { steps, only_frames }: Asked,
    ) -> Result<FlowPrediction, NnError> {
        let mut rows = RolloutRows::new(&self.spec, frames, windows, conditioning)?;
        rows.only_frames = only_frames;
        if self.is_plain {
            return self.plain_predict(&rows, steps);
        }
        if self.is_trained() {
            return self.predict_rows(&rows, steps);
        }
        // All on threads of the pool, which share the work of a convolution: from another thread, each would be handed over.
        rayon::scope(|_| in_parts(&rows, rows.of_one_context(), |rows| self.predict_rows(rows, steps)))
    }

    fn predict_rows(&self, rows: &RolloutRows, steps: usize) -> Result<FlowPrediction, NnError> {
        match &self.surroundings {
            Surroundings::Seen(depth) => {
                let rows = &self.see_speeds(rows)?;
                let seen = self.see_depth(rows, depth)?;
                let movers = seen.movers.as_ref();
                let predicted = self.in_steps(rows, steps, movers, |ahead| self.predict_with_depth(ahead, &seen))?;
                Ok(FlowPrediction {
                    speeds: rows.seen_speeds().map(|seen| seen.tensor.clone()),
                    ..predicted
                })
            }
            Surroundings::Remembered(scene) if self.sizes.layers.recurrent => {
                self.predict_recurrently(rows, steps, scene)
            }
            Surroundings::Remembered(scene) => {
                let seen = self.see(rows, scene)?;
                self.in_steps(rows, steps, None, |ahead| self.predict_directly(ahead, scene, &seen))
            }
        }
    }

    /// The first `steps` of the rollouts: without gradients, each step on its own; else all together. `movers`: where they are in the
    /// last frames, as logits `[contexts, P]`.
    fn in_steps(
        &self,
        rows: &RolloutRows,
        steps: usize,
        movers: Option<&Tensor>,
        predict: impl Fn(&StepsAhead) -> Result<PredictedAhead, NnError> + Sync,
    ) -> Result<FlowPrediction, NnError> {
        let mut predicted = if self.is_trained() {
            let known = self.known_ahead(rows)?;
            // The scene's own loss is of all steps.
            let computed = if self.sizes.layers.depth {
                steps
            } else {
                self.spec.horizon
            };
            let all = predict(&StepsAhead::new(rows, 0..computed, &known))?;
            let asked = PredictedAhead {
                frames: all.frames.narrow(1, 0, steps)?,
                ..all
            };
            asked.with_motion(known.motion)
        } else {
            in_parts(rows, (0..rows.count()).map(|row| row..row + 1).collect(), |row| {
                let known = self.known_ahead(row)?;
                let each = (0..steps).into_par_iter();
                let parts = each.map(|step| predict(&StepsAhead::new(row, step..step + 1, &known)));
                let parts = parts.collect::<Result<Vec<_>, NnError>>()?;
                Ok(joined_steps(&parts)?.with_motion(known.motion))
            })?
        };
        if let (Some(seen), Some(coming)) = (movers, &predicted.movers) {
            let seen = seen.index_select(&Tensor::new(rows.context_of(), &Device::Cpu)?, 0)?;
            predicted.movers = Some(Tensor::cat(&[&seen.unsqueeze(1)?, coming], 1)?);
        }
        Ok(predicted)
    }
}

/// Steps of the same rollouts, one after another.
fn joined_steps(parts: &[PredictedAhead]) -> Result<PredictedAhead, NnError> {
    Ok(PredictedAhead {
        frames: Tensor::cat(&parts.iter().map(|part| &part.frames).collect::<Vec<_>>(), 1)?,
        scene: joined_if_given(parts, |part| part.scene.as_ref(), 1)?,
        movers: joined_if_given(parts, |part| part.movers.as_ref(), 1)?,
    })
}

/// Tensors of all parts along an axis; `None` where the parts have none.
fn joined_if_given<P>(
    parts: &[P],
    of: impl Fn(&P) -> Option<&Tensor>,
    axis: usize,
) -> candle_core::Result<Option<Tensor>> {
    let given: Vec<&Tensor> = parts.iter().filter_map(of).collect();
    (!given.is_empty()).then(|| Tensor::cat(&given, axis)).transpose()
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
    FlowPrediction::joined(&parts)
}

impl FlowPrediction {
    /// The predictions of parts of the rollouts, one after another.
    pub(super) fn joined(parts: &[Self]) -> Result<Self, NnError> {
        let joined = |of: fn(&Self) -> &Tensor| Tensor::cat(&parts.iter().map(of).collect::<Vec<_>>(), 0);
        Ok(Self {
            frames: joined(|part| &part.frames)?,
            scene: joined_if_given(parts, |part| part.scene.as_ref(), 0)?,
            motion: joined(|part| &part.motion)?,
            movers: joined_if_given(parts, |part| part.movers.as_ref(), 0)?,
            // Parts whose states tell the speeds have none.
            speeds: if parts.iter().all(|part| part.speeds.is_some()) {
                joined_if_given(parts, |part| part.speeds.as_ref(), 0)?
            } else {
                None
            },
        })
    }
}
