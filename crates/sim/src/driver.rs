//! Tb1's built-in driving policy: smooth random commands, plus steering to a target point or to Tb2, plus avoiding obstacles.
//!
//! The random part of each command is an Ornstein–Uhlenbeck process. Its correlation time is shorter than a prediction's
//! horizon, so a model cannot predict the next second from the past without the actions.

use rand::Rng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use super::robot::PlanarPose;
use super::room::Room;
use super::{appearance, arena};

/// Highest speed of the driver, in m/s.
pub(super) const CRUISE_M_S: f32 = 0.5;
/// Highest turn rate of the driver, in rad/s.
pub(super) const TURN_RAD_S: f32 = 0.8;
/// Correlation time of the random commands, in seconds.
const CORRELATION_TIME_S: f32 = 0.8;
const LINEAR_STD_M_S: f32 = 0.17;
const ANGULAR_STD_RAD_S: f32 = 0.45;
/// Mean time until the driver chooses another target, in seconds.
const MEAN_TARGET_TIME_S: f32 = 3.0;
/// The driver slows down and turns away from obstacles nearer than this, in metres.
const SLOW_DOWN_M: f32 = 0.8;
/// The driver stops before obstacles nearer than this, in metres.
const STOP_M: f32 = 0.2;

/// The driver: its random command components and its target.
pub(super) struct Driver {
    random: ChaCha8Rng,
    linear: f32,
    angular: f32,
    /// The target point; none to follow Tb2.
    target_m: Option<[f32; 2]>,
}

impl Driver {
    pub(super) fn new(mut random: ChaCha8Rng) -> Self {
        let linear = normal(&mut random) * LINEAR_STD_M_S;
        let angular = normal(&mut random) * ANGULAR_STD_RAD_S;
        Self {
            random,
            linear,
            angular,
            target_m: None,
        }
    }

    /// The next command, [m/s, rad/s], for `period` seconds. `others` are the positions of the other robots, Tb2 first.
    pub(super) fn plan(&mut self, room: &Room, pose: PlanarPose, others: &[[f32; 2]], period: f32) -> [f32; 2] {
        self.update_random_commands(period);
        let target = self.target(room, pose, others, period);
        let bearing = arena::bearing(pose, target);
        let linear = (CRUISE_M_S / 2.0 + self.linear) * (0.4 + 0.6 * bearing.cos().max(0.0));
        let angular = (1.2 * bearing).clamp(-0.6, 0.6) + self.angular;
        avoid_obstacles(room, pose, others, [linear, angular])
    }

    fn update_random_commands(&mut self, period: f32) {
        let decay = (-period / CORRELATION_TIME_S).exp();
        let noise = (1.0 - decay * decay).sqrt();
        self.linear = decay * self.linear + noise * LINEAR_STD_M_S * normal(&mut self.random);
        self.angular = decay * self.angular + noise * ANGULAR_STD_RAD_S * normal(&mut self.random);
    }

    /// The point to drive to: mostly Tb2, sometimes a random point of the room.
    fn target(&mut self, room: &Room, pose: PlanarPose, others: &[[f32; 2]], period: f32) -> [f32; 2] {
        let reached = self
            .target_m
            .is_some_and(|target| arena::distance(arena::position(pose), target) < 0.4);
        if reached || self.random.random::<f32>() < period / MEAN_TARGET_TIME_S {
            let x = self.random.random_range(0.5..room.length_m - 0.5);
            let y = self
                .random
                .random_range(0.5 - room.width_m / 2.0..room.width_m / 2.0 - 0.5);
            self.target_m = self.random.random_bool(0.25).then_some([x, y]);
        }
        self.target_m
            .or(others.first().copied())
            .unwrap_or([room.length_m / 2.0, 0.0])
    }
}

/// Slows down before obstacles and turns to the side with more free space.
fn avoid_obstacles(room: &Room, pose: PlanarPose, others: &[[f32; 2]], [linear, angular]: [f32; 2]) -> [f32; 2] {
    let clearance = |angle: f32| {
        let heading_rad = pose.heading_rad + angle;
        room.clearance(
            PlanarPose { heading_rad, ..pose },
            appearance::TURTLEBOT.radius_m,
            others,
        )
    };
    let ahead = clearance(0.0).min(clearance(0.35) + 0.1).min(clearance(-0.35) + 0.1);
    let speed_factor = ((ahead - STOP_M) / (SLOW_DOWN_M - STOP_M)).clamp(0.0, 1.0);
    let turn_away = if clearance(0.8) > clearance(-0.8) {
        TURN_RAD_S
    } else {
        -TURN_RAD_S
    };
    let angular = angular * speed_factor + turn_away * (1.0 - speed_factor);
    [
        (linear * speed_factor).clamp(0.0, CRUISE_M_S),
        angular.clamp(-TURN_RAD_S, TURN_RAD_S),
    ]
}

fn normal(random: &mut ChaCha8Rng) -> f32 {
    StandardNormal.sample(random)
}
