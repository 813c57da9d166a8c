//! The rollouts of a batch: the window that each follows, with its actions and its state.

use std::ops::Range;
use std::sync::Arc;

use candle_core::{Device, Tensor};

use super::encoder_views::EncoderViews;
use crate::frame::warp::CameraModel;
use crate::nn::conditioning::{ConditioningTensors, ConditioningValues};
use crate::nn::error::NnError;
use crate::nn::geometry::camera::CameraPose;
use crate::nn::geometry::state_channels::StateChannels;
use crate::nn::spec::ModelSpec;
use crate::nn::tensors::with_values;

/// The rollouts to predict: windows, actions and states in their own units.
pub(super) struct RolloutRows<'a> {
    pub(super) spec: &'a ModelSpec,
    /// Frames of all windows `[B, context, P]`.
    frames: Arc<Vec<f32>>,
    /// The window of each rollout.
    windows: Vec<u32>,
    /// `[N, horizon, A]`; empty without conditioning.
    actions: Vec<f32>,
    /// `[N, S]`; empty without state.
    states: Vec<f32>,
    /// `[N, context - 1, S]`; empty where they are not known.
    past_states: Vec<f32>,
    /// The camera of each rollout; empty where the model's counts.
    cameras: Vec<CameraModel>,
    /// The channels of the state that the layers read.
    read: Vec<usize>,
    /// How fast the camera drives and turns, as seen in the frames; `None` where nothing needs it.
    seen_speeds: Option<SeenSpeeds>,
    /// Whether only frames are asked for, neither the scene nor the movers of each.
    pub(super) only_frames: bool,
}

/// Forward speed and yaw rate at the last frame of each rollout's context, as seen in the frames.
#[derive(Clone)]
pub(super) struct SeenSpeeds {
    /// `[N, 2]`, in m/s and rad/s; gradients go to the layers that see them.
    pub(super) tensor: Tensor,
    values: Vec<[f32; 2]>,
}

impl<'a> RolloutRows<'a> {
    /// Errors: `Shape`, `Missing` where the conditioning does not fit; `Tensor` if a window does not exist.
    pub(super) fn new(
        spec: &'a ModelSpec,
        frames: &Tensor,
        windows: &[u32],
        conditioning: &ConditioningTensors,
    ) -> Result<Self, NnError> {
        let count = frames.dim(0)?;
        if let Some(window) = windows.iter().find(|&&window| window as usize >= count) {
            return Err(candle_core::Error::Msg(format!("there is no window {window}; there are {count}")).into());
        }
        let ConditioningValues {
            actions,
            states,
            past_states,
        } = conditioning.values(spec, windows.len())?;
        let estimates_depth = spec.flow().is_some_and(|flow| flow.layers.depth);
        let cameras = if estimates_depth {
            conditioning.cameras.clone()
        } else {
            Vec::new()
        };
        if !(cameras.is_empty() || cameras.len() == windows.len()) {
            let message = format!("{} cameras do not fit {} rollouts", cameras.len(), windows.len());
            return Err(candle_core::Error::Msg(message).into());
        }
        Ok(Self {
            spec,
            frames: Arc::new(with_values(frames, <[f32]>::to_vec)?),
            windows: windows.to_vec(),
            actions,
            states,
            past_states,
            cameras,
            read: spec.states_read_by_layers(),
            seen_speeds: None,
            only_frames: false,
        })
    }

    /// Number of rollouts, N.
    pub(super) fn count(&self) -> usize {
        self.windows.len()
    }

    /// The same rollouts, whose frames show that each context's camera drives and turns that fast `[contexts, 2]`.
    pub(super) fn with_seen_speeds(&self, of_contexts: &Tensor) -> Result<Self, NnError> {
        let context_of = Tensor::new(self.context_of(), of_contexts.device())?;
        let tensor = of_contexts.index_select(&context_of, 0)?;
        let values = tensor
            .detach()
            .to_device(&Device::Cpu)?
            .flatten_all()?
            .to_vec1::<f32>()?;
        let values = values.as_chunks::<2>().0.to_vec();
        Ok(Self {
            seen_speeds: Some(SeenSpeeds { tensor, values }),
            ..self.part(0..self.count())
        })
    }

    /// What [`Self::with_seen_speeds`] gave.
    pub(super) fn seen_speeds(&self) -> Option<&SeenSpeeds> {
        self.seen_speeds.as_ref()
    }

    /// Whether the state of each rollout tells both speeds.
    pub(super) fn all_know_speeds(&self) -> bool {
        let channels = StateChannels::of(self.spec);
        (0..self.count()).all(|row| channels.measured_speeds_in(self.state(row)).is_some())
    }

    /// The speeds that a rollout starts with: measured, else seen.
    pub(super) fn first_speeds(&self, row: usize) -> [Option<f32>; 2] {
        let measured = StateChannels::of(self.spec).measured_in(self.state(row));
        let seen = self.seen_speeds.as_ref().map(|seen| seen.values[row]);
        std::array::from_fn(|part| measured[part].or(seen.map(|seen| seen[part])))
    }

    /// Whether each rollout's states or actions tell a speed.
    pub(super) fn rows_with_known_speeds(&self) -> Vec<bool> {
        let channels = StateChannels::of(self.spec);
        let is_known = |row: usize| {
            let measured = channels.measured_in(self.state(row));
            measured.iter().any(Option::is_some) || channels.commands_speed_in(self.actions(row))
        };
        (0..self.count()).map(is_known).collect()
    }

    /// Some of the rollouts.
    pub(super) fn part(&self, range: Range<usize>) -> Self {
        Self {
            seen_speeds: self.seen_speeds.as_ref().map(|seen| seen.part(range.clone())),
            spec: self.spec,
            frames: Arc::clone(&self.frames),
            windows: self.windows[range.clone()].to_vec(),
            actions: self.of_rows(&self.actions, range.clone()).to_vec(),
            states: self.of_rows(&self.states, range.clone()).to_vec(),
            past_states: self.of_rows(&self.past_states, range.clone()).to_vec(),
            cameras: self.cameras.get(range).unwrap_or_default().to_vec(),
            read: self.read.clone(),
            only_frames: self.only_frames,
        }
    }

    fn of_rows<'v>(&self, values: &'v [f32], range: Range<usize>) -> &'v [f32] {
        let each = values.len() / self.count();
        &values[range.start * each..range.end * each]
    }

    /// The state of a rollout, empty where the model takes none.
    pub(super) fn state(&self, row: usize) -> &[f32] {
        self.of_rows(&self.states, row..row + 1)
    }

    /// The actions of a rollout, step after step; empty where the model takes none.
    pub(super) fn actions(&self, row: usize) -> &[f32] {
        self.of_rows(&self.actions, row..row + 1)
    }

    /// The camera of a rollout; the model's where it has none of its own.
    pub(super) fn camera(&self, row: usize) -> Option<CameraModel> {
        let own = self.cameras.get(row).copied();
        own.or(self.spec.flow().and_then(|flow| flow.camera))
    }

    /// Where the camera stood at a frame of a rollout's context, `back` frames before the last one, as seen from there: yaw,
    /// ahead, left. By the measured poses; else by the speeds at the last frame; else as if it stood.
    pub(super) fn motion_back(&self, row: usize, back: usize) -> [f32; 3] {
        let channels = StateChannels::of(self.spec);
        let (state, past) = (self.state(row), self.of_rows(&self.past_states, row..row + 1));
        // Beyond the context, its first frame repeats.
        let back = back.min(self.spec.context - 1);
        let mut earlier = past.chunks_exact(state.len().max(1));
        let earlier = back.checked_sub(1).and_then(|nth| earlier.nth_back(nth));
        if let (Some(earlier), Some(_)) = (earlier, channels.pose) {
            let motion = self.pose(row).motion_to(channels.pose_in(earlier));
            if motion.iter().all(|part| part.is_finite()) {
                return motion;
            }
        }
        let [forward, yaw_rate] = self.first_speeds(row).map(Option::unwrap_or_default);
        let time = -(self.spec.frame_period_s as f32) * back as f32;
        let (sin, cos) = (yaw_rate * time / 2.0).sin_cos();
        [yaw_rate * time, forward * time * cos, forward * time * sin]
    }

    /// Where the state says that the camera stands at the last frame of a rollout's context.
    pub(super) fn pose(&self, row: usize) -> CameraPose {
        StateChannels::of(self.spec).pose_in(self.state(row))
    }

    /// State and all actions of each rollout, scaled, `[N, S + horizon · A]`; 0 for what is not known.
    pub(super) fn scaled(&self) -> Result<Tensor, NnError> {
        let rows: Vec<f32> = (0..self.count()).flat_map(|row| self.scaled_row(row)).collect();
        Ok(Tensor::from_vec(rows, (self.count(), ()), &Device::Cpu)?)
    }

    fn scaled_row(&self, row: usize) -> Vec<f32> {
        let state = self.spec.scaled_state(self.state(row));
        let mut scaled: Vec<f32> = self.read.iter().map(|&channel| state[channel]).collect();
        let actions = self.actions(row).iter().zip(self.spec.actions.iter().cycle());
        scaled.extend(actions.map(|(value, channel)| channel.scaled(*value)));
        for value in scaled.iter_mut().filter(|value| value.is_nan()) {
            *value = 0.0;
        }
        scaled
    }

    /// Whether anything that the layers read of each rollout's state and actions is known.
    pub(super) fn rows_with_known_inputs(&self) -> Vec<bool> {
        let is_known = |row: usize| {
            let state = self.state(row);
            let read = self.read.iter().map(|&channel| state[channel]);
            read.chain(self.actions(row).iter().copied()).any(f32::is_finite)
        };
        (0..self.count()).map(is_known).collect()
    }

    /// Per item: the scaled state, the scaled actions up to the step (zero after it) and which step it is, `[M, …]`.
    pub(super) fn step_inputs(&self) -> Result<Tensor, NnError> {
        let horizon = self.spec.horizon;
        let mut values = Vec::new();
        for row in 0..self.count() {
            let (scaled, actions) = (self.scaled_row(row), self.actions(row).len());
            for step in 0..horizon {
                let untaken = actions - (step + 1) * (actions / horizon);
                values.extend_from_slice(&scaled[..scaled.len() - untaken]);
                values.extend(std::iter::repeat_n(0.0, untaken));
                values.extend((0..horizon).map(|other| f32::from(u8::from(other == step))));
            }
        }
        Ok(Tensor::from_vec(values, (self.count() * horizon, ()), &Device::Cpu)?)
    }

    /// Whether two rollouts follow the same context.
    fn is_same_context(&self, row: usize, other: usize) -> bool {
        let past = |row: usize| self.of_rows(&self.past_states, row..row + 1);
        // Of values that are not known too, which are NaN.
        let are_same = |a: &[f32], b: &[f32]| a.iter().map(|a| a.to_bits()).eq(b.iter().map(|b| b.to_bits()));
        self.windows[row] == self.windows[other]
            && are_same(self.state(row), self.state(other))
            && are_same(past(row), past(other))
            && self.cameras.get(row) == self.cameras.get(other)
    }

    /// The rollouts in parts that each follow one context.
    pub(super) fn of_one_context(&self) -> Vec<Range<usize>> {
        let mut parts: Vec<Range<usize>> = Vec::new();
        for row in 0..self.count() {
            match parts.last_mut() {
                Some(part) if self.is_same_context(row, row - 1) => part.end = row + 1,
                _ => parts.push(row..row + 1),
            }
        }
        parts
    }

    /// The context of each rollout.
    pub(super) fn context_of(&self) -> Vec<u32> {
        let parts = self.of_one_context().into_iter().zip(0..);
        parts
            .flat_map(|(part, context)| std::iter::repeat_n(context, part.len()))
            .collect()
    }

    /// The contexts that the rollouts follow, with the last `frames_read` frames of each. Rollouts of one window and state
    /// share one.
    pub(super) fn contexts(&self, frames_read: usize) -> EncoderViews<'a> {
        let (pixels, context) = (self.spec.pixels(), self.spec.context);
        let mut views = EncoderViews {
            spec: self.spec,
            frames_read,
            last_frames: Vec::new(),
            earlier: Vec::new(),
            states: Vec::new(),
            poses: Vec::new(),
            motions_back: Vec::new(),
            cameras: Vec::new(),
        };
        for Range { start: row, .. } in self.of_one_context() {
            let frame = |back: usize| {
                let place = self.windows[row] as usize * context + (context - 1).saturating_sub(back);
                &self.frames[place * pixels..(place + 1) * pixels]
            };
            views.last_frames.extend_from_slice(frame(0));
            for back in 1..frames_read {
                views.earlier.extend_from_slice(frame(back));
            }
            views.states.push(self.state(row).to_vec());
            views.poses.push(self.pose(row));
            views
                .motions_back
                .extend((1..frames_read).map(|back| self.motion_back(row, back)));
            views.cameras.push(self.camera(row));
        }
        views
    }
}

impl SeenSpeeds {
    #[expect(clippy::expect_used, reason = "the rows are those of the rollouts")]
    fn part(&self, range: Range<usize>) -> Self {
        let tensor = self.tensor.narrow(0, range.start, range.len());
        Self {
            tensor: tensor.expect("a row that there is not is a bug"),
            values: self.values[range].to_vec(),
        }
    }
}
