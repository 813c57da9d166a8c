//! The simulated two-robot world: seeded, fixed step, no I/O. Tb1 watches with its camera while Tb2 is driven by a PID
//! controller (paper, Experimental Setup); `reset` is [`World::new`], `step` as in Gymnasium.
//!
//! Axes as in ROS: x ahead, y to the left, z up, headings counter-clockwise from x. The same seed, trial, configuration
//! and actions give the same bytes on the same machine.

use serde::{Deserialize, Serialize};

use crate::frame::Frame;
use crate::types::{Action, Channel, RobotState, Seed};

pub mod arena;
pub mod camera;
mod cast;
pub mod config;
mod driver;
pub mod environment;
mod error;
mod look;
mod mover;
mod navigator;
mod physics;
pub mod pid;
pub mod robot;
pub mod scenario;

pub use config::{CameraConfig, WorldConfig};
pub use environment::Environment;
pub use error::SimError;
pub use scenario::{PidGains, Scenario, TrialParameters};

use camera::Camera;
use driver::Driver;
use look::RobotAppearance;
use mover::Mover;
use navigator::Navigator;
use physics::PhysicsScene;

/// Longest physics step, in seconds; a frame period is cut into equal steps no longer than this.
const PHYSICS_STEP_S: f32 = 0.02;
/// A mover that drives in a scenario without an end takes another goal after touching something for this long.
const BLOCKED_LIMIT_S: f32 = 1.0;

/// Where something stands on the floor.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "server", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct PlanarPose {
    /// Metres ahead of the arena's back wall.
    pub x_m: f32,
    /// Metres to the left of the arena's middle line.
    pub y_m: f32,
    /// Counter-clockwise from x, in radians.
    pub heading_rad: f32,
}

/// What Tb1 perceives at one instant.
#[derive(Clone, Debug, PartialEq)]
pub struct Observation {
    /// The camera's picture.
    pub frame: Frame,
    /// Whose pixel is whose, row by row: 0 = scene, 1 = Tb2, 2… = further movers.
    pub mask: Vec<u8>,
    /// What Tb1's wheel odometry says, as [`state_channels`] names it.
    pub state: RobotState,
    /// Since the trial began, in seconds.
    pub time_s: f64,
}

/// What a step brought.
#[derive(Clone, Debug, PartialEq)]
pub struct StepResult {
    /// Taken at the end of the step.
    pub observation: Observation,
    /// How well Tb1 watches: 1 with Tb2 in the middle of the view, falling to 0 where it leaves it on either side or is
    /// hidden, less 1 if Tb1 touched anything during the step.
    pub reward: f32,
    /// Tb2 reached its goal (`static-observer` only).
    pub terminated: bool,
    /// The trial's time is over.
    pub truncated: bool,
}

/// What an action holds: what Tb1 is told from this frame to the next.
#[must_use]
pub fn action_channels() -> Vec<Channel> {
    vec![Channel::new("linear", "m/s"), Channel::new("angular", "rad/s")]
}

/// What a state holds: Tb1's wheel odometry, which starts at the true pose and drifts when wheels slip, and wheel speeds.
#[must_use]
pub fn state_channels() -> Vec<Channel> {
    vec![
        Channel::new("x", "m"),
        Channel::new("y", "m"),
        Channel::new("heading_cos", ""),
        Channel::new("heading_sin", ""),
        Channel::new("linear", "m/s"),
        Channel::new("angular", "rad/s"),
    ]
}

/// Another robot that is seen, and how it is driven.
struct Actor {
    look: &'static RobotAppearance,
    navigator: Navigator,
    blocked_s: f32,
}

/// One running trial.
pub struct World {
    config: WorldConfig,
    parameters: TrialParameters,
    stage: PhysicsScene,
    actors: Vec<Actor>,
    driver: Driver,
    frame_index: u64,
    observation: Observation,
    planned: Action,
    ended: bool,
}

impl World {
    /// Begins trial `trial` of the seed's sequence. Errors: as [`WorldConfig::validate`].
    pub fn new(scenario: Scenario, config: &WorldConfig, seed: Seed, trial: u64) -> Result<Self, SimError> {
        Self::from_parameters(TrialParameters::draw(scenario, seed, trial), config)
    }

    /// Begins a trial with those parameters, so that one can be looked at again or set up by hand. Errors: as
    /// [`WorldConfig::validate`] and [`TrialParameters::validate`].
    pub fn from_parameters(parameters: TrialParameters, config: &WorldConfig) -> Result<Self, SimError> {
        config.validate()?;
        parameters.validate()?;
        let mut stage = PhysicsScene::new();
        stage.add_robot(parameters.observer, look::TURTLEBOT.radius_m);
        let mut actors = Vec::new();
        for (index, route) in parameters.routes().into_iter().enumerate() {
            let look = look::of_mover(index);
            stage.add_robot(route.pose, look.radius_m);
            let random = parameters.stream("route", index as u64);
            actors.push(Actor {
                look,
                navigator: Navigator::new(route, random),
                blocked_s: 0.0,
            });
        }
        let observation = Observation {
            frame: Frame::new(1, 1, vec![0])?,
            mask: Vec::new(),
            state: RobotState::try_from(Vec::new())?,
            time_s: 0.0,
        };
        let mut world = Self {
            config: config.clone(),
            driver: Driver::new(parameters.stream("driver", 0)),
            parameters,
            stage,
            actors,
            frame_index: 0,
            observation,
            planned: Action::try_from(vec![0.0, 0.0])?,
            ended: false,
        };
        world.look_around()?;
        Ok(world)
    }

    /// All that was drawn for the trial.
    #[must_use]
    pub fn parameters(&self) -> &TrialParameters {
        &self.parameters
    }

    /// What Tb1 perceives now; the same however often it is asked.
    #[must_use]
    pub fn observe(&self) -> Observation {
        self.observation.clone()
    }

    /// What Tb1's own seeded driver wants to do next; zero where Tb1 stands still.
    #[must_use]
    pub fn policy_action(&self) -> Action {
        self.planned.clone()
    }

    /// The camera as it stands now.
    #[must_use]
    pub fn camera(&self) -> Camera {
        Camera::new(&self.config, self.stage.pose(0))
    }

    /// Where Tb2 (first) and the further movers truly stand.
    #[must_use]
    pub fn mover_poses(&self) -> Vec<PlanarPose> {
        (1..=self.actors.len()).map(|robot| self.stage.pose(robot)).collect()
    }

    /// Where Tb1 truly stands.
    #[must_use]
    pub fn observer_pose(&self) -> PlanarPose {
        self.stage.pose(0)
    }

    /// Takes this instant's picture afresh, with whose pixel is whose: the bytes that [`World::observe`] holds.
    pub fn photograph(&self) -> Result<(Frame, Vec<u8>), SimError> {
        let movers: Vec<Mover> = self
            .actors
            .iter()
            .zip(self.mover_poses())
            .zip(1..)
            .map(|((actor, pose), id)| Mover::new(actor.look, pose, id))
            .collect();
        let noise = self.parameters.stream("noise", self.frame_index);
        self.camera().take(&movers, noise)
    }

    /// Acts for one frame period. Commands beyond Tb1's limits are clamped to [`robot::MAX_LINEAR_M_S`] and
    /// [`robot::MAX_ANGULAR_RAD_S`]; in `static-observer` Tb1's brakes are on and the action moves nothing.
    /// Errors: `ActionLength`, and `Ended` after the trial's last frame.
    pub fn step(&mut self, action: &Action) -> Result<StepResult, SimError> {
        let &[linear, angular] = action.as_slice() else {
            return Err(SimError::ActionLength {
                found: action.as_slice().len(),
            });
        };
        if self.ended {
            return Err(SimError::Ended);
        }
        if self.parameters.scenario.observer_drives() {
            self.stage.command(0, [linear, angular]);
        }
        let touched = self.advance();
        self.frame_index += 1;
        self.look_around()?;
        let terminated = !self.parameters.scenario.observer_drives() && self.has_arrived(0);
        let truncated = self.frame_index + 1 >= self.config.frame_limit();
        self.ended = terminated || truncated;
        Ok(StepResult {
            observation: self.observe(),
            reward: self.watching() - if touched { 1.0 } else { 0.0 },
            terminated,
            truncated,
        })
    }

    /// Moves the physics on by a frame period; true if Tb1 touched something.
    fn advance(&mut self) -> bool {
        let period = self.config.frame_period_s as f32;
        let steps = (period / PHYSICS_STEP_S).ceil().max(1.0);
        let dt = period / steps;
        let mut touched = false;
        for _ in 0..steps as usize {
            for index in 0..self.actors.len() {
                self.drive(index, dt);
            }
            self.stage.advance(dt);
            touched |= self.stage.is_touching(0);
        }
        touched
    }

    fn drive(&mut self, index: usize, dt: f32) {
        let robot = index + 1;
        let ends = !self.parameters.scenario.observer_drives();
        let arrived = self.has_arrived(index);
        let touching = self.stage.is_touching(robot);
        let Some(actor) = self.actors.get_mut(index) else {
            return;
        };
        actor.blocked_s = if touching { actor.blocked_s + dt } else { 0.0 };
        if !ends && (arrived || actor.blocked_s > BLOCKED_LIMIT_S) {
            actor.navigator.choose_goal(self.stage.pose(robot));
            actor.blocked_s = 0.0;
        }
        let command = actor.navigator.command(self.stage.pose(robot), dt);
        self.stage.command(robot, command);
    }

    fn has_arrived(&self, index: usize) -> bool {
        let pose = self.stage.pose(index + 1);
        self.actors
            .get(index)
            .is_some_and(|actor| actor.navigator.has_arrived(pose))
    }

    /// How well Tb2 is in view, 0…1, by its bearing and whether any of its pixels is seen.
    fn watching(&self) -> f32 {
        if !self.observation.mask.contains(&1) {
            return 0.0;
        }
        let bearing = arena::bearing(self.stage.pose(0), arena::position(self.stage.pose(1)));
        let half_view = self.config.camera.horizontal_fov_rad as f32 / 2.0;
        (1.0 - bearing.abs() / half_view).clamp(0.0, 1.0)
    }

    /// Takes the picture of this instant and lets Tb1's driver plan from here.
    fn look_around(&mut self) -> Result<(), SimError> {
        let (frame, mask) = self.photograph()?;
        self.observation = Observation {
            frame,
            mask,
            state: RobotState::try_from(self.stage.odometry(0))?,
            time_s: self.frame_index as f64 * self.config.frame_period_s,
        };
        if self.parameters.scenario.observer_drives() {
            let others: Vec<[f32; 2]> = self.mover_poses().into_iter().map(arena::position).collect();
            let wish = self
                .driver
                .plan(self.stage.pose(0), &others, self.config.frame_period_s as f32);
            self.planned = Action::try_from(wish.to_vec())?;
        }
        Ok(())
    }
}
