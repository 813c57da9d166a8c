//! The rollouts of a batch: the window that each follows, with its actions and its state.

use std::ops::Range;
use std::sync::Arc;

use candle_core::{Device, Tensor};

use super::encoder_views::EncoderViews;
use crate::nn::conditioning::{ConditioningTensors, ConditioningValues};
use crate::nn::error::NnError;
use crate::nn::geometry::camera::CameraPose;
use crate::nn::geometry::state_channels::StateChannels;
use crate::nn::spec::ModelSpec;
use crate::nn::tensors::with_values;

/// The rollouts to predict: windows, actions and states in their own units.
pub(super) struct RolloutRows {
    /// Frames of all windows `[B, context, P]`.
    frames: Arc<Vec<f32>>,
    /// The window of each rollout.
    windows: Vec<u32>,
    /// `[N, horizon, A]`; empty without conditioning.
    actions: Vec<f32>,
    /// `[N, S]`; empty without state.
    states: Vec<f32>,
    action_count: usize,
    state_count: usize,
}

impl RolloutRows {
    /// Errors: `Shape`, `Missing` where the conditioning does not fit; `Tensor` if a window does not exist.
    pub(super) fn new(
        spec: &ModelSpec,
        frames: &Tensor,
        windows: &[u32],
        conditioning: &ConditioningTensors,
    ) -> Result<Self, NnError> {
        let count = frames.dim(0)?;
        if let Some(window) = windows.iter().find(|&&window| window as usize >= count) {
            return Err(candle_core::Error::Msg(format!("there is no window {window}; there are {count}")).into());
        }
        let ConditioningValues { actions, states } = conditioning.values(spec, windows.len())?;
        Ok(Self {
            frames: Arc::new(with_values(frames, <[f32]>::to_vec)?),
            windows: windows.to_vec(),
            actions,
            states,
            action_count: spec.action_inputs().unwrap_or(0),
            state_count: spec.state_inputs().unwrap_or(0),
        })
    }

    /// Number of rollouts, N.
    pub(super) fn count(&self) -> usize {
        self.windows.len()
    }

    /// Some of the rollouts.
    pub(super) fn part(&self, range: Range<usize>) -> Self {
        let all = self.count();
        let cut = |values: &[f32]| {
            let each = values.len() / all;
            values[range.start * each..range.end * each].to_vec()
        };
        Self {
            frames: Arc::clone(&self.frames),
            windows: self.windows[range.clone()].to_vec(),
            actions: cut(&self.actions),
            states: cut(&self.states),
            ..*self
        }
    }

    /// The state of a rollout, empty where the model takes none.
    pub(super) fn state(&self, row: usize) -> &[f32] {
        &self.states[row * self.state_count..(row + 1) * self.state_count]
    }

    /// The actions of a rollout, step after step; empty where the model takes none.
    pub(super) fn actions(&self, row: usize) -> &[f32] {
        let each = self.actions.len() / self.count();
        &self.actions[row * each..(row + 1) * each]
    }

    /// Components of an action that the model takes.
    pub(super) fn action_count(&self) -> usize {
        self.action_count
    }

    /// Where the state says that the camera stands at the last frame of a rollout's context.
    pub(super) fn pose(&self, spec: &ModelSpec, row: usize) -> CameraPose {
        StateChannels::of(spec).pose_in(self.state(row))
    }

    /// Where the camera will stand at each step of each rollout.
    pub(super) fn rollout_poses(&self, spec: &ModelSpec, motions: &[[f32; 3]]) -> Vec<CameraPose> {
        let pose = |(item, &motion): (usize, &[f32; 3])| self.pose(spec, item / spec.horizon).moved(motion);
        motions.iter().enumerate().map(pose).collect()
    }

    /// State and all actions of each rollout, scaled, `[N, S + horizon · A]`.
    pub(super) fn scaled(&self, spec: &ModelSpec) -> Result<Tensor, NnError> {
        let rows: Vec<f32> = (0..self.count()).flat_map(|row| self.scaled_row(spec, row)).collect();
        let width = self.state_count + spec.horizon * self.action_count;
        Ok(Tensor::from_vec(rows, (self.count(), width), &Device::Cpu)?)
    }

    /// The scaled state of each rollout.
    pub(super) fn scaled_states(&self, spec: &ModelSpec) -> Vec<Vec<f32>> {
        (0..self.count())
            .map(|row| spec.scaled_state(self.state(row)))
            .collect()
    }

    fn scaled_row(&self, spec: &ModelSpec, row: usize) -> Vec<f32> {
        let state = self.state(row).iter().zip(&spec.states);
        let actions = self.actions(row).iter().zip(spec.actions.iter().cycle());
        state
            .chain(actions)
            .map(|(value, channel)| channel.scaled(*value))
            .collect()
    }

    /// Per item: the scaled state, the scaled actions up to the step (zero after it) and which step it is, `[M, …]`.
    pub(super) fn step_inputs(&self, spec: &ModelSpec) -> Result<Tensor, NnError> {
        let horizon = spec.horizon;
        let width = self.state_count + horizon * self.action_count + horizon;
        let mut values = Vec::with_capacity(self.count() * horizon * width);
        for row in 0..self.count() {
            let scaled = self.scaled_row(spec, row);
            for step in 0..horizon {
                let taken = self.state_count + (step + 1) * self.action_count;
                values.extend(
                    scaled
                        .iter()
                        .enumerate()
                        .map(|(at, value)| if at < taken { *value } else { 0.0 }),
                );
                values.extend((0..horizon).map(|other| f32::from(u8::from(other == step))));
            }
        }
        Ok(Tensor::from_vec(values, (self.count() * horizon, width), &Device::Cpu)?)
    }

    /// The contexts that the rollouts follow, with the last `frames_read` frames of each. Rollouts of one window and state
    /// share one.
    pub(super) fn contexts(&self, spec: &ModelSpec, frames_read: usize) -> EncoderViews {
        let size = spec.image_size();
        let (pixels, context) = (size.pixels(), spec.context);
        let (mut row_of, mut firsts) = (Vec::with_capacity(self.count()), Vec::<usize>::new());
        for row in 0..self.count() {
            let same =
                |&first: &usize| self.windows[first] == self.windows[row] && self.state(first) == self.state(row);
            let known = firsts.last().as_ref().is_some_and(|first| same(first));
            if !known {
                firsts.push(row);
            }
            row_of.push((firsts.len() - 1) as u32);
        }
        let mut views = EncoderViews {
            row_of,
            frames_read,
            last_frames: Vec::with_capacity(firsts.len() * pixels),
            earlier: Vec::new(),
            states: Vec::new(),
            poses: Vec::new(),
        };
        for &row in &firsts {
            let frame = |back: usize| {
                let place = self.windows[row] as usize * context + (context - 1).saturating_sub(back);
                &self.frames[place * pixels..(place + 1) * pixels]
            };
            views.last_frames.extend_from_slice(frame(0));
            for back in 1..frames_read {
                views.earlier.extend_from_slice(frame(back));
            }
            views.states.push(self.state(row).to_vec());
            views.poses.push(self.pose(spec, row));
        }
        views
    }
}
