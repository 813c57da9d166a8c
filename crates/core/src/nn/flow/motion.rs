//! How the camera will have moved at each predicted step: the integral of the speeds of a base that follows its commands
//! ([`wheel_dynamics`]), corrected by a small learned network.

use candle_core::{DType, Device, Tensor};
use candle_nn::Module as _;

use super::rollout_rows::RolloutRows;
use crate::nn::error::NnError;
use crate::nn::geometry::state_channels::StateChannels;
use crate::nn::geometry::wheel_dynamics;
use crate::nn::model_tensors::ModelTensors;
use crate::nn::ops::linear::Linear;
use crate::nn::ops::modulation::perceptron;
use crate::nn::ops::sampling::ImageSize;
use crate::nn::precision::Precision;
use crate::nn::spec::{FlowSpec, ModelSpec};

/// Hidden units of the correction.
pub(super) const MOTION_HIDDEN: usize = 64;
/// The tensor of what was learned of the wheels.
pub(super) const WHEELS: &str = "flow.motion.drive";
/// Radians or metres that one unit of the correction stands for.
pub(super) const CORRECTION: f64 = 0.1;
/// Pixels that one unit of the affine map moves the frame's corner, as a share of its side.
pub(super) const AFFINE: f64 = 0.25;

/// The learned part.
#[derive(Clone, Debug)]
pub(super) struct MotionHead {
    pub(super) layers: Option<[Linear; 2]>,
    /// What was learned of the wheels; `None` where no speeds are commanded.
    pub(super) wheels: Option<Tensor>,
    pub(super) affine: Option<Linear>,
    /// Whether the frames show how fast the camera drives where nothing else tells.
    sees_speeds: bool,
}

impl MotionHead {
    pub(super) fn new(spec: &ModelSpec, sizes: &FlowSpec, tensors: &ModelTensors) -> Self {
        let is_moving = spec.action_inputs().is_some();
        let layers = || ["flow.motion.inputs", "flow.motion.output"].map(|name| tensors.linear(name));
        Self {
            layers: is_moving.then(layers),
            wheels: (StateChannels::of(spec).commands_speeds()).then(|| tensors.tensor(WHEELS)),
            sees_speeds: sizes.layers.speeds,
            affine: (is_moving && sizes.camera.is_none() && !sizes.layers.depth).then(|| tensors.linear("flow.affine")),
        }
    }

    /// What was learned of the wheels, as [`wheel_dynamics::integral`] takes it.
    pub(super) fn wheels(&self) -> Option<&Tensor> {
        self.wheels.as_ref()
    }

    /// Packs the layers' weights for prediction.
    pub(super) fn pack(&mut self, precision: Precision) -> Result<(), NnError> {
        for layer in self.layers.iter_mut().flatten().chain(&mut self.affine) {
            layer.pack(precision.at_least_bf16())?;
        }
        Ok(())
    }

    /// Whether anything says how the camera moves.
    pub(super) fn is_moving(&self) -> bool {
        self.layers.is_some() || self.sees_speeds
    }

    /// Yaw, ahead and left since the last frame `[N, horizon, 3]`; zero for a standing camera.
    pub(super) fn forward(&self, rows: &RolloutRows) -> Result<Tensor, NnError> {
        let spec = rows.spec;
        let shape = (rows.count(), spec.horizon, 3);
        let Some(layers) = &self.layers else {
            return seen_ahead(rows, self.unchanged_ahead(rows)?);
        };
        let correction = (perceptron(layers, &rows.scaled()?)?.reshape(shape)? * CORRECTION)?;
        let correction = of_rows(&correction, &rows.rows_with_known_inputs())?;
        Ok((seen_ahead(rows, self.integral(rows)?)? + correction)?)
    }

    /// The motion `[N, horizon, 3]` of a camera of which no action tells, on the CPU: as fast as it is known to drive if the network sees
    /// speeds; else it stands.
    pub(super) fn unchanged_ahead(&self, rows: &RolloutRows) -> Result<Tensor, NnError> {
        let spec = rows.spec;
        if !self.sees_speeds {
            return Ok(Tensor::zeros(
                (rows.count(), spec.horizon, 3),
                DType::F32,
                &Device::Cpu,
            )?);
        }
        let speeds = (0..rows.count()).flat_map(|row| rows.first_speeds(row).map(Option::unwrap_or_default));
        let speeds = Tensor::from_vec(speeds.collect::<Vec<_>>(), (rows.count(), 2), &Device::Cpu)?;
        arcs(&speeds, spec.horizon, spec.frame_period_s)
    }

    /// The motion of a base that follows its commands `[N, horizon, 3]`, on the CPU.
    pub(super) fn integral(&self, rows: &RolloutRows) -> Result<Tensor, NnError> {
        let spec = rows.spec;
        let channels = StateChannels::of(spec);
        let speeds = (0..rows.count())
            .map(|row| channels.speeds(rows.first_speeds(row), rows.actions(row), spec.actions.len()))
            .collect();
        let wheels = match &self.wheels {
            Some(wheels) => wheels.to_device(&Device::Cpu)?,
            None => Tensor::zeros(2, DType::F32, &Device::Cpu)?,
        };
        Ok(wheel_dynamics::integral(&wheels, speeds, spec.frame_period_s)?)
    }

    /// Where each pixel was, `[M, P, 2]`, by a learned affine map of the image; `None` for a standing camera. `own` is each
    /// pixel's place `[1, P, 2]`.
    pub(super) fn affine_places(
        &self,
        size: ImageSize,
        motion: &Tensor,
        own: &Tensor,
    ) -> Result<Option<Tensor>, NnError> {
        let Some(affine) = &self.affine else {
            return Ok(None);
        };
        let (items, pixels) = (motion.dim(0)?, size.pixels());
        let sides = Tensor::new(&[size.width as f32, size.height as f32], &Device::Cpu)?;
        let from_middle = (own.broadcast_div(&sides)? * 2.0)?.affine(1.0, -1.0)?;
        let ones = Tensor::ones((1, pixels, 1), DType::F32, &Device::Cpu)?;
        let basis = Tensor::cat(&[&from_middle, &ones], 2)?;
        let map = (affine.forward(motion)? * AFFINE)?.reshape((items, 3, 2))?;
        let basis = basis.broadcast_as((items, pixels, 3))?.contiguous()?;
        let moved = basis.matmul(&map)?.broadcast_mul(&sides)?;
        Ok(Some(moved.broadcast_add(own)?))
    }
}

/// The motion, and for rollouts of which nothing tells a speed, that of a camera that goes on as fast as the frames show.
pub(super) fn seen_ahead(rows: &RolloutRows, motion: Tensor) -> Result<Tensor, NnError> {
    let known = rows.rows_with_known_speeds();
    let Some(seen) = rows.seen_speeds().filter(|_| !known.iter().all(|known| *known)) else {
        return Ok(motion);
    };
    let unknown: Vec<bool> = known.iter().map(|known| !known).collect();
    let arcs = arcs(&seen.tensor, rows.spec.horizon, rows.spec.frame_period_s)?;
    Ok((of_rows(&motion, &known)? + of_rows(&arcs, &unknown)?)?)
}

/// Those rows of `[N, horizon, 3]`; 0 in the others.
pub(super) fn of_rows(values: &Tensor, rows: &[bool]) -> Result<Tensor, NnError> {
    if rows.iter().all(|row| *row) {
        return Ok(values.clone());
    }
    let factors: Vec<f32> = rows.iter().map(|&row| f32::from(u8::from(row))).collect();
    Ok(values.broadcast_mul(&Tensor::from_vec(factors, (rows.len(), 1, 1), values.device())?)?)
}

/// Yaw, ahead and left `[N, horizon, 3]` of a camera that goes on at these speeds `[N, 2]`, in m/s and rad/s.
fn arcs(speeds: &Tensor, horizon: usize, period_s: f64) -> Result<Tensor, NnError> {
    let times: Vec<f32> = (1..=horizon).map(|step| (step as f64 * period_s) as f32).collect();
    let times = Tensor::from_vec(times, (1, horizon), speeds.device())?;
    let way = speeds.narrow(1, 0, 1)?.broadcast_mul(&times)?;
    let yaw = speeds.narrow(1, 1, 1)?.broadcast_mul(&times)?;
    // The chord of the arc over its length is sin h / h of half the turn, here by its series.
    let half = (&yaw * 0.5)?;
    let squared = half.sqr()?;
    let chord = ((squared.affine(1.0 / 120.0, -1.0 / 6.0)? * &squared)? + 1.0)?;
    let chord = (way * chord)?;
    let (ahead, left) = ((&chord * half.cos()?)?, (&chord * half.sin()?)?);
    Ok(Tensor::stack(&[yaw, ahead, left], 2)?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_camera_that_keeps_its_speeds_drives_an_arc() {
        let speeds = Tensor::new(&[[0.5f32, 1.0], [0.4, 0.0]], &Device::Cpu).unwrap();
        let motion = arcs(&speeds, 5, 0.2).unwrap().to_vec3::<f32>().unwrap();
        // A circle of 0.5 m: after a second, a turn of 1 rad.
        let expected = [1.0, 0.5 * 1f32.sin(), 0.5 * (1.0 - 1f32.cos())];
        for (found, expected) in motion[0][4].iter().zip(expected) {
            assert!((found - expected).abs() < 1e-4, "{motion:?}");
        }
        assert_eq!(motion[1][4][0], 0.0);
        assert!((motion[1][4][1] - 0.4).abs() < 1e-6 && motion[1][4][2] == 0.0);
    }
}
