//! The answer of the inference thread.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::past_errors::PastErrors;
use super::task::Features;
use crate::frame::Frame;
use crate::nn::Occupancy;
use crate::registry::Manifest;
use crate::registry::calibration::ExpectedError;

/// The answer to a [`super::Task`]: what was predicted, and how long it took.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct Prediction {
    /// The manifest of the model that predicted.
    pub manifest: Arc<Manifest>,
    /// The features of the task's frames, in order.
    #[doc(hidden)]
    pub features: Vec<Features>,
    /// The errors of the session, with its frame and this prediction.
    pub(super) past_errors: PastErrors,
    /// One rollout for each conditioning input of the task, in order. A [`super::PredictionInput`] has one.
    pub rollouts: Vec<Rollout>,
    /// What stands around the robot, and where movers will be while it stops; `None` if the task did not ask, or the model
    /// estimates no depth.
    #[doc(hidden)]
    pub occupancy: Option<Occupancy>,
    /// What of the input the model does not use, and actions and states out of the range of the training.
    pub warnings: Vec<String>,
    /// How long it took.
    pub timing: Timing,
}

impl Prediction {
    /// For each predicted frame of a rollout, whether it is beyond the model's horizon; empty if none is.
    #[must_use]
    pub fn beyond_training(&self) -> Vec<bool> {
        let frames = self.rollouts.first().map_or(0, |rollout| rollout.frames.len());
        let horizon = self.manifest.spec.horizon;
        if frames <= horizon {
            return Vec::new();
        }
        (0..frames).map(|step| step >= horizon).collect()
    }

    /// Scales the expected errors by those of the session so far. `frames`: those of the task; in a session it is one.
    pub(super) fn follow_past_errors(&mut self, frames: &[Frame]) {
        if let [frame] = frames {
            self.past_errors.observe(frame);
            let predicted = self.rollouts.first();
            let predicted = predicted.map(|rollout| (rollout.frames.as_slice(), rollout.errors.as_slice()));
            let (frames, errors) = predicted.unwrap_or_default();
            self.past_errors.keep(frames, errors);
        }
        for rollout in &mut self.rollouts {
            rollout.errors = self.past_errors.scaled(std::mem::take(&mut rollout.errors));
        }
    }

    /// Adds the answer to the next part of the task.
    pub(super) fn append(&mut self, mut part: Self) {
        self.features.append(&mut part.features);
        self.rollouts.append(&mut part.rollouts);
        self.occupancy = self.occupancy.take().or(part.occupancy);
        self.timing.queue_us += part.timing.queue_us;
        self.timing.compute_us += part.timing.compute_us;
    }
}

/// How long a prediction took.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct Timing {
    /// Microseconds in the queue.
    pub queue_us: u64,
    /// Microseconds of computation, of the whole batch.
    pub compute_us: u64,
}

/// The frames predicted under one plan.
#[derive(Clone, Debug, Default, PartialEq)]
#[non_exhaustive]
pub struct Rollout {
    /// t+1, t+2, …
    pub frames: Vec<Frame>,
    /// The errors to expect of the frames up to the model's horizon; empty if the model is not calibrated.
    pub errors: Vec<ExpectedError>,
    /// How unlike the training data frames, state and actions are, 0…1: the share of validation contexts that are nearer to it;
    /// `None` if the model is not calibrated.
    pub novelty: Option<f32>,
}

impl Rollout {
    /// The error to expect of each frame that the calibration covers.
    #[must_use]
    pub fn expected_mse(&self) -> Vec<f32> {
        self.errors.iter().map(|error| error.mse).collect()
    }

    /// The lower and the upper end of each 90 % band.
    #[must_use]
    pub fn mse_bands(&self) -> Vec<[f32; 2]> {
        self.errors.iter().map(|error| [error.low, error.high]).collect()
    }
}
