//! Where robots will be if each goes on as fast as in the last frame, from their true places.

use super::situation::seen_from;
use super::tracks::{edge, later};
use foreframe_sim::World;

/// The true places of the robots of an episode.
#[derive(Debug, Default)]
pub(super) struct KnownMovers {
    /// A frame ago, in the room; empty before the first frame.
    places: Vec<[f32; 2]>,
}

impl KnownMovers {
    /// Replaces what is expected of movers by where robots get at constant speed. `movers`: now, then after each step, from the
    /// robot. `is_known`: whether something is known of a robot, by its index.
    pub(super) fn extrapolate(
        &mut self,
        movers: &mut [Vec<[f32; 2]>],
        world: &World,
        is_known: &dyn Fn(usize) -> bool,
    ) {
        let places: Vec<[f32; 2]> = world
            .other_robot_poses()
            .iter()
            .map(|pose| [pose.x_m, pose.y_m])
            .collect();
        let pose = world.observer_pose();
        for (places_then, steps) in movers.iter_mut().zip(0u16..) {
            let known = places.iter().enumerate().filter(|(robot, _)| is_known(*robot));
            let robots = known.flat_map(|(robot, &place)| {
                let before = self.places.get(robot).copied().unwrap_or(place);
                let step = [0, 1].map(|axis| place[axis] - before[axis]);
                edge(later(place, step, f32::from(steps)), world.other_robot_radius_m(robot))
            });
            *places_then = robots.map(|place| seen_from(pose, place)).collect();
        }
        self.places = places;
    }
}
