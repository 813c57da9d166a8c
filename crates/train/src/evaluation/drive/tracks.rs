//! Where movers will be if each goes on as fast as it went: what a planner can do without a network that predicts.

use std::f32::consts::TAU;

use super::situation::{in_axes_of, in_room, seen_from};
use foreframe_sim::PlanarPose;

/// Places of one mover are not farther apart than this, in metres.
const APART_M: f32 = 0.25;
/// A mover is not farther from where it was expected than this and the error of its sighting, in metres.
const GATE_M: f32 = 0.4;
/// The radius that movers are taken to have, in metres.
const RADIUS_M: f32 = 0.2;
/// Places on the edge of a robot.
const EDGE_PLACES: usize = 12;
/// A speed is measured from the sightings up to so long before the last but one, in seconds.
const MEASURED_S: f32 = 1.2;
/// A mover is remembered for so long after it left the picture, in seconds.
const REMEMBERED_S: f32 = 2.5;
/// A mover that is not found in the picture for longer than this is not there, in seconds.
const MISSED_S: f32 = 0.4;
/// Root mean square of a speed along an axis, before anything is measured, in m/s.
const USUAL_SPEED_M_S: f32 = 0.4;
/// How far off a sighting is: at the camera, in metres, and how much more for its squared distance, in metres per square metre.
const ERROR_M: f32 = 0.05;
const ERROR_PER_M2: f32 = 0.05;
/// How much farther off a sighting is if the side of the picture cuts the mover off, in metres.
const CUT_ERROR_M: f32 = 0.15;
/// A mover that reaches this near to the side of the picture may go on beyond it, in radians.
const SIDE_RAD: f32 = 0.04;

/// From where, and when, movers are seen.
#[derive(Clone, Copy, Debug)]
pub(super) struct Viewpoint {
    /// The robot's pose in the room.
    pub(super) pose: PlanarPose,
    /// From the middle of the picture to its side, in radians. The tilt of the camera is left out.
    pub(super) view_rad: f32,
    /// From one frame to the next, in seconds.
    pub(super) period_s: f32,
}

/// Where a mover was seen.
#[derive(Clone, Copy, Debug)]
struct Sighting {
    /// In seconds from now: negative, as it is past.
    time_s: f32,
    /// Its middle, in the room.
    middle: [f32; 2],
    error_m: f32,
}

/// One mover.
#[derive(Debug)]
struct Track {
    /// Oldest first; never empty.
    sightings: Vec<Sighting>,
    /// What is seen of it now, from the robot; empty if nothing is.
    shown: Vec<[f32; 2]>,
}

impl Track {
    fn new(sighting: Sighting, shown: Vec<[f32; 2]>) -> Self {
        Self {
            sightings: vec![sighting],
            shown,
        }
    }

    /// When it was seen last.
    fn last_s(&self) -> f32 {
        self.sightings.last().map_or(f32::NEG_INFINITY, |last| last.time_s)
    }

    fn age(&mut self, seconds: f32) {
        for sighting in &mut self.sightings {
            sighting.time_s -= seconds;
        }
        let oldest_s = self.last_s() - MEASURED_S;
        self.sightings.retain(|sighting| sighting.time_s >= oldest_s);
        self.shown.clear();
    }

    /// Where its middle is now, in the room, and its speed: the line that fits the sightings best. With few sightings, it is
    /// slower than they are.
    fn now(&self) -> ([f32; 2], [f32; 2]) {
        let last_s = self.last_s();
        // Sums of weights, of weighted times and of their squares; the last holds what is known of speeds beforehand.
        let mut sums = [0.0, 0.0, USUAL_SPEED_M_S.powi(-2)];
        let mut middles = [[0.0_f32; 2]; 2];
        for sighting in &self.sightings {
            let (weight, time_s) = (sighting.error_m.powi(-2), sighting.time_s - last_s);
            for (sum, power) in sums.iter_mut().zip([1.0, time_s, time_s * time_s]) {
                *sum += weight * power;
            }
            for (sum, part) in middles.iter_mut().zip(sighting.middle) {
                *sum = [sum[0] + weight * part, sum[1] + weight * time_s * part];
            }
        }
        let [weights, times, squares] = sums;
        let divisor = weights * squares - times * times;
        let speed = middles.map(|[plain, timed]| (weights * timed - times * plain) / divisor);
        let place = middles.map(|[plain, timed]| (squares * plain - times * timed) / divisor);
        (later(place, speed, -last_s), speed)
    }
}

/// The movers of an episode.
#[derive(Debug, Default)]
pub(super) struct MoverTracks {
    tracks: Vec<Track>,
}

impl MoverTracks {
    /// Replaces what is expected of movers by where they get at constant speed, also those that have left the picture.
    /// `movers`: now, then after each step, from the robot.
    pub(super) fn extrapolate(&mut self, movers: &mut [Vec<[f32; 2]>], from: Viewpoint) {
        if let Some(now) = movers.first() {
            self.see(now, from);
        }
        for (places, step) in movers.iter_mut().zip(0u16..) {
            let seconds = f32::from(step) * from.period_s;
            places.clear();
            for track in &self.tracks {
                let (now, speed) = track.now();
                if track.shown.is_empty() {
                    let edge = edge(later(now, speed, seconds), RADIUS_M);
                    places.extend(edge.map(|place| seen_from(from.pose, place)));
                } else {
                    let speed = in_axes_of(from.pose, speed);
                    places.extend(track.shown.iter().map(|&place| later(place, speed, seconds)));
                }
            }
        }
    }

    /// Takes what is seen of movers now.
    fn see(&mut self, places: &[[f32; 2]], from: Viewpoint) {
        for track in &mut self.tracks {
            track.age(from.period_s);
        }
        for group in groups(places) {
            let sighting = sighting(&group, from);
            let gate_m = GATE_M + sighting.error_m;
            let unseen = self.tracks.iter_mut().filter(|track| track.shown.is_empty());
            let near = unseen.map(|track| (distance(track.now().0, sighting.middle), track));
            let nearest = near
                .filter(|(distance_m, _)| *distance_m < gate_m)
                .min_by(|one, two| one.0.total_cmp(&two.0));
            if let Some((_, track)) = nearest {
                track.sightings.push(sighting);
                track.shown = group;
            } else {
                self.tracks.push(Track::new(sighting, group));
            }
        }
        self.tracks.retain(|track| {
            let [ahead, left] = seen_from(from.pose, track.now().0);
            let is_in_view = left.atan2(ahead).abs() < from.view_rad;
            -track.last_s() <= if is_in_view { MISSED_S } else { REMEMBERED_S }
        });
    }
}

pub(super) fn later(place: [f32; 2], speed: [f32; 2], seconds: f32) -> [f32; 2] {
    [0, 1].map(|axis| place[axis] + speed[axis] * seconds)
}

/// Places on the edge of a robot.
pub(super) fn edge(middle: [f32; 2], radius_m: f32) -> impl Iterator<Item = [f32; 2]> {
    (0..EDGE_PLACES).map(move |nth| {
        let (sin, cos) = (TAU * nth as f32 / EDGE_PLACES as f32).sin_cos();
        [middle[0] + radius_m * cos, middle[1] + radius_m * sin]
    })
}

/// What the places of a mover tell of its middle. One that the side of the picture cuts off goes on beyond it.
fn sighting(group: &[[f32; 2]], from: Viewpoint) -> Sighting {
    let [ahead, left] = mean(group);
    let (range_m, bearing) = (ahead.hypot(left), left.atan2(ahead));
    let bearings = group.iter().map(|place| place[1].atan2(place[0]));
    let (right, left) = bearings.fold((bearing, bearing), |(right, left), one| (right.min(one), left.max(one)));
    let half = (RADIUS_M / range_m.max(RADIUS_M)).asin();
    let is_cut = (right < SIDE_RAD - from.view_rad, left > from.view_rad - SIDE_RAD);
    let bearing = match is_cut {
        (true, false) => bearing.min(left - half),
        (false, true) => bearing.max(right + half),
        _ => bearing,
    };
    let cut_error_m = if is_cut == (false, false) { 0.0 } else { CUT_ERROR_M };
    Sighting {
        time_s: 0.0,
        middle: in_room(from.pose, [range_m * bearing.cos(), range_m * bearing.sin()]),
        error_m: ERROR_M + ERROR_PER_M2 * range_m * range_m + cut_error_m,
    }
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

    fn from(x_m: f32, heading_rad: f32) -> Viewpoint {
        Viewpoint {
            pose: PlanarPose {
                x_m,
                y_m: 0.0,
                heading_rad,
            },
            view_rad: 0.6,
            period_s: 0.2,
        }
    }

    /// What a camera finds of a mover with that middle.
    fn places([ahead, left]: [f32; 2]) -> Vec<[f32; 2]> {
        (-2..=2).map(|nth| [ahead, left + 0.08 * nth as f32]).collect()
    }

    #[test]
    fn movers_go_on_as_they_went() {
        let mut tracks = MoverTracks::default();
        // As the robot has them at first: one stands at (2, -0.7), one drives from (2, 0) by 0.08 m a frame to the left. The robot
        // drives ahead, to where y grows in the room.
        for frame in 0..6 {
            let ahead = 2.0 - 0.1 * frame as f32;
            let now = [places([ahead, -0.7]), places([ahead, 0.08 * frame as f32])].concat();
            let mut movers = vec![now, Vec::new(), Vec::new()];
            let mut viewpoint = from(0.0, std::f32::consts::FRAC_PI_2);
            viewpoint.pose.y_m = 0.1 * frame as f32;
            tracks.extrapolate(&mut movers, viewpoint);
            if frame == 5 {
                let (standing, driving) = movers[2].split_at(5);
                assert!(distance(mean(standing), [1.5, -0.7]) < 0.03, "{movers:?}");
                assert!(distance(mean(driving), [1.5, 0.56]) < 0.06, "{movers:?}");
            }
        }
    }

    #[test]
    fn a_mover_that_left_the_picture_is_remembered_for_a_while() {
        let mut tracks = MoverTracks::default();
        // It drives to the left by 0.1 m a frame, until the robot turns away.
        for frame in 0..4 {
            let mut movers = vec![places([1.0, 0.1 * frame as f32])];
            tracks.extrapolate(&mut movers, from(0.0, 0.0));
        }
        let away = from(0.0, -1.2);
        let mut remembered = 0;
        for frame in 4..30 {
            let mut movers = vec![Vec::new(), Vec::new()];
            tracks.extrapolate(&mut movers, away);
            if movers[0].is_empty() {
                break;
            }
            remembered += 1;
            let middle = in_room(away.pose, mean(&movers[0]));
            assert!(
                distance(middle, [1.0, 0.1 * frame as f32]) < 0.1 * (frame - 3) as f32,
                "{frame}: {middle:?}"
            );
        }
        assert_eq!(remembered, 12);
    }

    #[test]
    fn one_that_is_in_the_picture_and_not_found_is_forgotten() {
        let mut tracks = MoverTracks::default();
        tracks.extrapolate(&mut [places([1.0, 0.0])], from(0.0, 0.0));
        let mut found = [true; 4];
        for is_found in &mut found {
            let mut movers = vec![Vec::new()];
            tracks.extrapolate(&mut movers, from(0.0, 0.0));
            *is_found = !movers[0].is_empty();
        }
        assert_eq!(found, [true, true, false, false]);
    }

    #[test]
    fn one_that_the_side_cuts_off_goes_on_beyond_it() {
        let whole = sighting(&places([1.0, 0.0]), from(0.0, 0.0));
        assert!(distance(whole.middle, [1.0, 0.0]) < 1e-3 && whole.error_m < 0.11);
        // Of a mover around (1.0, 0.68), the picture shows the right part; of another, the left part.
        for side in [1.0, -1.0] {
            let shown = [0.5, 0.58, 0.66].map(|left| [1.0, side * left]);
            let cut = sighting(&shown, from(0.0, 0.0));
            assert!(side * cut.middle[1] > 0.64 && cut.error_m > 0.2, "{cut:?}");
        }
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
