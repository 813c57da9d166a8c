//! The simulated world with two or more robots: seeded, with a fixed time step, without I/O. The robot Tb1 observes with its
//! camera; PID controllers drive Tb2 and the other robots (paper, Experimental Setup). [`World::new`] starts a trial,
//! [`World::step`] works as in Gymnasium.
//!
//! Axes as in ROS: x forward, y to the left, z up; headings are counter-clockwise from x. The same seed, trial,
//! configuration and actions give the same bytes on the same machine.

mod appearance;
pub mod arena;
pub mod camera;
pub mod config;
mod crossing;
mod driver;
pub mod environment;
mod error;
pub mod moving_digits;
mod navigator;
mod physics;
pub mod pid;
mod ray_cast;
mod rendered_robot;
pub mod robot;
mod room;
mod room_set;
mod rooms;
mod route;
pub mod scenario;
mod surface;
mod world;

pub use config::{CameraConfig, Look, WorldConfig};
pub use environment::Environment;
pub use error::SimError;
pub use physics::Touch;
pub use robot::PlanarPose;
pub use room_set::RoomSet;
pub use route::{CrossingHabits, PidGains, Route};
pub use scenario::{Scenario, TrialParameters, TrialRoom};
pub use world::{Observation, StepResult, TriedStep, World, action_channels, state_channels};
