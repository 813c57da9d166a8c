//! Appearance of the robots: each consists of a few upright cylinders and boxes.

use super::ray_cast::{Solid, UprightCylinder};

/// A solid with its gray value, 0…1.
pub(super) struct ShadedSolid {
    pub(super) solid: Solid,
    pub(super) albedo: f32,
}

/// The shape of a robot.
pub(super) struct RobotAppearance {
    /// Radius of the round base, which is what collides with other things.
    pub(super) radius_m: f32,
    pub(super) height_m: f32,
    pub(super) parts: &'static [ShadedSolid],
}

const fn cylinder(radius: f32, bottom: f32, top: f32, albedo: f32) -> ShadedSolid {
    ShadedSolid {
        solid: Solid::Cylinder(UprightCylinder { radius, bottom, top }),
        albedo,
    }
}

const fn block(center: [f32; 3], half: [f32; 3], albedo: f32) -> ShadedSolid {
    ShadedSolid {
        solid: Solid::Block { center, half },
        albedo,
    }
}

/// Dark base and mast, a light plate on top, a light sensor at the front.
pub(super) static TURTLEBOT: RobotAppearance = RobotAppearance {
    radius_m: 0.177,
    height_m: 0.42,
    parts: &[
        cylinder(0.177, 0.015, 0.13, 0.10),
        cylinder(0.13, 0.13, 0.36, 0.20),
        cylinder(0.17, 0.36, 0.42, 0.95),
        block([0.14, 0.0, 0.27], [0.03, 0.09, 0.035], 0.85),
    ],
};

/// A light robot with a dark plate.
static LIGHT_TURTLEBOT: RobotAppearance = RobotAppearance {
    radius_m: 0.177,
    height_m: 0.42,
    parts: &[
        cylinder(0.177, 0.015, 0.13, 0.80),
        cylinder(0.13, 0.13, 0.36, 0.65),
        cylinder(0.17, 0.36, 0.42, 0.12),
        block([0.14, 0.0, 0.27], [0.03, 0.09, 0.035], 0.15),
    ],
};

/// A low cart with a box on it.
static CART: RobotAppearance = RobotAppearance {
    radius_m: 0.2,
    height_m: 0.36,
    parts: &[
        cylinder(0.2, 0.015, 0.12, 0.15),
        block([0.0, 0.0, 0.24], [0.13, 0.11, 0.12], 0.75),
    ],
};

/// A tall dark column on wheels.
static TALL: RobotAppearance = RobotAppearance {
    radius_m: 0.18,
    height_m: 0.8,
    parts: &[
        cylinder(0.18, 0.015, 0.12, 0.5),
        cylinder(0.1, 0.12, 0.62, 0.12),
        cylinder(0.14, 0.62, 0.8, 0.6),
    ],
};

/// Number of different appearances of other robots.
pub(super) const KINDS: usize = 4;

/// Appearance of the robots besides Tb1: index 0 is Tb2, a TurtleBot; the others look different.
pub(super) fn of_other_robot(index: usize) -> &'static RobotAppearance {
    match index {
        0 => &TURTLEBOT,
        1 => &LIGHT_TURTLEBOT,
        2 => &CART,
        _ => &TALL,
    }
}
