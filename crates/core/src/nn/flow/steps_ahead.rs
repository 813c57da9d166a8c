//! Which predicted frames are computed together: some steps of some rollouts, with what is known of all steps.

use std::ops::Range;

use candle_core::Tensor;

use super::network::{FlowNetwork, FlowPrediction};
use super::rollout_rows::RolloutRows;
use crate::nn::error::NnError;
use crate::nn::geometry::camera::CameraPose;
use crate::nn::tensors::with_values;

/// Steps of rollouts. An item is one step of one rollout; there are M.
pub(super) struct StepsAhead<'a> {
    pub(super) rows: &'a RolloutRows<'a>,
    steps: Range<usize>,
    known: &'a KnownAhead,
}

/// What is known of all steps of rollouts before their frames are computed.
pub(super) struct KnownAhead {
    /// How the camera will have moved since the last frame, `[N, horizon, 3]`.
    pub(super) motion: Tensor,
    /// Scales and shifts of the modulated layers, `[N, horizon, …]`.
    modulation: Tensor,
}

/// What is predicted of steps of rollouts.
pub(super) struct PredictedAhead {
    /// `[N, steps, P]`.
    pub(super) frames: Tensor,
    /// `[N, steps, P]`; `None` where the model remembers no scene.
    pub(super) scene: Option<Tensor>,
    /// Where movers will be, as logits `[N, steps, P]`; `None` where the model does not find movers.
    pub(super) movers: Option<Tensor>,
}

impl FlowNetwork {
    pub(super) fn known_ahead(&self, rows: &RolloutRows) -> Result<KnownAhead, NnError> {
        let motion = self.motion.forward(rows)?;
        let modulation = self.modulate(rows, &motion)?;
        Ok(KnownAhead {
            modulation: modulation.reshape((rows.count(), self.spec.horizon, ()))?,
            motion,
        })
    }
}

impl PredictedAhead {
    /// With how the camera will have moved at all steps, `[N, horizon, 3]`.
    pub(super) fn with_motion(self, motion: Tensor) -> FlowPrediction {
        FlowPrediction {
            frames: self.frames,
            scene: self.scene,
            motion,
            movers: self.movers,
            speeds: None,
        }
    }
}

impl<'a> StepsAhead<'a> {
    pub(super) fn new(rows: &'a RolloutRows<'a>, steps: Range<usize>, known: &'a KnownAhead) -> Self {
        Self { rows, steps, known }
    }

    /// Steps of each rollout.
    pub(super) fn steps(&self) -> usize {
        self.steps.len()
    }

    /// The context of each item.
    pub(super) fn context_of(&self) -> Vec<u32> {
        let of_steps = |&context: &u32| std::iter::repeat_n(context, self.steps.len());
        self.rows.context_of().iter().flat_map(of_steps).collect()
    }

    /// The row of each item's rollout.
    pub(super) fn row_of(&self) -> Vec<usize> {
        let of_steps = |row| std::iter::repeat_n(row, self.steps.len());
        (0..self.rows.count()).flat_map(of_steps).collect()
    }

    /// How the camera will have moved, `[M, 3]`.
    pub(super) fn motion(&self) -> Result<Tensor, NnError> {
        self.of_these_steps(&self.known.motion)
    }

    /// Scales and shifts, `[M, …]`.
    pub(super) fn modulation(&self) -> Result<Tensor, NnError> {
        self.of_these_steps(&self.known.modulation)
    }

    fn of_these_steps(&self, of_all: &Tensor) -> Result<Tensor, NnError> {
        let these = of_all.narrow(1, self.steps.start, self.steps.len())?;
        Ok(these.flatten(0, 1)?)
    }

    /// Where the camera stands at the last frame of each item's context, and where it will stand.
    pub(super) fn poses(&self) -> Result<[Vec<CameraPose>; 2], NnError> {
        let before: Vec<CameraPose> = self.row_of().into_iter().map(|row| self.rows.pose(row)).collect();
        let moved = |motions: &[f32]| {
            let motions = motions.as_chunks::<3>().0;
            before
                .iter()
                .zip(motions)
                .map(|(pose, &motion)| pose.moved(motion))
                .collect()
        };
        let after = with_values(&self.motion()?, moved)?;
        Ok([before, after])
    }
}
