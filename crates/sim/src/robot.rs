//! A robot's pose and its Kobuki base: two driven wheels with limits, and wheel odometry.

use std::f32::consts::{PI, TAU};

use serde::{Deserialize, Serialize};

/// Radius of a driven wheel, in metres.
pub const WHEEL_RADIUS_M: f32 = 0.035;
/// Distance between the driven wheels, in metres.
pub const WHEEL_BASE_M: f32 = 0.23;
/// Highest linear velocity of the base, in m/s.
pub const MAX_LINEAR_M_S: f32 = 0.7;
/// Highest angular velocity of the base, in rad/s (110°/s).
pub const MAX_ANGULAR_RAD_S: f32 = 110.0 * PI / 180.0;
/// Highest acceleration of a wheel's rim, in m/s².
pub const MAX_RIM_ACCELERATION_M_S2: f32 = 1.2;

/// Position and heading of a robot on the floor.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct PlanarPose {
    /// Metres ahead of the arena's back wall.
    pub x_m: f32,
    /// Metres to the left of the arena's middle line.
    pub y_m: f32,
    /// Counter-clockwise from x, in radians.
    pub heading_rad: f32,
}

/// The wheels of one robot: target speeds, current speeds and odometry.
#[derive(Clone, Debug)]
pub struct DifferentialDrive {
    target_rad_s: [f32; 2],
    wheel_rad_s: [f32; 2],
    odometry: PlanarPose,
    /// True radius of each wheel over [`WHEEL_RADIUS_M`], which the odometry assumes.
    radius_factors: [f32; 2],
}

impl DifferentialDrive {
    /// Wheels at rest; the odometry starts at `pose`.
    #[must_use]
    pub fn new(pose: PlanarPose) -> Self {
        Self {
            target_rad_s: [0.0; 2],
            wheel_rad_s: [0.0; 2],
            odometry: pose,
            radius_factors: [1.0; 2],
        }
    }

    /// Lets the odometry start at 0 and drift: the wheels have these radii, relative to the radius that it assumes.
    pub fn set_drift(&mut self, radius_factors: [f32; 2]) {
        self.odometry = PlanarPose {
            x_m: 0.0,
            y_m: 0.0,
            heading_rad: 0.0,
        };
        self.radius_factors = radius_factors;
    }

    /// Sets the target wheel speeds for this body velocity; each component is clamped to the limits of the base.
    pub fn command(&mut self, linear_m_s: f32, angular_rad_s: f32) {
        let linear = linear_m_s.clamp(-MAX_LINEAR_M_S, MAX_LINEAR_M_S);
        let angular = angular_rad_s.clamp(-MAX_ANGULAR_RAD_S, MAX_ANGULAR_RAD_S);
        let turn = angular * WHEEL_BASE_M / 2.0;
        self.target_rad_s = [(linear - turn) / WHEEL_RADIUS_M, (linear + turn) / WHEEL_RADIUS_M];
    }

    /// Turns the wheels for `dt` seconds and updates the odometry.
    pub fn advance(&mut self, dt: f32) {
        let max_change = MAX_RIM_ACCELERATION_M_S2 / WHEEL_RADIUS_M * dt;
        for (speed, target) in self.wheel_rad_s.iter_mut().zip(self.target_rad_s) {
            *speed += (target - *speed).clamp(-max_change, max_change);
        }
        let (linear, angular) = self.measured_velocity();
        self.odometry = roll(self.odometry, linear, angular, dt);
    }

    /// Velocity of a body that rolls without slipping, in m/s and rad/s.
    #[must_use]
    pub fn velocity(&self) -> (f32, f32) {
        let ([left, right], [left_factor, right_factor]) = (self.wheel_rad_s, self.radius_factors);
        body_velocity(
            left * WHEEL_RADIUS_M * left_factor,
            right * WHEEL_RADIUS_M * right_factor,
        )
    }

    /// The velocity that the odometry computes from the wheels' speeds, in m/s and rad/s.
    #[must_use]
    pub fn measured_velocity(&self) -> (f32, f32) {
        let [left, right] = self.wheel_rad_s.map(|speed| speed * WHEEL_RADIUS_M);
        body_velocity(left, right)
    }

    /// The pose estimated from the wheels.
    #[must_use]
    pub fn odometry(&self) -> PlanarPose {
        self.odometry
    }
}

/// Velocity of the body from the speeds of the wheels' rims, in m/s.
fn body_velocity(left: f32, right: f32) -> (f32, f32) {
    (f32::midpoint(left, right), (right - left) / WHEEL_BASE_M)
}

/// The pose after rolling for `dt` seconds at constant wheel speeds: the exact arc of a unicycle. The formula uses the arc's
/// chord, so it also works for a straight line.
#[must_use]
pub fn roll(pose: PlanarPose, linear_m_s: f32, angular_rad_s: f32, dt: f32) -> PlanarPose {
    let [x, y] = mean_velocity(pose.heading_rad, linear_m_s, angular_rad_s, dt);
    PlanarPose {
        x_m: pose.x_m + x * dt,
        y_m: pose.y_m + y * dt,
        heading_rad: wrap(pose.heading_rad + angular_rad_s * dt),
    }
}

/// The constant velocity in x and y that moves along the arc's chord in `dt` seconds.
#[must_use]
pub fn mean_velocity(heading_rad: f32, linear_m_s: f32, angular_rad_s: f32, dt: f32) -> [f32; 2] {
    let half_turn = angular_rad_s * dt / 2.0;
    let chord = if half_turn.abs() < 1e-4 {
        1.0
    } else {
        half_turn.sin() / half_turn
    };
    let (sin, cos) = (heading_rad + half_turn).sin_cos();
    [linear_m_s * chord * cos, linear_m_s * chord * sin]
}

/// The angle in −π…π.
#[must_use]
pub fn wrap(angle_rad: f32) -> f32 {
    (angle_rad + PI).rem_euclid(TAU) - PI
}
