//! The room: 5 × 4 m, walls with different gray values, some pillars, a smooth floor texture; Tb2's starts and goals.
//!
//! Textures have only low spatial frequencies, so that the images of a moving camera have no aliasing.

use std::f32::consts::PI;

use super::robot::{PlanarPose, wrap};

/// From the wall behind Tb1 to the opposite wall (x starts at 0), in metres.
pub const LENGTH_M: f32 = 5.0;
/// From the right wall to the left wall (y is 0 in the middle), in metres.
pub const WIDTH_M: f32 = 4.0;
/// From floor to ceiling, in metres.
pub const HEIGHT_M: f32 = 2.4;

/// Tb1's pose in `static-observer`.
pub const OBSERVER: PlanarPose = PlanarPose {
    x_m: 0.3,
    y_m: 0.0,
    heading_rad: 0.0,
};

/// Tb2's 3 start positions, [x, y] in metres.
pub const STARTS_M: [[f32; 2]; 3] = [[2.5, 0.95], [3.5, -0.3], [1.75, -0.5]];
/// Tb2's 4 goal positions, [x, y] in metres.
pub const GOALS_M: [[f32; 2]; 4] = [[1.65, 0.4], [3.4, 1.25], [2.9, -1.15], [2.7, 0.05]];

/// A round column from floor to ceiling.
#[derive(Clone, Copy, Debug)]
pub struct Pillar {
    /// Its center, [x, y].
    pub position_m: [f32; 2],
    /// Its radius.
    pub radius_m: f32,
    /// Gray value, 0…1.
    pub albedo: f32,
}

/// The pillars. None stands between two start or goal positions.
pub const PILLARS: [Pillar; 4] = [
    pillar([4.45, 0.65], 0.13, 0.78),
    pillar([4.3, -1.35], 0.16, 0.3),
    pillar([0.95, 1.45], 0.13, 0.35),
    pillar([1.1, -1.5], 0.15, 0.75),
];

const fn pillar(position_m: [f32; 2], radius_m: f32, albedo: f32) -> Pillar {
    Pillar {
        position_m,
        radius_m,
        albedo,
    }
}

/// The position of the pose, without the heading.
#[must_use]
pub fn position(pose: PlanarPose) -> [f32; 2] {
    [pose.x_m, pose.y_m]
}

/// Distance between two points of the floor, in metres.
#[must_use]
pub fn distance(from: [f32; 2], to: [f32; 2]) -> f32 {
    (to[0] - from[0]).hypot(to[1] - from[1])
}

/// Direction to a point as seen from the pose, in radians; positive to the left.
#[must_use]
pub fn bearing(pose: PlanarPose, to: [f32; 2]) -> f32 {
    wrap((to[1] - pose.y_m).atan2(to[0] - pose.x_m) - pose.heading_rad)
}

/// How far the middle of a disc can move straight ahead, in the direction (sin, cos), until its distance from `center` is
/// `reach`, in metres.
pub(super) fn clearance_of_disc(pose: PlanarPose, (sin, cos): (f32, f32), center: [f32; 2], reach: f32) -> f32 {
    let (x, y) = (center[0] - pose.x_m, center[1] - pose.y_m);
    let (ahead, aside) = (x * cos + y * sin, y * cos - x * sin);
    if ahead <= 0.0 || aside.abs() >= reach {
        return f32::INFINITY;
    }
    (ahead - (reach * reach - aside * aside).sqrt()).max(0.0)
}

/// Gray value of the floor at a point, 0…1: tiles of one metre with smooth joints, plus longer waves.
pub(super) fn floor_albedo(x: f32, y: f32) -> f32 {
    let tiles = (PI * x).sin() * (PI * (y + 0.5)).sin();
    let wave = (1.1 * x + 0.7 * y).sin() + (0.5 * x - 1.3 * y + 1.0).sin();
    0.56 + 0.11 * tiles * (1.6 - 0.6 * tiles * tiles) + 0.05 * wave
}

/// Gray value of the room's six sides. Number of a side: 2 · axis, plus 1 at the far end of the axis.
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

/// Gray value of a wall: long waves along it, darker near the floor, and a door with smooth edges at `door_m`.
fn wall_albedo(base: f32, along_m: f32, z: f32, door_m: f32) -> f32 {
    let waves = 1.0 + 0.10 * (1.9 * along_m + 4.0 * base).sin();
    let skirting = 1.0 - 0.35 * (1.0 - z / 0.18).clamp(0.0, 1.0);
    let beside = ((along_m - door_m).abs() - 0.32) / 0.16;
    let door = (1.0 - beside.clamp(0.0, 1.0)) * (1.0 - ((z - 1.3) / 0.2).clamp(0.0, 1.0));
    let light = if base > 0.6 { 0.7 } else { 1.45 };
    base * waves * skirting * (1.0 + (light - 1.0) * door)
}
