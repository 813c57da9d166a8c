//! The robots as rigid bodies in rapier.
//!
//! Each robot is a dynamic body with a fixed height that rotates only around the vertical axis. Its collider is a ball, the
//! cheapest shape; all balls have the same height, so in that plane they act as the discs of the round bases. The model
//! contains tyre friction instead of wheels: before each step, the body's velocity changes towards the velocity of the wheels,
//! at most by what friction allows in one step; then rapier resolves contacts. So a robot at a wall stops although its wheels
//! still turn, a pushed robot moves, and an undisturbed robot follows the exact arc.

use rapier3d::prelude::{
    ColliderBuilder, ColliderHandle, ContactPair, LockedAxes, PhysicsWorld, RigidBodyBuilder, RigidBodyHandle, Vector,
};

use super::robot::{DifferentialDrive, PlanarPose, WHEEL_BASE_M, mean_velocity};
use super::room::{Footprint, Room};

/// Height of the centers of all colliders, in metres.
const PLANE_M: f32 = 0.2;
const MASS_KG: f32 = 6.0;
/// Largest acceleration by the tyres, in m/s²: friction coefficient 0.6.
const GRIP_M_S2: f32 = 0.6 * 9.81;
const WALL_THICKNESS_M: f32 = 0.5;

struct Body {
    handle: RigidBodyHandle,
    collider: ColliderHandle,
    radius_m: f32,
    drive: DifferentialDrive,
}

/// What a robot touches.
#[derive(Clone, Copy, Debug, PartialEq)]
#[doc(hidden)]
pub struct Touch {
    /// How fast its own wheels drive it, in m/s.
    pub speed_m_s: f32,
    /// The number of the other robot, which is its id in the segmentation mask; `None` if it is none.
    pub robot: Option<usize>,
}

/// A room with its robots, in the order in which they were added.
pub(super) struct PhysicsScene {
    physics: PhysicsWorld,
    robots: Vec<Body>,
}

impl PhysicsScene {
    /// The room without robots: its walls and pieces.
    pub(super) fn new(room: &Room) -> Self {
        let mut physics = PhysicsWorld::new();
        physics.gravity = Vector::ZERO;
        let half = WALL_THICKNESS_M / 2.0;
        let (length, width) = (room.length_m, room.width_m);
        for (x, y, half_x, half_y) in [
            (-half, 0.0, half, width),
            (length + half, 0.0, half, width),
            (length / 2.0, width / 2.0 + half, length, half),
            (length / 2.0, -width / 2.0 - half, length, half),
        ] {
            let wall = ColliderBuilder::cuboid(half_x, half_y, 1.0).translation(Vector::new(x, y, PLANE_M));
            physics.insert_collider(wall, None);
        }
        for piece in &room.pieces {
            let ([x, y], collider) = match piece.footprint {
                Footprint::Disc { center_m, radius_m } => (center_m, ColliderBuilder::ball(radius_m)),
                Footprint::Rectangle { center_m, half_m } => {
                    (center_m, ColliderBuilder::cuboid(half_m[0], half_m[1], 1.0))
                }
            };
            physics.insert_collider(collider.translation(Vector::new(x, y, PLANE_M)), None);
        }
        Self {
            physics,
            robots: Vec::new(),
        }
    }

    /// A second scene of the same room, in which the robots stand and move as they do now.
    pub(super) fn branch(&self, room: &Room) -> Self {
        let mut branch = Self::new(room);
        for (robot, body) in self.robots.iter().enumerate() {
            branch.add_robot(self.pose(robot), body.radius_m);
            branch.robots[robot].drive = body.drive.clone();
            let (moving, copy) = (&self.physics.bodies[body.handle], branch.robots[robot].handle);
            if let Some(copy) = branch.physics.bodies.get_mut(copy) {
                copy.set_linvel(moving.linvel(), true);
                copy.set_angvel(moving.angvel(), true);
            }
        }
        branch
    }

    /// The distance from a robot's edge to the edge of the nearest other robot, in metres; infinite without one.
    pub(super) fn gap_to_robots_m(&self, robot: usize) -> f32 {
        let of = |robot: usize| (super::arena::position(self.pose(robot)), self.robots[robot].radius_m);
        let (place, radius) = of(robot);
        let others = (0..self.robots.len()).filter(|&other| other != robot).map(of);
        let gap = |(other, other_radius)| super::arena::distance(place, other) - radius - other_radius;
        others.map(gap).fold(f32::INFINITY, f32::min)
    }

    /// A robot's radius, in metres.
    pub(super) fn radius_m(&self, robot: usize) -> f32 {
        self.robots[robot].radius_m
    }

    /// Adds a robot at this pose, with its wheels at rest.
    pub(super) fn add_robot(&mut self, pose: PlanarPose, radius_m: f32) {
        let upright = LockedAxes::TRANSLATION_LOCKED_Z | LockedAxes::ROTATION_LOCKED_X | LockedAxes::ROTATION_LOCKED_Y;
        let body = RigidBodyBuilder::dynamic()
            .translation(Vector::new(pose.x_m, pose.y_m, PLANE_M))
            .rotation(Vector::new(0.0, 0.0, pose.heading_rad))
            .locked_axes(upright)
            .can_sleep(false);
        let disc = ColliderBuilder::ball(radius_m).mass(MASS_KG).friction(0.2);
        let (handle, collider) = self.physics.insert(body, disc);
        self.robots.push(Body {
            handle,
            collider,
            radius_m,
            drive: DifferentialDrive::new(pose),
        });
    }

    /// Lets the robot's odometry start at 0 and drift: see [`DifferentialDrive::set_drift`]. A robot's number is its place in
    /// the order in which the robots were added, here and below.
    pub(super) fn set_drift(&mut self, robot: usize, radius_factors: [f32; 2]) {
        self.robots[robot].drive.set_drift(radius_factors);
    }

    /// Sets the robot's velocity command, [m/s, rad/s], clamped to the limits of the base.
    pub(super) fn command(&mut self, robot: usize, [linear, angular]: [f32; 2]) {
        self.robots[robot].drive.command(linear, angular);
    }

    /// Simulates `dt` seconds.
    pub(super) fn advance(&mut self, dt: f32) {
        self.physics.integration_parameters.dt = dt;
        for robot in &mut self.robots {
            robot.drive.advance(dt);
            let (linear, angular) = robot.drive.velocity();
            let Some(body) = self.physics.bodies.get_mut(robot.handle) else {
                continue;
            };
            let [x, y] = mean_velocity(heading(body.rotation()), linear, angular, dt);
            let slip = Vector::new(x, y, 0.0) - body.linvel();
            body.set_linvel(body.linvel() + slip.clamp_length_max(GRIP_M_S2 * dt), true);
            // The inertia of a uniform ball is 2/5 m r². The tyres act half a wheel base from the center.
            let max_change = GRIP_M_S2 * (WHEEL_BASE_M / 2.0) / (0.4 * robot.radius_m * robot.radius_m) * dt;
            let spin = body.angvel().z;
            let spin = spin + (angular - spin).clamp(-max_change, max_change);
            body.set_angvel(Vector::new(0.0, 0.0, spin), true);
        }
        self.physics.step();
    }

    /// The robot's true pose.
    pub(super) fn pose(&self, robot: usize) -> PlanarPose {
        let body = &self.physics.bodies[self.robots[robot].handle];
        PlanarPose {
            x_m: body.translation().x,
            y_m: body.translation().y,
            heading_rad: heading(body.rotation()),
        }
    }

    /// The robot's wheel odometry, with the components of [`super::state_channels`].
    pub(super) fn odometry(&self, robot: usize) -> Vec<f32> {
        let drive = &self.robots[robot].drive;
        state_of(drive.odometry(), drive.measured_velocity())
    }

    /// The state with the true pose instead of the odometry's.
    pub(super) fn true_state(&self, robot: usize) -> Vec<f32> {
        state_of(self.pose(robot), self.robots[robot].drive.measured_velocity())
    }

    /// Whether the robot touches a wall, a pillar or another robot.
    pub(super) fn is_touching(&self, robot: usize) -> bool {
        self.contact(robot).is_some()
    }

    /// What the robot touches; the first of several, `None` if it touches nothing.
    pub(super) fn touch(&self, robot: usize) -> Option<Touch> {
        let (own, contact) = (&self.robots[robot], self.contact(robot)?);
        let other = if contact.collider1 == own.collider {
            contact.collider2
        } else {
            contact.collider1
        };
        Some(Touch {
            speed_m_s: own.drive.velocity().0,
            robot: self.robots.iter().position(|robot| robot.collider == other),
        })
    }

    fn contact(&self, robot: usize) -> Option<&ContactPair> {
        let mut contacts = self.physics.contact_pairs_with(self.robots[robot].collider);
        contacts.find(|pair| pair.has_any_active_contact())
    }
}

fn state_of(pose: PlanarPose, (linear, angular): (f32, f32)) -> Vec<f32> {
    let (sin, cos) = pose.heading_rad.sin_cos();
    vec![pose.x_m, pose.y_m, cos, sin, linear, angular]
}

fn heading(rotation: &rapier3d::prelude::Rotation) -> f32 {
    super::robot::wrap(2.0 * rotation.z.atan2(rotation.w))
}
