//! A Kobuki base: two driven wheels with limits, and the odometry that counts their turns.

use std::f32::consts::{PI, TAU};

use super::PlanarPose;

/// Radius of a driven wheel, in metres.
pub const WHEEL_RADIUS_M: f32 = 0.035;
/// Distance between the driven wheels, in metres.
pub const WHEEL_BASE_M: f32 = 0.23;
/// Fastest the base drives, in metres a second.
pub const MAX_LINEAR_M_S: f32 = 0.7;
/// Fastest the base turns, in radians a second (110° a second).
pub const MAX_ANGULAR_RAD_S: f32 = 110.0 * PI / 180.0;
/// Fastest a wheel changes its speed at the rim, in metres a second squared.
pub const MAX_RIM_ACCELERATION_M_S2: f32 = 1.2;

/// The wheels of one robot: what they are told, how fast they turn, and where they think they are.
#[derive(Clone, Debug)]
pub struct DifferentialDrive {
    target_rad_s: [f32; 2],
    wheel_rad_s: [f32; 2],
    odometry: PlanarPose,
}

impl DifferentialDrive {
    /// Wheels at rest; odometry begins at `pose`.
    #[must_use]
    pub fn new(pose: PlanarPose) -> Self {
        Self {
            target_rad_s: [0.0; 2],
            wheel_rad_s: [0.0; 2],
            odometry: pose,
        }
    }

    /// Wheel speeds for that body velocity, each part clamped to the base's limits.
    pub fn command(&mut self, linear_m_s: f32, angular_rad_s: f32) {
        let linear = linear_m_s.clamp(-MAX_LINEAR_M_S, MAX_LINEAR_M_S);
        let angular = angular_rad_s.clamp(-MAX_ANGULAR_RAD_S, MAX_ANGULAR_RAD_S);
        let turn = angular * WHEEL_BASE_M / 2.0;
        self.target_rad_s = [(linear - turn) / WHEEL_RADIUS_M, (linear + turn) / WHEEL_RADIUS_M];
    }

    /// Turns the wheels for `dt` seconds and counts the way in the odometry.
    pub fn advance(&mut self, dt: f32) {
        let most = MAX_RIM_ACCELERATION_M_S2 / WHEEL_RADIUS_M * dt;
        for (speed, target) in self.wheel_rad_s.iter_mut().zip(self.target_rad_s) {
            *speed += (target - *speed).clamp(-most, most);
        }
        let (linear, angular) = self.velocity();
        self.odometry = roll(self.odometry, linear, angular, dt);
    }

    /// Velocity of a body that rolls without slipping: metres and radians a second.
    #[must_use]
    pub fn velocity(&self) -> (f32, f32) {
        let [left, right] = self.wheel_rad_s.map(|speed| speed * WHEEL_RADIUS_M);
        (f32::midpoint(left, right), (right - left) / WHEEL_BASE_M)
    }

    /// Where the turns of the wheels say the robot is.
    #[must_use]
    pub fn odometry(&self) -> PlanarPose {
        self.odometry
    }
}

/// The pose after rolling for `dt` seconds at constant wheel speeds: the exact arc of a unicycle, written with its chord
/// so that it also holds for a straight line.
#[must_use]
pub fn roll(pose: PlanarPose, linear_m_s: f32, angular_rad_s: f32, dt: f32) -> PlanarPose {
    let [x, y] = mean_velocity(pose.heading_rad, linear_m_s, angular_rad_s, dt);
    PlanarPose {
        x_m: pose.x_m + x * dt,
        y_m: pose.y_m + y * dt,
        heading_rad: wrap(pose.heading_rad + angular_rad_s * dt),
    }
}

/// The constant velocity in x and y that goes along the arc's chord in `dt` seconds.
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
