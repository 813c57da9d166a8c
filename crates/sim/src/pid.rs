//! A PID controller with limited output and anti-windup.

use serde::{Deserialize, Serialize};

/// The three gains.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct Gains {
    /// Output per unit of error.
    pub proportional: f32,
    /// Output per unit of error and second.
    pub integral: f32,
    /// Output per unit of error a second.
    pub derivative: f32,
}

/// The controller: its gains and its state.
#[derive(Clone, Debug)]
pub struct Pid {
    gains: Gains,
    limit: f32,
    integral: f32,
    last_error: Option<f32>,
}

impl Pid {
    /// A controller in its initial state, with its output limited to ±`limit`.
    #[must_use]
    pub fn new(gains: Gains, limit: f32) -> Self {
        Self {
            gains,
            limit,
            integral: 0.0,
            last_error: None,
        }
    }

    /// Resets the state, for a new goal.
    pub fn reset(&mut self) {
        self.integral = 0.0;
        self.last_error = None;
    }

    /// The output for this error, `dt` seconds after the previous one. Anti-windup: while the output is at its limit, an
    /// error that would increase it further is not integrated.
    pub fn update(&mut self, error: f32, dt: f32) -> f32 {
        let rate = self.last_error.map_or(0.0, |last| (error - last) / dt);
        self.last_error = Some(error);
        let integral = self.integral + error * dt;
        let output = self.gains.proportional * error + self.gains.integral * integral + self.gains.derivative * rate;
        if output.abs() <= self.limit || output * error < 0.0 {
            self.integral = integral;
        }
        output.clamp(-self.limit, self.limit)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const DT: f32 = 1e-3;

    fn gains(proportional: f32, integral: f32, derivative: f32) -> Gains {
        Gains {
            proportional,
            integral,
            derivative,
        }
    }

    /// Positions of the system x' = u, controlled from 0 to 1, every millisecond.
    fn step_response(mut pid: Pid, steps: usize) -> Vec<f32> {
        let mut x = 0.0;
        (0..steps)
            .map(|_| {
                x += pid.update(1.0 - x, DT) * DT;
                x
            })
            .collect()
    }

    #[test]
    fn the_p_step_response_is_exponential() {
        for (step, x) in step_response(Pid::new(gains(2.0, 0.0, 0.0), 100.0), 2000)
            .iter()
            .enumerate()
        {
            let t = (step + 1) as f32 * DT;
            assert!((x - (1.0 - (-2.0 * t).exp())).abs() < 1e-3, "at {t} s: {x}");
        }
    }

    #[test]
    fn the_pi_step_response_is_a_damped_oscillation() {
        // e'' + kp e' + ki e = 0 with e(0) = 1, e'(0) = −kp.
        let (kp, ki) = (1.5f32, 3.0f32);
        let damping = kp / 2.0;
        let omega = (ki - damping * damping).sqrt();
        for (step, x) in step_response(Pid::new(gains(kp, ki, 0.0), 100.0), 4000)
            .iter()
            .enumerate()
        {
            let t = (step + 1) as f32 * DT;
            let error = (-damping * t).exp() * ((omega * t).cos() - damping / omega * (omega * t).sin());
            assert!((1.0 - x - error).abs() < 5e-3, "at {t} s: {x}");
        }
    }

    #[test]
    fn the_pd_step_response_is_a_slower_exponential() {
        // x' = kp e + kd e' with e' = −x' gives e = exp(−kp t / (1 + kd)), from e(0) = 1, because the first update has no rate.
        let (kp, kd) = (2.0f32, 0.5f32);
        for (step, x) in step_response(Pid::new(gains(kp, 0.0, kd), 100.0), 3000)
            .iter()
            .enumerate()
            .skip(20)
        {
            let t = (step + 1) as f32 * DT;
            assert!((1.0 - x - (-kp * t / (1.0 + kd)).exp()).abs() < 3e-3, "at {t} s: {x}");
        }
    }

    #[test]
    fn the_integral_does_not_wind_up_at_the_limit() {
        let mut pid = Pid::new(gains(1.0, 1.0, 0.0), 0.5);
        for _ in 0..10_000 {
            assert_eq!(pid.update(1.0, DT), 0.5);
        }
        // After ten seconds at the limit, the output still follows the error's sign at once.
        assert!(pid.update(-0.1, DT) < -0.09);
    }

    #[test]
    fn the_integral_grows_below_the_limit() {
        let mut pid = Pid::new(gains(0.0, 2.0, 0.0), 1.0);
        let output = (0..250).map(|_| pid.update(1.0, DT)).last().unwrap();
        assert!((output - 0.5).abs() < 1e-4, "{output}");
    }
}
