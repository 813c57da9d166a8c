//! Drives a mover to its goal with two PID controllers: heading error to angular, distance to linear velocity.

use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::pid::Pid;
use super::scenario::Route;
use super::{PlanarPose, arena, robot};

/// A mover is at its goal within this distance, in metres.
pub(super) const ARRIVAL_M: f32 = 0.1;
/// The next goal of an unending drive is at least this far, in metres.
const NEXT_GOAL_M: f32 = 0.8;

/// A mover's goal and its controllers.
pub(super) struct Navigator {
    goal_m: [f32; 2],
    heading: Pid,
    distance: Pid,
    random: ChaCha8Rng,
}

impl Navigator {
    pub(super) fn new(route: Route, random: ChaCha8Rng) -> Self {
        Self {
            goal_m: route.goal_m,
            heading: Pid::new(route.gains.heading, robot::MAX_ANGULAR_RAD_S),
            distance: Pid::new(route.gains.distance, route.gains.max_linear_m_s),
            random,
        }
    }

    /// What the wheels are told next, [m/s, rad/s]. It slows down where the goal is not ahead, and never backs up.
    pub(super) fn command(&mut self, pose: PlanarPose, dt: f32) -> [f32; 2] {
        let away = arena::distance(arena::position(pose), self.goal_m);
        let bearing = arena::bearing(pose, self.goal_m);
        let angular = self.heading.update(bearing, dt);
        let linear = self.distance.update(away, dt);
        [linear.max(0.0) * bearing.cos().max(0.0), angular]
    }

    pub(super) fn has_arrived(&self, pose: PlanarPose) -> bool {
        arena::distance(arena::position(pose), self.goal_m) < ARRIVAL_M
    }

    /// Draws another of the starts and goals to go to.
    pub(super) fn choose_goal(&mut self, pose: PlanarPose) {
        let places: Vec<[f32; 2]> = arena::STARTS_M
            .into_iter()
            .chain(arena::GOALS_M)
            .filter(|&place| place != self.goal_m && arena::distance(arena::position(pose), place) >= NEXT_GOAL_M)
            .collect();
        if let Some(&goal) = places.get(self.random.random_range(0..places.len().max(1))) {
            self.goal_m = goal;
        }
        self.heading.reset();
        self.distance.reset();
    }
}
