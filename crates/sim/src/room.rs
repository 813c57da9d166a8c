//! A room: what the camera sees of it, what robots collide with, and where they drive.

use rapier3d::prelude::Vector;

use super::arena;
use super::ray_cast::{Solid, UprightCylinder};
use super::robot::PlanarPose;
use super::surface::{Material, Surface};

/// Share of ambient light in the arena.
const ARENA_AMBIENT: f32 = 0.6;

/// The light of a room.
#[derive(Clone, Copy, Debug)]
pub(super) struct Light {
    /// Direction to the light source, of length 1.
    pub(super) direction: Vector,
    /// Share of ambient light.
    pub(super) ambient: f32,
    /// Factor of all gray values.
    pub(super) brightness: f32,
    /// Standard deviation of the relative change of the exposure from frame to frame.
    pub(super) exposure_std: f32,
}

/// One solid of a piece, at a place of the room.
#[derive(Clone, Debug)]
pub(super) struct Part {
    /// The origin of the solid's own axes, which are parallel to those of the room.
    pub(super) at: Vector,
    pub(super) solid: Solid,
    pub(super) surface: Surface,
}

/// What robots collide with, seen from above.
#[derive(Clone, Copy, Debug)]
pub(super) enum Footprint {
    Disc { center_m: [f32; 2], radius_m: f32 },
    Rectangle { center_m: [f32; 2], half_m: [f32; 2] },
}

impl Footprint {
    /// Distance from a point to the footprint, in metres; 0 inside.
    pub(super) fn distance(&self, point: [f32; 2]) -> f32 {
        match *self {
            Self::Disc { center_m, radius_m } => (arena::distance(center_m, point) - radius_m).max(0.0),
            Self::Rectangle { center_m, half_m } => {
                let outside = |axis: usize| ((point[axis] - center_m[axis]).abs() - half_m[axis]).max(0.0);
                outside(0).hypot(outside(1))
            }
        }
    }

    /// Whether this footprint, enlarged by `margin_m`, overlaps the bounding rectangle of another.
    pub(super) fn is_near(&self, other: &Self, margin_m: f32) -> bool {
        let ([one, one_half], [two, two_half]) = (self.bounds(), other.bounds());
        (0..2).all(|axis| (one[axis] - two[axis]).abs() < one_half[axis] + two_half[axis] + margin_m)
    }

    /// Center and half sides of the bounding rectangle.
    pub(super) fn bounds(&self) -> [[f32; 2]; 2] {
        match *self {
            Self::Disc { center_m, radius_m } => [center_m, [radius_m; 2]],
            Self::Rectangle { center_m, half_m } => [center_m, half_m],
        }
    }

    /// How far a disc of this radius can move straight ahead until it touches the footprint, in metres.
    fn clearance(&self, pose: PlanarPose, radius_m: f32) -> f32 {
        let (sin, cos) = pose.heading_rad.sin_cos();
        match *self {
            Self::Disc {
                center_m,
                radius_m: own,
            } => arena::clearance_of_disc(pose, (sin, cos), center_m, own + radius_m),
            // The rectangle, enlarged by the radius on each side.
            Self::Rectangle { center_m, half_m } => {
                let (mut enter, mut exit) = (f32::NEG_INFINITY, f32::INFINITY);
                for (at, direction, center, half) in [
                    (pose.x_m, cos, center_m[0], half_m[0] + radius_m),
                    (pose.y_m, sin, center_m[1], half_m[1] + radius_m),
                ] {
                    if direction.abs() < 1e-6 {
                        if (at - center).abs() >= half {
                            return f32::INFINITY;
                        }
                        continue;
                    }
                    let (one, two) = ((center - half - at) / direction, (center + half - at) / direction);
                    enter = enter.max(one.min(two));
                    exit = exit.min(one.max(two));
                }
                if enter > exit || exit <= 0.0 {
                    f32::INFINITY
                } else {
                    enter.max(0.0)
                }
            }
        }
    }
}

/// A wall inside the room, a pillar, or a piece of furniture.
#[derive(Clone, Debug)]
pub(super) struct Piece {
    pub(super) parts: Vec<Part>,
    pub(super) footprint: Footprint,
    /// A sphere around all parts.
    pub(super) center: Vector,
    pub(super) reach_m: f32,
}

/// A room.
#[derive(Clone, Debug)]
pub(super) struct Room {
    /// From the wall at x = 0 to the opposite wall, in metres.
    pub(super) length_m: f32,
    /// From the right to the left wall (y is 0 in the middle), in metres.
    pub(super) width_m: f32,
    /// From floor to ceiling, in metres.
    pub(super) height_m: f32,
    /// The surfaces of its six sides. Number of a side: 2 · axis, plus 1 at the far end of the axis.
    pub(super) sides: [Surface; 6],
    pub(super) pieces: Vec<Piece>,
    pub(super) light: Light,
    /// Tb2's start positions, [x, y] in metres.
    pub(super) starts_m: [[f32; 2]; arena::STARTS_M.len()],
    /// Tb2's goal positions, [x, y] in metres.
    pub(super) goals_m: [[f32; 2]; arena::GOALS_M.len()],
    /// Whether robots choose only goals that they can reach on a straight line.
    pub(super) checks_ways: bool,
}

impl Room {
    /// The room of the scenarios where all trials have the same one.
    pub(super) fn arena() -> Self {
        let pillar = |pillar: &arena::Pillar| {
            let [x, y] = pillar.position_m;
            let half = arena::HEIGHT_M / 2.0;
            Piece {
                parts: vec![Part {
                    at: Vector::new(x, y, 0.0),
                    solid: Solid::Cylinder(UprightCylinder {
                        radius: pillar.radius_m,
                        bottom: 0.0,
                        top: arena::HEIGHT_M,
                    }),
                    surface: Surface::Material(Material::plain(pillar.albedo)),
                }],
                footprint: Footprint::Disc {
                    center_m: pillar.position_m,
                    radius_m: pillar.radius_m,
                },
                center: Vector::new(x, y, half),
                reach_m: pillar.radius_m.hypot(half),
            }
        };
        Self {
            length_m: arena::LENGTH_M,
            width_m: arena::WIDTH_M,
            height_m: arena::HEIGHT_M,
            sides: [0, 1, 2, 3, 4, 5].map(Surface::ArenaSide),
            pieces: arena::PILLARS.iter().map(pillar).collect(),
            light: Light {
                direction: Vector::new(-0.45, 0.35, 0.82).normalize(),
                ambient: ARENA_AMBIENT,
                brightness: 1.0,
                exposure_std: 0.0,
            },
            starts_m: arena::STARTS_M,
            goals_m: arena::GOALS_M,
            checks_ways: false,
        }
    }

    /// How far a disc of this radius can move straight ahead until it touches a wall, a piece or one of the `others` (discs of
    /// the same radius), in metres.
    pub(super) fn clearance(&self, pose: PlanarPose, radius_m: f32, others: &[[f32; 2]]) -> f32 {
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
        let half = self.width_m / 2.0;
        let walls = wall(pose.x_m, cos, 0.0, self.length_m).min(wall(pose.y_m, sin, -half, half));
        let pieces = self
            .pieces
            .iter()
            .map(|piece| piece.footprint.clearance(pose, radius_m));
        let robots = (others.iter()).map(|&other| arena::clearance_of_disc(pose, (sin, cos), other, 2.0 * radius_m));
        pieces.chain(robots).fold(walls, f32::min)
    }

    /// Whether a disc of this radius can drive from one point to another on a straight line.
    pub(super) fn is_way_free(&self, from: [f32; 2], to: [f32; 2], radius_m: f32) -> bool {
        let pose = PlanarPose {
            x_m: from[0],
            y_m: from[1],
            heading_rad: (to[1] - from[1]).atan2(to[0] - from[0]),
        };
        self.clearance(pose, radius_m, &[]) >= arena::distance(from, to)
    }

    /// Distance from a point to the nearest wall or piece, in metres; 0 or less inside one.
    pub(super) fn gap_m(&self, [x, y]: [f32; 2]) -> f32 {
        let half = self.width_m / 2.0;
        let walls = x.min(self.length_m - x).min(half - y.abs());
        let pieces = self.pieces.iter().map(|piece| piece.footprint.distance([x, y]));
        pieces.fold(walls, f32::min)
    }

    /// Whether a point is at least this far from every wall and piece.
    pub(super) fn is_clear(&self, [x, y]: [f32; 2], margin_m: f32) -> bool {
        let is_inside = (margin_m..=self.length_m - margin_m).contains(&x) && y.abs() <= self.width_m / 2.0 - margin_m;
        is_inside
            && self
                .pieces
                .iter()
                .all(|piece| piece.footprint.distance([x, y]) >= margin_m)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_way_ends_where_a_footprint_begins() {
        let rectangle = Footprint::Rectangle {
            center_m: [2.0, 0.5],
            half_m: [0.5, 0.25],
        };
        let pose = |heading_rad: f32| PlanarPose {
            x_m: 0.0,
            y_m: 0.5,
            heading_rad,
        };
        assert!((rectangle.clearance(pose(0.0), 0.2) - 1.3).abs() < 1e-5);
        assert_eq!(rectangle.clearance(pose(1.5), 0.2), f32::INFINITY);
        assert_eq!(rectangle.clearance(pose(std::f32::consts::PI), 0.2), f32::INFINITY);
        assert!((rectangle.distance([3.5, 0.5]) - 1.0).abs() < 1e-6);
        let disc = Footprint::Disc {
            center_m: [2.0, 0.5],
            radius_m: 0.3,
        };
        assert!((disc.clearance(pose(0.0), 0.2) - 1.5).abs() < 1e-5);
        assert!(disc.is_near(&rectangle, 0.0));
    }
}
