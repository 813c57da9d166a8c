//! How a base with two driven wheels follows commanded speeds: each wheel changes its speed at a limited acceleration. The
//! wheels' distance and the acceleration are learned; then the motion is the integral of the speeds.

use candle_core::{Result, Shape, Tensor};

use super::camera::CameraPose;
use crate::nn::fused::{FusedOperation, Operand, apply};

/// Half the distance between the wheels before anything is learned, in metres.
const HALF_TRACK_M: f64 = 0.15;
/// The wheels' largest acceleration before anything is learned, in m/s².
const ACCELERATION_M_S2: f64 = 2.0;
/// Largest logarithm of a learned value's ratio to its first value.
const MAX_LOGARITHM: f64 = 6.0;
/// Step of the finite differences.
const DIFFERENCE: f64 = 1e-3;

/// The forward speed in m/s and the yaw rate in rad/s.
type Speeds = [f32; 2];

/// The speeds of a rollout.
#[derive(Clone, Debug)]
pub(in crate::nn) struct CommandedSpeeds {
    /// At the last frame.
    pub(in crate::nn) start: Speeds,
    /// Commanded in each step.
    pub(in crate::nn) commands: Vec<Speeds>,
}

/// Yaw, ahead and left since the last frame `[N, horizon, 3]`, in radians and metres, for N rollouts of `horizon` steps of
/// `period_s`. `wheels` `[2]` holds the logarithms of both learned values, relative to their first ones.
pub(in crate::nn) fn integral(wheels: &Tensor, rollouts: Vec<CommandedSpeeds>, period_s: f64) -> Result<Tensor> {
    apply(WheelIntegral { rollouts, period_s }, [wheels])
}

struct WheelIntegral {
    rollouts: Vec<CommandedSpeeds>,
    period_s: f64,
}

impl WheelIntegral {
    /// The motions of all rollouts, for the logarithms in `learned`.
    fn motions(&self, learned: [f64; 2]) -> Vec<f32> {
        let [half_track, acceleration] = learned.map(|logarithm| logarithm.clamp(-MAX_LOGARITHM, MAX_LOGARITHM).exp());
        let (half_track, acceleration) = (HALF_TRACK_M * half_track, ACCELERATION_M_S2 * acceleration);
        let wheels = |[ahead, turn]: Speeds| {
            let (ahead, turn) = (f64::from(ahead), f64::from(turn));
            [ahead - turn * half_track, ahead + turn * half_track]
        };
        let mut motions = Vec::new();
        for rollout in &self.rollouts {
            let mut speeds = wheels(rollout.start);
            let mut pose = CameraPose::default();
            for &command in &rollout.commands {
                let mut means = [0.0; 2];
                for ((mean, speed), target) in means.iter_mut().zip(&mut speeds).zip(wheels(command)) {
                    *mean = mean_speed(speed, target, acceleration, self.period_s);
                }
                let ahead = f64::midpoint(means[0], means[1]) * self.period_s;
                let turn = (means[1] - means[0]) / (2.0 * half_track) * self.period_s;
                let (sin, cos) = (turn / 2.0).sin_cos();
                pose = pose.moved([turn as f32, (ahead * cos) as f32, (ahead * sin) as f32]);
                // Headings are not wrapped, so the pose relative to the first is the motion.
                motions.extend([pose.heading, pose.x, pose.y]);
            }
        }
        motions
    }
}

/// The mean speed of a wheel over a step towards its target; `speed` becomes that at the step's end.
fn mean_speed(speed: &mut f64, target: f64, acceleration: f64, period_s: f64) -> f64 {
    let difference = target - *speed;
    let change = difference.abs().min(acceleration * period_s);
    let lost = change * (2.0 * difference.abs() - change) / (2.0 * acceleration * period_s);
    *speed += change * difference.signum();
    target - lost * difference.signum()
}

fn parameters(wheels: Operand) -> [f64; 2] {
    std::array::from_fn(|index| f64::from(wheels.values[index]))
}

impl FusedOperation<1> for WheelIntegral {
    const NAME: &'static str = "wheel-integral";

    fn forward(&self, [wheels]: [Operand; 1]) -> Result<(Vec<f32>, Shape)> {
        let motions = self.motions(parameters(wheels));
        let count = self.rollouts.len();
        let steps = motions.len() / 3 / count.max(1);
        Ok((motions, Shape::from((count, steps, 3))))
    }

    fn backward(&self, [wheels]: [Operand; 1], _motion: Operand, gradient: Operand) -> Result<[Option<Vec<f32>>; 1]> {
        let slopes = [0, 1].map(|index| {
            let shifted = |by: f64| {
                let mut learned = parameters(wheels);
                learned[index] += by;
                self.motions(learned)
            };
            let pairs = shifted(DIFFERENCE).into_iter().zip(shifted(-DIFFERENCE));
            let slope = pairs
                .zip(gradient.values)
                .map(|((more, less), gradient)| f64::from(more - less) / (2.0 * DIFFERENCE) * f64::from(*gradient));
            slope.sum::<f64>() as f32
        });
        Ok([Some(slopes.to_vec())])
    }
}

#[cfg(test)]
mod tests {
    use candle_core::Device;

    use super::*;
    use crate::nn::gradient_check::assert_gradients;

    const PERIOD_S: f64 = 0.2;

    fn rollout(start: Speeds, commands: &[Speeds]) -> CommandedSpeeds {
        CommandedSpeeds {
            start,
            commands: commands.to_vec(),
        }
    }

    /// The logarithms for this distance between the wheels and this acceleration.
    fn wheels(track_m: f64, acceleration: f64) -> Tensor {
        let values = [
            (track_m / 2.0 / HALF_TRACK_M).ln(),
            (acceleration / ACCELERATION_M_S2).ln(),
        ];
        Tensor::new(&values.map(|value| value as f32), &Device::Cpu).unwrap()
    }

    #[test]
    fn the_simulated_base_moves_as_computed() {
        use foreframe_sim::robot::{DifferentialDrive, MAX_RIM_ACCELERATION_M_S2, WHEEL_BASE_M};
        let commands = [[0.4, 0.8], [0.5, -0.6], [0.1, 0.0], [0.3, 0.9], [0.0, -1.2]];
        let mut base = DifferentialDrive::new(foreframe_sim::PlanarPose {
            x_m: 0.0,
            y_m: 0.0,
            heading_rad: 0.0,
        });
        let learned = wheels(f64::from(WHEEL_BASE_M), f64::from(MAX_RIM_ACCELERATION_M_S2));
        let motions = integral(&learned, vec![rollout([0.0, 0.0], &commands)], PERIOD_S).unwrap();
        let motions: Vec<f32> = motions.flatten_all().unwrap().to_vec1().unwrap();
        for (command, motion) in commands.iter().zip(motions.chunks_exact(3)) {
            base.command(command[0], command[1]);
            for _ in 0..1000 {
                base.advance(2e-4);
            }
            let truth = base.odometry();
            for (computed, truth) in motion.iter().zip([truth.heading_rad, truth.x_m, truth.y_m]) {
                assert!((computed - truth).abs() < 2e-3, "{motion:?}, {truth:?}");
            }
        }
    }

    #[test]
    fn without_a_change_of_speed_the_robot_drives_an_arc() {
        let still = rollout([0.5, 1.0], &[[0.5, 1.0]]);
        let motion = integral(&wheels(0.3, 2.0), vec![still], PERIOD_S).unwrap();
        let motion: Vec<f32> = motion.flatten_all().unwrap().to_vec1().unwrap();
        let (sin, cos) = 0.1f32.sin_cos();
        for (computed, expected) in motion.iter().zip([0.2, 0.1 * cos, 0.1 * sin]) {
            assert!((computed - expected).abs() < 1e-6, "{motion:?}");
        }
    }

    #[test]
    fn gradients_are_those_of_finite_differences() {
        let rollouts = vec![
            rollout([0.0, 0.0], &[[0.4, 0.8], [0.5, -0.6], [0.1, 0.0]]),
            rollout([0.5, -1.0], &[[0.5, 1.0], [0.0, 0.0], [0.7, 0.3]]),
        ];
        assert_gradients(&[wheels(0.25, 1.3)], 1e-2, |inputs| {
            integral(&inputs[0], rollouts.clone(), PERIOD_S)
        });
    }
}
