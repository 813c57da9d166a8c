//! How the camera will have moved at each predicted step: the integral of the speeds of a [`drive`](super::drive) that
//! follows its commands, corrected by a small learned network.

use candle_core::{DType, Device, Tensor};

use super::dense::Dense;
use super::drive::{self, CommandedSpeeds};
use super::flow::Layers;
use super::flow_inputs::FutureRows;
use super::modulation::silu;
use super::rays::CameraPose;
use super::{ChannelScale, ModelSpec, NnError};

/// Hidden units of the correction.
pub(super) const MOTION_HIDDEN: usize = 64;
/// The tensor of the drive's learned values.
pub(super) const DRIVE: &str = "flow.motion.drive";
/// Radians or metres that one unit of the correction stands for.
const CORRECTION: f64 = 0.1;
/// Pixels that one unit of the affine map moves the frame's corner, as a share of its side.
const AFFINE: f64 = 0.25;

/// Which channels say how the robot moves and where it is.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct StateChannels {
    /// x, y, cosine and sine of the heading.
    pub(super) pose: Option<[usize; 4]>,
    /// Forward speed and yaw rate in the state.
    measured: [Option<usize>; 2],
    /// Forward speed and yaw rate in the action.
    commanded: [Option<usize>; 2],
}

impl StateChannels {
    /// The channels of a model, by name for the pose, by unit for the speeds.
    pub(super) fn of(spec: &ModelSpec) -> Self {
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
        let pose = match ["x", "y", "heading_cos", "heading_sin"].map(named) {
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
    pub(super) fn pose_in(self, state: &[f32]) -> CameraPose {
        self.pose
            .map_or_else(CameraPose::default, |[x, y, cos, sin]| CameraPose {
                x: state[x],
                y: state[y],
                heading: state[sin].atan2(state[cos]),
            })
    }

    /// The yaw rate in a state, in radians a second.
    pub(super) fn yaw_rate_in(self, state: &[f32]) -> Option<f32> {
        self.measured[1].map(|channel| state[channel])
    }

    /// Moves a state on: its pose by the motion, its speeds to those of the last action. Other channels stay.
    pub(super) fn advance(self, state: &mut [f32], motion: [f32; 3], action: &[f32]) {
        if let Some([x, y, cos, sin]) = self.pose {
            let pose = self.pose_in(state).moved(motion);
            state[x] = pose.x;
            state[y] = pose.y;
            (state[sin], state[cos]) = pose.heading.sin_cos();
        }
        for (measured, commanded) in self.measured.into_iter().zip(self.commanded) {
            if let (Some(measured), Some(commanded)) = (measured, commanded) {
                state[measured] = action[commanded];
            }
        }
    }

    /// Whether the actions command speeds.
    pub(super) fn commands_speeds(self) -> bool {
        self.commanded.iter().any(Option::is_some)
    }

    /// The speeds of a future. One that is not commanded stays as measured; one that is not measured starts as commanded.
    fn speeds(self, rows: &FutureRows, row: usize) -> CommandedSpeeds {
        let (state, actions) = (rows.state(row), rows.actions(row));
        let measured = self.measured.map(|channel| channel.map(|channel| state[channel]));
        let commands: Vec<[f32; 2]> = actions
            .chunks_exact(rows.action_count().max(1))
            .map(|action| {
                std::array::from_fn(|part| {
                    let commanded = self.commanded[part].map(|channel| action[channel]);
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

/// The learned part.
#[derive(Clone, Debug)]
pub(super) struct MotionHead {
    layers: Option<[Dense; 2]>,
    /// What was learned of the wheels; `None` where no speeds are commanded.
    drive: Option<Tensor>,
    affine: Option<Dense>,
}

impl MotionHead {
    pub(super) fn new(spec: &ModelSpec, find: &dyn Layers) -> Result<Self, NnError> {
        let is_moving = spec.action_inputs().is_some();
        let layers = || Ok::<_, NnError>([find.dense("flow.motion.inputs")?, find.dense("flow.motion.output")?]);
        Ok(Self {
            layers: is_moving.then(layers).transpose()?,
            drive: (StateChannels::of(spec).commands_speeds())
                .then(|| find.tensor(DRIVE))
                .transpose()?,
            affine: (is_moving && spec.camera.is_none())
                .then(|| find.dense("flow.affine"))
                .transpose()?,
        })
    }

    /// Whether anything says how the camera moves.
    pub(super) fn is_moving(&self) -> bool {
        self.layers.is_some()
    }

    /// Yaw, ahead and left since the last frame `[N, horizon, 3]`; zero for a standing camera.
    pub(super) fn forward(&self, spec: &ModelSpec, rows: &FutureRows) -> Result<Tensor, NnError> {
        let shape = (rows.count(), spec.horizon, 3);
        let Some([inputs, output]) = &self.layers else {
            return Ok(Tensor::zeros(shape, DType::F32, &Device::Cpu)?);
        };
        let channels = StateChannels::of(spec);
        let speeds = (0..rows.count()).map(|row| channels.speeds(rows, row)).collect();
        let plain = match &self.drive {
            Some(drive) => drive::integral(drive, speeds, spec.frame_period_s)?,
            None => drive::integral(
                &Tensor::zeros(2, DType::F32, &Device::Cpu)?,
                speeds,
                spec.frame_period_s,
            )?,
        };
        let correction = output.forward(&silu(&inputs.forward(&rows.scaled(spec)?)?)?)?;
        Ok((plain + (correction.reshape(shape)? * CORRECTION)?)?)
    }

    /// Where each pixel was, `[M, P, 2]`, by a learned affine map of the image; `None` for a standing camera. `own` is each
    /// pixel's place `[1, P, 2]`.
    pub(super) fn affine_places(
        &self,
        spec: &ModelSpec,
        motion: &Tensor,
        own: &Tensor,
    ) -> Result<Option<Tensor>, NnError> {
        let Some(affine) = &self.affine else {
            return Ok(None);
        };
        let size = spec.image_size();
        let (items, pixels) = (motion.dim(0)?, size.pixels());
        let sides = Tensor::new(&[size.width as f32, size.height as f32], &Device::Cpu)?;
        let from_middle = (own.broadcast_div(&sides)? * 2.0)?.affine(1.0, -1.0)?;
        let basis = Tensor::cat(
            &[&from_middle, &Tensor::ones((1, pixels, 1), DType::F32, &Device::Cpu)?],
            2,
        )?;
        let map = (affine.forward(motion)? * AFFINE)?.reshape((items, 3, 2))?;
        let basis = basis.broadcast_as((items, pixels, 3))?.contiguous()?;
        let moved = basis.matmul(&map)?.broadcast_mul(&sides)?;
        Ok(Some(moved.broadcast_add(own)?))
    }
}
