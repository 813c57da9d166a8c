//! The room: 5 × 4 m, walls of different gray, some pillars, a soft floor; Tb2's starts and goals.
//!
//! Textures are smooth and wide so that a moving camera's views keep to low frequencies and never alias.

use std::f32::consts::PI;

use super::PlanarPose;
use super::robot::wrap;

/// From the wall behind Tb1 to the far one (x from 0), in metres.
pub const LENGTH_M: f32 = 5.0;
/// From the right wall to the left one (y about 0), in metres.
pub const WIDTH_M: f32 = 4.0;
/// From floor to ceiling, in metres.
pub const HEIGHT_M: f32 = 2.4;

/// Where Tb1 stands in `static-observer`.
pub const OBSERVER: PlanarPose = PlanarPose {
    x_m: 0.3,
    y_m: 0.0,
    heading_rad: 0.0,
};

/// Tb2's 3 starts, [x, y] in metres.
pub const STARTS_M: [[f32; 2]; 3] = [[2.55, 1.1], [3.7, -0.3], [1.75, -0.55]];
/// Tb2's 4 goals, [x, y] in metres.
pub const GOALS_M: [[f32; 2]; 4] = [[1.7, 0.5], [3.6, 1.35], [3.0, -1.3], [2.85, 0.2]];

/// A round column from floor to ceiling.
#[derive(Clone, Copy, Debug)]
pub struct Pillar {
    /// Its middle, [x, y].
    pub position_m: [f32; 2],
    /// Its radius.
    pub radius_m: f32,
    /// Gray, 0…1.
    pub albedo: f32,
}

/// The pillars; none stands on a way from a start or a goal to another.
pub const PILLARS: [Pillar; 4] = [
    Pillar {
        position_m: [4.45, 0.65],
        radius_m: 0.13,
        albedo: 0.78,
    },
    Pillar {
        position_m: [4.3, -1.35],
        radius_m: 0.16,
        albedo: 0.3,
    },
    Pillar {
        position_m: [0.95, 1.45],
        radius_m: 0.13,
        albedo: 0.35,
    },
    Pillar {
        position_m: [1.1, -1.5],
        radius_m: 0.15,
        albedo: 0.75,
    },
];

/// The pose without its heading.
#[must_use]
pub fn position(pose: PlanarPose) -> [f32; 2] {
    [pose.x_m, pose.y_m]
}

/// Distance between two points of the floor, in metres.
#[must_use]
pub fn distance(from: [f32; 2], to: [f32; 2]) -> f32 {
    (to[0] - from[0]).hypot(to[1] - from[1])
}

/// Direction of a point as seen from the pose, in radians to the left of straight ahead.
#[must_use]
pub fn bearing(pose: PlanarPose, to: [f32; 2]) -> f32 {
    wrap((to[1] - pose.y_m).atan2(to[0] - pose.x_m) - pose.heading_rad)
}

/// How far a disc of that radius can go straight ahead before it meets a wall, a pillar or one of the `others`
/// (discs of a robot's size), in metres.
#[must_use]
pub fn clearance(pose: PlanarPose, radius_m: f32, others: &[[f32; 2]]) -> f32 {
    let (sin, cos) = pose.heading_rad.sin_cos();
    let wall = |at: f32, direction: f32, low: f32, high: f32| {
        let edge = if direction > 0.0 {
            high - radius_m
        } else {
            low + radius_m
        };
        if direction.abs() < 1e-6 {
            f32::INFINITY
        } else {
            ((edge - at) / direction).max(0.0)
        }
    };
    let walls = wall(pose.x_m, cos, 0.0, LENGTH_M).min(wall(pose.y_m, sin, -WIDTH_M / 2.0, WIDTH_M / 2.0));
    let pillars = PILLARS.iter().map(|pillar| (pillar.position_m, pillar.radius_m));
    let robots = others.iter().map(|&other| (other, radius_m));
    pillars.chain(robots).fold(walls, |nearest, (middle, radius)| {
        let (x, y) = (middle[0] - pose.x_m, middle[1] - pose.y_m);
        let (ahead, aside) = (x * cos + y * sin, y * cos - x * sin);
        let reach = radius + radius_m;
        if ahead <= 0.0 || aside.abs() >= reach {
            return nearest;
        }
        nearest.min((ahead - (reach * reach - aside * aside).sqrt()).max(0.0))
    })
}

/// Gray of the floor at a point, 0…1: tiles of a metre with soft joints, over slower waves.
pub(super) fn floor_albedo(x: f32, y: f32) -> f32 {
    let tiles = (PI * x).sin() * (PI * (y + 0.5)).sin();
    let wave = (1.1 * x + 0.7 * y).sin() + (0.5 * x - 1.3 * y + 1.0).sin();
    0.56 + 0.11 * tiles * (1.6 - 0.6 * tiles * tiles) + 0.05 * wave
}

/// The room's six sides, numbered as the camera numbers them: 2 · axis, plus 1 at the axis's far end.
pub(super) fn side_albedo(side: u16, x: f32, y: f32, z: f32) -> f32 {
    match side {
        0 => wall_albedo(0.40, y + 2.0, z, 1.3),
        1 => wall_albedo(0.66, y + 2.0, z, 2.9),
        2 => wall_albedo(0.76, x, z, 1.2),
        3 => wall_albedo(0.50, x, z, 3.6),
        4 => floor_albedo(x, y),
        _ => 0.85,
    }
}

/// A wall: slow waves along it, darker towards the floor, and a soft-edged door at `door_m`.
fn wall_albedo(base: f32, along_m: f32, z: f32, door_m: f32) -> f32 {
    let waves = 1.0 + 0.10 * (1.9 * along_m + 4.0 * base).sin();
    let skirting = 1.0 - 0.35 * (1.0 - z / 0.18).clamp(0.0, 1.0);
    let beside = ((along_m - door_m).abs() - 0.32) / 0.16;
    let door = (1.0 - beside.clamp(0.0, 1.0)) * (1.0 - ((z - 1.3) / 0.2).clamp(0.0, 1.0));
    let light = if base > 0.6 { 0.62 } else { 1.45 };
    base * waves * skirting * (1.0 + (light - 1.0) * door)
}
