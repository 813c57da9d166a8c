//! The robots as rigid bodies in rapier.
//!
//! Each robot is a dynamic body that keeps its height and turns about the vertical only. Its collider is a ball at one
//! height with all others, which in that plane is the disc of its round base, and the cheapest shape there is. Tyres are
//! modelled, not wheels: before each step the tyres change the body's velocity towards what the wheels' speeds ask for,
//! at most by what their friction can do in a step; then rapier resolves contacts. So a robot that meets a wall stops
//! though its wheels go on turning, one that is pushed yields, and an undisturbed one follows the exact arc.

use rapier3d::prelude::{
    ColliderBuilder, ColliderHandle, LockedAxes, PhysicsWorld, RigidBodyBuilder, RigidBodyHandle, Vector,
};

use super::robot::{DifferentialDrive, WHEEL_BASE_M, mean_velocity};
use super::{PlanarPose, arena};

/// Height of all colliders' centres, in metres.
const PLANE_M: f32 = 0.2;
const MASS_KG: f32 = 6.0;
/// Most that the tyres accelerate the body, in metres a second squared: friction 0.6.
const GRIP_M_S2: f32 = 0.6 * 9.81;
const WALL_THICKNESS_M: f32 = 0.5;

struct Body {
    handle: RigidBodyHandle,
    collider: ColliderHandle,
    radius_m: f32,
    drive: DifferentialDrive,
}

/// The arena with its robots, in the order they were added.
pub(super) struct PhysicsScene {
    physics: PhysicsWorld,
    robots: Vec<Body>,
}

impl PhysicsScene {
    /// The empty arena: walls and pillars.
    pub(super) fn new() -> Self {
        let mut physics = PhysicsWorld::new();
        physics.gravity = Vector::ZERO;
        let half = WALL_THICKNESS_M / 2.0;
        let (length, width) = (arena::LENGTH_M, arena::WIDTH_M);
        for (x, y, half_x, half_y) in [
            (-half, 0.0, half, width),
            (length + half, 0.0, half, width),
            (length / 2.0, width / 2.0 + half, length, half),
            (length / 2.0, -width / 2.0 - half, length, half),
        ] {
            let wall = ColliderBuilder::cuboid(half_x, half_y, 1.0).translation(Vector::new(x, y, PLANE_M));
            physics.insert_collider(wall, None);
        }
        for pillar in arena::PILLARS {
            let [x, y] = pillar.position_m;
            let disc = ColliderBuilder::ball(pillar.radius_m).translation(Vector::new(x, y, PLANE_M));
            physics.insert_collider(disc, None);
        }
        Self {
            physics,
            robots: Vec::new(),
        }
    }

    /// Puts a robot there, wheels at rest.
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

    /// Tells the robot's wheels a body velocity, [m/s, rad/s], clamped to the base's limits.
    pub(super) fn command(&mut self, robot: usize, [linear, angular]: [f32; 2]) {
        if let Some(body) = self.robots.get_mut(robot) {
            body.drive.command(linear, angular);
        }
    }

    /// Moves everything on by `dt` seconds.
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
            // A uniform ball's inertia, 2/5 m r², turned by the tyres half a wheel base off the middle.
            let most = GRIP_M_S2 * (WHEEL_BASE_M / 2.0) / (0.4 * robot.radius_m * robot.radius_m) * dt;
            let spin = body.angvel().z;
            let spin = spin + (angular - spin).clamp(-most, most);
            body.set_angvel(Vector::new(0.0, 0.0, spin), true);
        }
        self.physics.step();
    }

    /// Where the robot truly stands.
    pub(super) fn pose(&self, robot: usize) -> PlanarPose {
        let body = self
            .robots
            .get(robot)
            .and_then(|robot| self.physics.bodies.get(robot.handle));
        body.map_or(arena::OBSERVER, |body| PlanarPose {
            x_m: body.translation().x,
            y_m: body.translation().y,
            heading_rad: heading(body.rotation()),
        })
    }

    /// What the robot's wheels say, as [`super::state_channels`] names it.
    pub(super) fn odometry(&self, robot: usize) -> Vec<f32> {
        let Some(body) = self.robots.get(robot) else {
            return Vec::new();
        };
        let pose = body.drive.odometry();
        let (linear, angular) = body.drive.velocity();
        let (sin, cos) = pose.heading_rad.sin_cos();
        vec![pose.x_m, pose.y_m, cos, sin, linear, angular]
    }

    /// Whether the robot touches a wall, a pillar or another robot.
    pub(super) fn is_touching(&self, robot: usize) -> bool {
        self.robots.get(robot).is_some_and(|body| {
            self.physics
                .contact_pairs_with(body.collider)
                .any(rapier3d::prelude::ContactPair::has_any_active_contact)
        })
    }
}

fn heading(rotation: &rapier3d::prelude::Rotation) -> f32 {
    super::robot::wrap(2.0 * rotation.z.atan2(rotation.w))
}
