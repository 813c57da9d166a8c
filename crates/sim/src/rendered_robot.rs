//! A robot as the camera sees it, and ray casting against it.

use rapier3d::parry::query::{Ray, RayIntersection};
use rapier3d::parry::shape::FeatureId;
use rapier3d::prelude::Vector;

use super::appearance::RobotAppearance;
use super::robot::PlanarPose;

/// The nearest point that a ray hits, of all solids tested so far.
pub(super) struct NearestHit {
    pub(super) time: f32,
    pub(super) normal: Vector,
    pub(super) albedo: f32,
    pub(super) surface: u16,
    /// Id of the robot in the segmentation mask; 0 for the scene.
    pub(super) robot_id: u8,
}

/// A robot as the camera sees it.
pub(super) struct RenderedRobot {
    appearance: &'static RobotAppearance,
    /// Added to the gray value of every part.
    tint: f32,
    position: Vector,
    cos: f32,
    sin: f32,
    id: u8,
}

impl RenderedRobot {
    pub(super) fn new(appearance: &'static RobotAppearance, tint: f32, pose: PlanarPose, id: u8) -> Self {
        let (sin, cos) = pose.heading_rad.sin_cos();
        Self {
            appearance,
            tint,
            position: Vector::new(pose.x_m, pose.y_m, 0.0),
            cos,
            sin,
            id,
        }
    }

    /// Rotates a vector from the room's axes to the robot's axes.
    fn to_robot_axes(&self, v: Vector) -> Vector {
        rotated(v, -self.sin, self.cos)
    }

    /// Share of the light that reaches a point of the floor beside the robot, 0…1: the robot's soft shadow.
    pub(super) fn shade(&self, x: f32, y: f32) -> f32 {
        let reach = 1.7 * self.appearance.radius_m;
        let away = ((x - self.position.x).powi(2) + (y - self.position.y).powi(2)) / (reach * reach);
        let dark = (1.0 - away).max(0.0);
        1.0 - 0.45 * dark * dark
    }
}

/// A robot with the values that are the same for all rays of an image.
pub(super) struct RobotView<'a> {
    pub(super) robot: &'a RenderedRobot,
    /// Camera position in the robot's axes.
    origin: Vector,
    /// From the camera to the center of the robot's bounding sphere.
    to_center: Vector,
    /// Squared distance to that center minus the squared radius of the sphere.
    outside: f32,
}

impl<'a> RobotView<'a> {
    /// The robot as seen from the camera's position.
    pub(super) fn new(robot: &'a RenderedRobot, camera: Vector) -> Self {
        let half = robot.appearance.height_m / 2.0;
        let to_center = robot.position + Vector::new(0.0, 0.0, half) - camera;
        let reach_squared = robot.appearance.radius_m.powi(2) + half * half;
        Self {
            robot,
            origin: robot.to_robot_axes(camera - robot.position),
            to_center,
            outside: to_center.length_squared() - reach_squared,
        }
    }

    /// Casts the ray against the robot. Overwrites `hit` if the robot is nearer.
    #[inline]
    pub(super) fn cast(&self, direction: Vector, hit: &mut NearestHit) {
        let along = self.to_center.dot(direction);
        if along * along < direction.length_squared() * self.outside {
            return;
        }
        let ray = Ray::new(self.origin, self.robot.to_robot_axes(direction));
        for (part, index) in self.robot.appearance.parts.iter().zip(0u16..) {
            if let Some(found) = part.solid.cast(&ray, hit.time) {
                *hit = NearestHit {
                    time: found.time_of_impact,
                    normal: rotated(found.normal, self.robot.sin, self.robot.cos),
                    albedo: (part.albedo + self.robot.tint).clamp(0.02, 0.98),
                    surface: 256 * u16::from(self.robot.id) + 8 * index + face(&found) as u16,
                    robot_id: self.robot.id,
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

/// A vector turned counter-clockwise about the vertical.
fn rotated(v: Vector, sin: f32, cos: f32) -> Vector {
    Vector::new(cos * v.x - sin * v.y, sin * v.x + cos * v.y, v.z)
}
