//! Tb1's own driver: smooth random commands, mixed with seeking a place or following Tb2, and keeping off obstacles.
//!
//! The random part is an Ornstein–Uhlenbeck process in each command whose memory is shorter than the horizon of a
//! prediction, so the next second can't be told from the past without the actions.

use rand::Rng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use super::{PlanarPose, arena, look};

/// Fastest the driver goes, in metres a second.
pub(super) const CRUISE_M_S: f32 = 0.5;
/// Fastest the driver turns, in radians a second.
pub(super) const TURN_RAD_S: f32 = 0.8;
/// Memory of the random commands, in seconds.
const MEMORY_S: f32 = 0.8;
const LINEAR_STD_M_S: f32 = 0.17;
const ANGULAR_STD_RAD_S: f32 = 0.5;
/// Mean time until another place is sought, in seconds.
const PATIENCE_S: f32 = 3.0;
/// The driver turns away from what is nearer than this, in metres.
const CAUTION_M: f32 = 0.7;
/// And stops before what is nearer than this.
const STOP_M: f32 = 0.12;

/// The driver's mood and aim.
pub(super) struct Driver {
    random: ChaCha8Rng,
    linear: f32,
    angular: f32,
    /// The place sought; Tb2 where there is none.
    place_m: Option<[f32; 2]>,
}

impl Driver {
    pub(super) fn new(mut random: ChaCha8Rng) -> Self {
        let linear = normal(&mut random) * LINEAR_STD_M_S;
        let angular = normal(&mut random) * ANGULAR_STD_RAD_S;
        Self {
            random,
            linear,
            angular,
            place_m: None,
        }
    }

    /// The next command, [m/s, rad/s], for `period` seconds. `others` are the movers' places, Tb2's first.
    pub(super) fn plan(&mut self, pose: PlanarPose, others: &[[f32; 2]], period: f32) -> [f32; 2] {
        self.drift(period);
        let aim = self.aim(pose, others, period);
        let bearing = arena::bearing(pose, aim);
        let linear = (CRUISE_M_S / 2.0 + self.linear) * (0.4 + 0.6 * bearing.cos().max(0.0));
        let angular = (0.8 * bearing).clamp(-0.5, 0.5) + self.angular;
        keep_off(pose, others, [linear, angular])
    }

    fn drift(&mut self, period: f32) {
        let kept = (-period / MEMORY_S).exp();
        let stirred = (1.0 - kept * kept).sqrt();
        self.linear = kept * self.linear + stirred * LINEAR_STD_M_S * normal(&mut self.random);
        self.angular = kept * self.angular + stirred * ANGULAR_STD_RAD_S * normal(&mut self.random);
    }

    /// Where to go: now and then another place, more often Tb2.
    fn aim(&mut self, pose: PlanarPose, others: &[[f32; 2]], period: f32) -> [f32; 2] {
        let reached = self
            .place_m
            .is_some_and(|place| arena::distance(arena::position(pose), place) < 0.4);
        if reached || self.random.random::<f32>() < period / PATIENCE_S {
            let x = self.random.random_range(0.5..arena::LENGTH_M - 0.5);
            let y = self
                .random
                .random_range(0.5 - arena::WIDTH_M / 2.0..arena::WIDTH_M / 2.0 - 0.5);
            self.place_m = self.random.random_bool(0.4).then_some([x, y]);
        }
        self.place_m
            .or(others.first().copied())
            .unwrap_or([arena::LENGTH_M / 2.0, 0.0])
    }
}

/// Slows down before obstacles and turns to the side that is freer.
fn keep_off(pose: PlanarPose, others: &[[f32; 2]], [linear, angular]: [f32; 2]) -> [f32; 2] {
    let free = |aside: f32| {
        let heading_rad = pose.heading_rad + aside;
        arena::clearance(PlanarPose { heading_rad, ..pose }, look::TURTLEBOT.radius_m, others)
    };
    let ahead = free(0.0).min(free(0.35) + 0.1).min(free(-0.35) + 0.1);
    let pace = ((ahead - STOP_M) / (CAUTION_M - STOP_M)).clamp(0.0, 1.0);
    let away = if free(0.8) > free(-0.8) {
        TURN_RAD_S
    } else {
        -TURN_RAD_S
    };
    let angular = angular * pace + away * (1.0 - pace);
    [
        (linear * pace).clamp(0.0, CRUISE_M_S),
        angular.clamp(-TURN_RAD_S, TURN_RAD_S),
    ]
}

fn normal(random: &mut ChaCha8Rng) -> f32 {
    StandardNormal.sample(random)
}
