//! Where movers will be if each goes on as fast as in the last frames: what a planner can do without a network that predicts.

use std::f32::consts::TAU;

use super::situation::{in_room, seen_from};
use foreframe_sim::{PlanarPose, World};

/// Places of one mover are not farther apart than this, in metres.
const APART_M: f32 = 0.25;
/// A mover is not farther than this from where it was a frame ago, in metres.
const LONGEST_STEP_M: f32 = 0.4;
/// Places on the edge of a robot.
const EDGE_PLACES: usize = 12;
/// Frames over which a speed is measured.
const FRAMES: usize = 4;

/// The movers of an episode.
#[derive(Debug, Default)]
pub(super) struct MoverTracks {
    /// Of each mover that is seen now: its middle in the last frames, in the room, oldest first.
    tracks: Vec<Vec<[f32; 2]>>,
    /// The true places of all robots a frame ago.
    places: Vec<[f32; 2]>,
}

impl MoverTracks {
    /// Replaces what is expected of movers by where they get at constant speed. `movers`: now, then after each step, as seen by
    /// a robot with that pose.
    pub(super) fn extrapolate(&mut self, movers: &mut [Vec<[f32; 2]>], pose: PlanarPose) {
        let Some((now, later)) = movers.split_first_mut() else {
            return;
        };
        let (sin, cos) = pose.heading_rad.sin_cos();
        let groups = groups(now);
        let mut tracks = Vec::with_capacity(groups.len());
        for group in &groups {
            let middle = in_room(pose, mean(group));
            let before = self.tracks.iter().filter_map(|track| {
                let distance = distance(*track.last()?, middle);
                (distance < LONGEST_STEP_M).then_some((distance, track))
            });
            let nearest = before.min_by(|one, two| one.0.total_cmp(&two.0));
            let mut track = nearest.map_or_else(Vec::new, |(_, track)| track.clone());
            track.push(middle);
            track.drain(..track.len().saturating_sub(FRAMES));
            tracks.push(track);
        }
        for (places, steps) in later.iter_mut().zip(1..) {
            let moved = groups.iter().zip(&tracks).flat_map(|(group, track)| {
                let [x, y] = step(track).map(|part| part * steps as f32);
                // From the room's axes to the robot's.
                let by = [cos * x + sin * y, cos * y - sin * x];
                group.iter().map(move |place| [place[0] + by[0], place[1] + by[1]])
            });
            *places = moved.collect();
        }
        self.tracks = tracks;
    }

    /// The same for the true places of all robots. Their speeds are those of the last frame.
    pub(super) fn extrapolate_true(&mut self, movers: &mut [Vec<[f32; 2]>], world: &World) {
        let places: Vec<[f32; 2]> = world
            .other_robot_poses()
            .iter()
            .map(|pose| [pose.x_m, pose.y_m])
            .collect();
        let pose = world.observer_pose();
        for (places_then, steps) in movers.iter_mut().zip(0u16..) {
            let robots = places.iter().enumerate().flat_map(|(robot, &[x, y])| {
                let [x_before, y_before] = self.places.get(robot).copied().unwrap_or([x, y]);
                let steps = f32::from(steps);
                let middle = [x + steps * (x - x_before), y + steps * (y - y_before)];
                let radius = world.other_robot_radius_m(robot);
                (0..EDGE_PLACES).map(move |nth| {
                    let (sin, cos) = (TAU * nth as f32 / EDGE_PLACES as f32).sin_cos();
                    [middle[0] + radius * cos, middle[1] + radius * sin]
                })
            });
            *places_then = robots.map(|place| seen_from(pose, place)).collect();
        }
        self.places = places;
    }
}

/// How far a mover gets from one frame to the next, in the mean over its track.
fn step(track: &[[f32; 2]]) -> [f32; 2] {
    let (Some(first), Some(last)) = (track.first(), track.last()) else {
        return [0.0; 2];
    };
    let frames = (track.len() - 1).max(1) as f32;
    [0, 1].map(|axis| (last[axis] - first[axis]) / frames)
}

/// The places in groups: those of one mover.
fn groups(places: &[[f32; 2]]) -> Vec<Vec<[f32; 2]>> {
    let mut groups: Vec<Vec<[f32; 2]>> = Vec::new();
    for &place in places {
        let is_near = |group: &Vec<[f32; 2]>| group.iter().any(|&other| distance(other, place) < APART_M);
        let (near, far): (Vec<_>, Vec<_>) = groups.into_iter().partition(is_near);
        groups = far;
        let mut joined: Vec<[f32; 2]> = near.into_iter().flatten().collect();
        joined.push(place);
        groups.push(joined);
    }
    groups
}

fn mean(places: &[[f32; 2]]) -> [f32; 2] {
    [0, 1].map(|axis| places.iter().map(|place| place[axis]).sum::<f32>() / places.len() as f32)
}

fn distance(one: [f32; 2], two: [f32; 2]) -> f32 {
    (one[0] - two[0]).hypot(one[1] - two[1])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn movers_go_on_as_they_went() {
        let mut tracks = MoverTracks::default();
        let pose = |x_m: f32, heading_rad: f32| PlanarPose {
            x_m,
            y_m: 0.0,
            heading_rad,
        };
        // One stands at (2, -1) of the room, one drives from (2, 0) by 0.1 m a frame to the left; the robot drives ahead.
        let seen = |frame: f32| vec![[2.0 - 0.2 * frame, -1.0], [2.0 - 0.2 * frame, 0.1 * frame]];
        for frame in 0..3 {
            let mut movers = vec![seen(frame as f32), Vec::new(), Vec::new()];
            tracks.extrapolate(&mut movers, pose(0.2 * frame as f32, 0.0));
            if frame == 2 {
                let mut last = movers[2].clone();
                last.sort_by(|one, two| one[1].total_cmp(&two[1]));
                for (found, expected) in last.iter().zip([[1.6, -1.0], [1.6, 0.4]]) {
                    assert!(distance(*found, expected) < 1e-5, "{movers:?}");
                }
            }
        }
        // The robot turns to the left: what goes to the left in the room goes ahead for it.
        let mut movers = vec![vec![[0.3, -1.4], [-1.0, -1.4]], Vec::new()];
        tracks.extrapolate(&mut movers, pose(0.6, std::f32::consts::FRAC_PI_2));
        assert!(
            movers[1].iter().any(|&place| distance(place, [0.4, -1.4]) < 1e-5),
            "{movers:?}"
        );
    }

    #[test]
    fn places_of_one_mover_are_one_group() {
        let chain: Vec<[f32; 2]> = (0..10).map(|nth| [1.0, 0.2 * nth as f32]).collect();
        assert_eq!(groups(&chain).len(), 1);
        let mut two = chain.clone();
        two.insert(3, [3.0, 0.0]);
        assert_eq!(groups(&two).len(), 2);
        assert!(groups(&[]).is_empty());
    }
}
