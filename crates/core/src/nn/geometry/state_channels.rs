//! Which channels of actions and states say how the robot moves and where it is.

use candle_core::{Device, Tensor};

use super::camera::CameraPose;
use super::wheel_dynamics::CommandedSpeeds;
use crate::nn::error::NnError;
use crate::nn::spec::{ChannelScale, ModelSpec};

/// The names of the state's channels that say where the robot is.
pub const POSE_CHANNELS: [&str; 4] = ["x", "y", "heading_cos", "heading_sin"];

/// Which channels say how the robot moves and where it is.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(in crate::nn) struct StateChannels {
    /// x, y, cosine and sine of the heading.
    pub(in crate::nn) pose: Option<[usize; 4]>,
    /// Forward speed and yaw rate in the state.
    measured: [Option<usize>; 2],
    /// Forward speed and yaw rate in the action.
    commanded: [Option<usize>; 2],
}

impl StateChannels {
    /// The channels of a model, by name for the pose, by unit for the speeds.
    pub(in crate::nn) fn of(spec: &ModelSpec) -> Self {
        let by_unit = |channels: &[ChannelScale]| {
            ["m/s", "rad/s"].map(|unit| channels.iter().position(|channel| channel.unit == unit))
        };
        let states: &[ChannelScale] = if spec.state_inputs().is_some() {
            &spec.states
        } else {
            &[]
        };
        let actions: &[ChannelScale] = if spec.action_inputs().is_some() {
            &spec.actions
        } else {
            &[]
        };
        let named = |name: &str| states.iter().position(|channel| channel.name == name);
        let pose = match POSE_CHANNELS.map(named) {
            [Some(x), Some(y), Some(cos), Some(sin)] => Some([x, y, cos, sin]),
            _ => None,
        };
        Self {
            pose,
            measured: by_unit(states),
            commanded: by_unit(actions),
        }
    }

    /// The pose in a state; the origin where states hold none.
    pub(in crate::nn) fn pose_in(self, state: &[f32]) -> CameraPose {
        self.pose
            .map_or_else(CameraPose::default, |[x, y, cos, sin]| CameraPose {
                x: state[x],
                y: state[y],
                heading: state[sin].atan2(state[cos]),
            })
    }

    /// The yaw rate in a state, in radians a second.
    pub(in crate::nn) fn yaw_rate_in(self, state: &[f32]) -> Option<f32> {
        self.measured[1].map(|channel| state[channel])
    }

    /// Forward speed and yaw rate in a state, each if it is measured and known; neither in a state that is not given.
    pub(in crate::nn) fn measured_in(self, state: &[f32]) -> [Option<f32>; 2] {
        self.measured
            .map(|channel| state.get(channel?).copied().filter(|speed| speed.is_finite()))
    }

    /// Forward speed and yaw rate in a state, if both are measured and known.
    pub(in crate::nn) fn measured_speeds_in(self, state: &[f32]) -> Option<[f32; 2]> {
        match self.measured_in(state) {
            [Some(forward), Some(yaw)] => Some([forward, yaw]),
            _ => None,
        }
    }

    /// Whether an action commands a speed that is known.
    pub(in crate::nn) fn commands_speed_in(self, action: &[f32]) -> bool {
        let mut commanded = self.commanded.into_iter().flatten();
        commanded.any(|channel| action.get(channel).is_some_and(|speed| speed.is_finite()))
    }

    /// Moves a state on: its pose by the motion, its speeds to those of the last action. Other channels stay.
    pub(in crate::nn) fn advance(self, state: &mut [f32], motion: [f32; 3], action: &[f32]) {
        if let Some([x, y, cos, sin]) = self.pose {
            let pose = self.pose_in(state).moved(motion);
            state[x] = pose.x;
            state[y] = pose.y;
            (state[sin], state[cos]) = pose.heading.sin_cos();
        }
        for (measured, commanded) in self.measured.into_iter().zip(self.commanded) {
            if let (Some(measured), Some(commanded)) = (measured, commanded)
                && action[commanded].is_finite()
            {
                state[measured] = action[commanded];
            }
        }
    }

    /// Whether the actions command speeds.
    pub(in crate::nn) fn commands_speeds(self) -> bool {
        self.commanded.iter().any(Option::is_some)
    }

    /// The speeds of a rollout that starts with the measured ones. One that is not commanded stays as measured; one that is not
    /// measured starts as commanded. `actions` holds them step after step, `action_count` components each.
    pub(in crate::nn) fn speeds(
        self,
        measured: [Option<f32>; 2],
        actions: &[f32],
        action_count: usize,
    ) -> CommandedSpeeds {
        let commands: Vec<[f32; 2]> = actions
            .chunks_exact(action_count.max(1))
            .map(|action| {
                std::array::from_fn(|part| {
                    let commanded = self.commanded[part].map(|channel| action[channel]);
                    let commanded = commanded.filter(|speed| speed.is_finite());
                    commanded.or(measured[part]).unwrap_or(0.0)
                })
            })
            .collect();
        let first = commands.first().copied().unwrap_or_default();
        CommandedSpeeds {
            start: std::array::from_fn(|part| measured[part].unwrap_or(first[part])),
            commands,
        }
    }
}

impl ModelSpec {
    /// The state's channels whose values count: all that layers read, and the pose where a memory finds its room by it.
    pub(crate) fn states_that_count(&self) -> Vec<usize> {
        if self.remembers_room() {
            return (0..self.state_inputs().unwrap_or(0)).collect();
        }
        self.states_read_by_layers()
    }

    /// The state's channels that layers read: all, but for the pose in the depth form.
    pub(crate) fn states_read_by_layers(&self) -> Vec<usize> {
        let relative = StateChannels::of(self).pose.filter(|_| self.reads_past_states());
        (0..self.state_inputs().unwrap_or(0))
            .filter(|channel| relative.is_none_or(|pose| !pose.contains(channel)))
            .collect()
    }

    /// Where in its room the robot is: x and y in standard deviations of the training, and the heading in radians. `None` if
    /// the model takes no pose, or reads only how poses differ, or if the pose is not known.
    pub(crate) fn absolute_pose(&self, state: &[f32]) -> Option<[f32; 3]> {
        let channels = StateChannels::of(self);
        let [x, y, ..] = channels
            .pose
            .filter(|_| self.remembers_room() || !self.reads_past_states())?;
        let scaled = |channel: usize| self.states[channel].scaled(state[channel]);
        let pose = (state.len() == self.states.len()).then(|| [scaled(x), scaled(y), channels.pose_in(state).heading]);
        pose.filter(|pose| pose.iter().all(|part| part.is_finite()))
    }

    /// A state with its pose counted from another one's, as an odometry that started there has it. `None` where
    /// [`Self::absolute_pose`] is none.
    #[doc(hidden)]
    #[must_use]
    pub fn counted_from(&self, start: &[f32], state: &[f32]) -> Option<Vec<f32>> {
        self.absolute_pose(state)?;
        let channels = StateChannels::of(self);
        let [x, y, cos, sin] = channels.pose?;
        let [yaw, ahead, left] = channels.pose_in(start).motion_to(channels.pose_in(state));
        let mut counted = state.to_vec();
        (counted[x], counted[y]) = (ahead, left);
        (counted[sin], counted[cos]) = yaw.sin_cos();
        Some(counted)
    }

    /// Whether the model estimates from the frames how fast the camera drives, so that states and actions may be missing.
    #[must_use]
    pub fn sees_speeds(&self) -> bool {
        self.flow().is_some_and(|flow| flow.layers.speeds)
    }

    /// Whether the depth form remembers one room, which it finds by the absolute pose.
    pub(in crate::nn) fn remembers_room(&self) -> bool {
        self.flow().is_some_and(|flow| flow.layers.memory)
    }

    /// Whether a memory of one room has what it needs: depth, actions, the camera and the absolute pose.
    pub(in crate::nn) fn can_remember_a_room(&self) -> bool {
        let sees = self
            .flow()
            .is_some_and(|flow| flow.layers.depth && flow.camera.is_some());
        sees && self.action_inputs().is_some() && StateChannels::of(self).pose.is_some()
    }

    /// Whether a prediction uses the states at the context's earlier frames: it says from the poses how the camera has moved.
    #[must_use]
    pub fn reads_past_states(&self) -> bool {
        StateChannels::of(self).pose.is_some() && self.flow().is_some_and(|flow| flow.layers.depth)
    }

    /// Forward speed and yaw rate in each state `[B, S]`: `[B, 2]` in m/s and rad/s, NaN where they are not known. `None` if the states
    /// do not have both.
    #[doc(hidden)]
    pub fn measured_speeds(&self, state: &Tensor) -> Result<Option<Tensor>, NnError> {
        let channels = StateChannels::of(self);
        if channels.measured.iter().any(Option::is_none) {
            return Ok(None);
        }
        let (batch, count) = state.dims2()?;
        let states = state.flatten_all()?.to_vec1::<f32>()?;
        let speeds = |state: &[f32]| channels.measured_in(state).map(|speed| speed.unwrap_or(f32::NAN));
        let speeds: Vec<f32> = states.chunks_exact(count).flat_map(speeds).collect();
        Ok(Some(Tensor::from_vec(speeds, (batch, 2), &Device::Cpu)?))
    }

    /// How the camera moved from the state `[B, S]` to each of the later states `[B, T, S]`: yaw, ahead and left
    /// `[B, T, 3]`, in radians and metres. `None` if the model gets no state or the state has no pose.
    #[doc(hidden)]
    pub fn measured_motion(&self, state: &Tensor, later: &Tensor) -> Result<Option<Tensor>, NnError> {
        let channels = StateChannels::of(self);
        if channels.pose.is_none() {
            return Ok(None);
        }
        let (batch, time, count) = later.dims3()?;
        let (now, later) = (
            state.flatten_all()?.to_vec1::<f32>()?,
            later.flatten_all()?.to_vec1::<f32>()?,
        );
        let windows = now.chunks_exact(count).zip(later.chunks_exact(time * count));
        let motions: Vec<f32> = windows
            .flat_map(|(now, later)| {
                let now = channels.pose_in(now);
                later
                    .chunks_exact(count)
                    .flat_map(move |later| now.motion_to(channels.pose_in(later)))
            })
            .collect();
        Ok(Some(Tensor::from_vec(motions, (batch, time, 3), &Device::Cpu)?))
    }
}
