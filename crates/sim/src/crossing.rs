//! Robots that drive to and fro across the way ahead of Tb1, for the scenario `crossing`.

use std::f32::consts::TAU;
use std::ops::Range;

use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::robot::PlanarPose;
use super::room::Room;
use super::route::{CrossingHabits, PidGains, Route};
use super::{appearance, arena};

/// How many robots cross: trial n has number n modulo 3.
pub(super) const COUNTS: [usize; 3] = [1, 4, 8];
/// Headings of Tb1 that are tried.
const HEADINGS: usize = 16;
/// Lengths of a free way that are tried, in metres.
const WAYS_M: [f32; 5] = [4.0, 3.0, 2.5, 2.0, 1.5];
/// The nearest place where a robot crosses, in metres ahead of Tb1.
const NEAREST_M: f32 = 0.8;
/// How far to each side of the way a robot drives, in metres: as far as it can within these.
const SIDES_M: [f32; 5] = [1.6, 1.3, 1.0, 0.7, 0.5];
/// Greatest angle between a robot's way and the direction across, in radians.
const SLANT_RAD: f32 = 0.5;
/// Highest speed of a robot. One that is as fast as Tb1 comes from 45° aside when they collide, where most cameras do not look.
const SPEED_M_S: Range<f32> = 0.15..0.4;
/// Two robots start at least this far apart, in metres.
const APART_M: f32 = 0.5;
const TRIES: usize = 60;
/// How often a robot with that habit halts or turns back, in 1/s, and for how long it halts, in seconds.
const HALTS_PER_S: f32 = 0.25;
const HALT_S: f32 = 1.0;
const TURNS_PER_S: f32 = 0.15;
/// A robot that reacts stands while Tb1 is nearer than this, in metres, and not farther aside than this, in radians.
const REACTS_M: f32 = 0.75;
const REACTS_RAD: f32 = 1.0;

/// A crossing robot on its way.
#[derive(Clone)]
pub(super) struct Crossing {
    habits: CrossingHabits,
    /// The other end of its way.
    pub(super) back_m: [f32; 2],
    halted_s: f32,
}

impl Crossing {
    pub(super) fn new(habits: CrossingHabits, back_m: [f32; 2]) -> Self {
        Self {
            habits,
            back_m,
            halted_s: 0.0,
        }
    }

    /// Whether it now turns back, after `dt` seconds.
    pub(super) fn turns_back(&self, random: &mut ChaCha8Rng, dt: f32) -> bool {
        self.habits.turns && random.random::<f32>() < TURNS_PER_S * dt
    }

    /// Whether it stands now, for `dt` seconds.
    pub(super) fn stands(&mut self, pose: PlanarPose, observer: PlanarPose, random: &mut ChaCha8Rng, dt: f32) -> bool {
        if self.halted_s > 0.0 {
            self.halted_s -= dt;
            return true;
        }
        if self.habits.halts && random.random::<f32>() < HALTS_PER_S * dt {
            self.halted_s = HALT_S;
        }
        let place = arena::position(observer);
        self.habits.reacts
            && arena::distance(arena::position(pose), place) < REACTS_M
            && arena::bearing(pose, place).abs() < REACTS_RAD
    }
}

/// The heading with the longest free way from a place, and the length of that way, in metres.
pub(super) fn free_heading(room: &Room, place: [f32; 2], random: &mut ChaCha8Rng) -> (f32, f32) {
    let first = random.random_range(0.0..TAU);
    let headings = (0..HEADINGS).map(|nth| first + TAU * nth as f32 / HEADINGS as f32);
    let mut best = (first, 0.0);
    for heading in headings {
        let length = WAYS_M.into_iter().find(|&length| {
            let end = along(place, heading, length);
            room.is_clear(end, appearance::TURTLEBOT.radius_m)
                && room.is_way_free(place, end, appearance::TURTLEBOT.radius_m)
        });
        if let Some(length) = length.filter(|&length| length > best.1) {
            best = (heading, length);
        }
    }
    best
}

/// The route of a robot that crosses the way ahead of an observer; `None` if the room leaves no space for it. `taken`: where
/// others start.
pub(super) fn draw_route(
    room: &Room,
    observer: PlanarPose,
    way_m: f32,
    taken: &[[f32; 2]],
    random: &mut ChaCha8Rng,
) -> Option<Route> {
    let radius = appearance::TURTLEBOT.radius_m;
    for _ in 0..TRIES {
        let middle_m = random.random_range(NEAREST_M..way_m.max(NEAREST_M + 0.1));
        let middle = along(arena::position(observer), observer.heading_rad, middle_m);
        let across = observer.heading_rad + TAU / 4.0 + random.random_range(-SLANT_RAD..SLANT_RAD);
        let side = |heading: f32| {
            let ends = SIDES_M.into_iter().map(|length| along(middle, heading, length));
            ends.into_iter()
                .find(|&end| room.is_clear(end, radius) && room.is_way_free(middle, end, radius))
        };
        let (Some(left), Some(right)) = (side(across), side(across + TAU / 2.0)) else {
            continue;
        };
        let (start, goal) = if random.random_bool(0.5) {
            (left, right)
        } else {
            (right, left)
        };
        if taken.iter().any(|&other| arena::distance(other, start) < APART_M) {
            continue;
        }
        let heading_rad = (goal[1] - start[1]).atan2(goal[0] - start[0]);
        return Some(Route {
            pose: PlanarPose {
                x_m: start[0],
                y_m: start[1],
                heading_rad,
            },
            goal_m: goal,
            gains: PidGains {
                max_linear_m_s: random.random_range(SPEED_M_S),
                ..PidGains::draw(random)
            },
            crossing: Some(CrossingHabits {
                reacts: random.random_bool(0.5),
                halts: random.random_bool(0.3),
                turns: random.random_bool(0.3),
            }),
        });
    }
    None
}

fn along([x, y]: [f32; 2], heading: f32, length: f32) -> [f32; 2] {
    let (sin, cos) = heading.sin_cos();
    [x + length * cos, y + length * sin]
}
