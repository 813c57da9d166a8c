//! Drives a robot to its goal with two PID controllers: from heading error to angular velocity, from distance to linear
//! velocity.

use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::crossing::Crossing;
use super::pid::Pid;
use super::robot::PlanarPose;
use super::room::Room;
use super::route::Route;
use super::{appearance, arena, robot};

/// A robot has reached its goal at this distance, in metres.
pub(super) const ARRIVAL_M: f32 = 0.1;
/// A new goal is at least this far away, in metres.
const NEXT_GOAL_M: f32 = 0.8;

/// A robot's goal and its controllers.
#[derive(Clone)]
pub(super) struct Navigator {
    goal_m: [f32; 2],
    heading: Pid,
    distance: Pid,
    random: ChaCha8Rng,
    /// `None` unless the robot drives to and fro.
    crossing: Option<Crossing>,
}

impl Navigator {
    pub(super) fn new(route: Route, random: ChaCha8Rng) -> Self {
        Self {
            goal_m: route.goal_m,
            heading: Pid::new(route.gains.heading, robot::MAX_ANGULAR_RAD_S),
            distance: Pid::new(route.gains.distance, route.gains.max_linear_m_s),
            random,
            crossing: route
                .crossing
                .map(|habits| Crossing::new(habits, arena::position(route.pose))),
        }
    }

    /// The next velocity command, [m/s, rad/s]. The robot drives slowly if the goal is not ahead, and never backward. `observer`:
    /// the pose of Tb1, to which a crossing robot may react.
    pub(super) fn command(&mut self, pose: PlanarPose, observer: PlanarPose, dt: f32) -> [f32; 2] {
        if let Some(crossing) = &mut self.crossing
            && crossing.stands(pose, observer, &mut self.random, dt)
        {
            return [0.0, 0.0];
        }
        let distance = arena::distance(arena::position(pose), self.goal_m);
        let bearing = arena::bearing(pose, self.goal_m);
        let angular = self.heading.update(bearing, dt);
        let linear = self.distance.update(distance, dt);
        [linear.max(0.0) * bearing.cos().max(0.0), angular]
    }

    /// Whether a crossing robot turns back now, before it has arrived.
    pub(super) fn turns_back(&mut self, dt: f32) -> bool {
        let crossing = self.crossing.as_ref();
        crossing.is_some_and(|crossing| crossing.turns_back(&mut self.random, dt))
    }

    pub(super) fn has_arrived(&self, pose: PlanarPose) -> bool {
        arena::distance(arena::position(pose), self.goal_m) < ARRIVAL_M
    }

    /// Chooses a new goal: the other end of its way for a crossing robot, else one of the start and goal positions at random; where
    /// the room has obstacles, one that can be reached straight ahead, if there is one.
    pub(super) fn choose_goal(&mut self, room: &Room, pose: PlanarPose) {
        self.heading.reset();
        self.distance.reset();
        if let Some(crossing) = &mut self.crossing {
            std::mem::swap(&mut self.goal_m, &mut crossing.back_m);
            return;
        }
        let here = arena::position(pose);
        let mut positions: Vec<[f32; 2]> = (room.starts_m.into_iter().chain(room.goals_m))
            .filter(|&position| position != self.goal_m && arena::distance(here, position) >= NEXT_GOAL_M)
            .collect();
        if room.checks_ways {
            let is_free = |&position: &[f32; 2]| room.is_way_free(here, position, appearance::TURTLEBOT.radius_m);
            let free: Vec<[f32; 2]> = positions.iter().copied().filter(is_free).collect();
            positions = if free.is_empty() { positions } else { free };
        }
        if let Some(&goal) = positions.get(self.random.random_range(0..positions.len().max(1))) {
            self.goal_m = goal;
        }
    }
}
