//! A robot as the camera sees it, and the casting of a ray against one.

use rapier3d::parry::query::{Ray, RayCast, RayIntersection};
use rapier3d::parry::shape::FeatureId;
use rapier3d::prelude::Vector;

use super::PlanarPose;
use super::look::{RobotAppearance, Solid};

/// What a ray hits first, so far.
pub(super) struct NearestHit {
    pub(super) time: f32,
    pub(super) normal: Vector,
    pub(super) albedo: f32,
    pub(super) surface: u16,
    pub(super) owner: u8,
}

/// A robot as the camera sees it.
pub(super) struct Mover {
    look: &'static RobotAppearance,
    position: Vector,
    cos: f32,
    sin: f32,
    id: u8,
}

impl Mover {
    pub(super) fn new(look: &'static RobotAppearance, pose: PlanarPose, id: u8) -> Self {
        let (sin, cos) = pose.heading_rad.sin_cos();
        Self {
            look,
            position: Vector::new(pose.x_m, pose.y_m, 0.0),
            cos,
            sin,
            id,
        }
    }

    /// From the room's axes to the robot's own.
    fn inward(&self, v: Vector) -> Vector {
        Vector::new(self.cos * v.x + self.sin * v.y, self.cos * v.y - self.sin * v.x, v.z)
    }

    fn outward(&self, v: Vector) -> Vector {
        Vector::new(self.cos * v.x - self.sin * v.y, self.sin * v.x + self.cos * v.y, v.z)
    }

    /// How much of the light its body leaves to a point of the floor.
    pub(super) fn shade(&self, x: f32, y: f32) -> f32 {
        let reach = 1.7 * self.look.radius_m;
        let away = ((x - self.position.x).powi(2) + (y - self.position.y).powi(2)) / (reach * reach);
        let dark = (1.0 - away).max(0.0);
        1.0 - 0.45 * dark * dark
    }
}

/// A mover with what is the same for all rays of a picture.
pub(super) struct MoverView<'a> {
    pub(super) mover: &'a Mover,
    /// Camera in the mover's own axes.
    origin: Vector,
    /// From the camera to the middle of the ball about the mover.
    to_middle: Vector,
    /// Squared distance to that middle less the squared radius.
    outside: f32,
}

impl<'a> MoverView<'a> {
    /// The mover as seen from that place.
    pub(super) fn new(mover: &'a Mover, camera: Vector) -> Self {
        let half = mover.look.height_m / 2.0;
        let to_middle = mover.position + Vector::new(0.0, 0.0, half) - camera;
        let reach_squared = mover.look.radius_m.powi(2) + half * half;
        Self {
            mover,
            origin: mover.inward(camera - mover.position),
            to_middle,
            outside: to_middle.length_squared() - reach_squared,
        }
    }

    /// Puts the mover's nearest part into `hit` if it is before what was there.
    pub(super) fn cast(&self, direction: Vector, hit: &mut NearestHit) {
        let along = self.to_middle.dot(direction);
        if along * along < direction.length_squared() * self.outside {
            return;
        }
        let ray = Ray::new(self.origin, self.mover.inward(direction));
        for (part, index) in self.mover.look.parts.iter().zip(0u16..) {
            let found = match &part.solid {
                Solid::Cylinder(shape) => shape.cast_local_ray_and_get_normal(&ray, hit.time, true),
                Solid::Block(shape) => shape.cast_local_ray_and_get_normal(&ray, hit.time, true),
            };
            if let Some(found) = found {
                *hit = NearestHit {
                    time: found.time_of_impact,
                    normal: self.mover.outward(found.normal),
                    albedo: part.albedo,
                    surface: 256 * u16::from(self.mover.id) + 8 * index + face(&found) as u16,
                    owner: self.mover.id,
                };
            }
        }
    }
}

pub(super) fn face(found: &RayIntersection) -> usize {
    match found.feature {
        FeatureId::Face(index) => index as usize,
        _ => 0,
    }
}
