//! One trial of the simulated world: robots, physics, camera and the end of the trial.

use foreframe_core::frame::Frame;
use foreframe_core::types::{Action, Channel, RobotState, Seed};
use rand::Rng;

use super::appearance::{self, RobotAppearance};
use super::arena;
use super::camera::Camera;
use super::config::{CameraConfig, WorldConfig};
use super::driver::Driver;
use super::error::SimError;
use super::navigator::Navigator;
use super::physics::{PhysicsScene, Touch};
use super::rendered_robot::RenderedRobot;
use super::robot::PlanarPose;
use super::room::Room;
use super::scenario::{Scenario, TrialParameters};

/// Longest physics step, in seconds. A frame period is divided into equal steps that are not longer than this.
const PHYSICS_STEP_S: f32 = 0.02;
/// Greatest relative error of the radius that the odometry assumes for a wheel, in rooms of their own.
const WHEEL_ERROR: f32 = 0.02;
/// How many places are tried as Tb1's goal.
const GOAL_TRIES: usize = 400;
/// The distance of a goal from what stands in the room, beside the robot's radius, in metres.
const GOAL_MARGIN_M: f32 = 0.15;
/// The distance of the straight way to a goal from what stands in the room, beside the robot's radius, in metres.
const WAY_MARGIN_M: f32 = 0.08;
/// In a scenario that does not end at a goal, a robot that touches something for this long gets a new goal, in seconds.
const BLOCKED_LIMIT_S: f32 = 1.0;

/// What Tb1 perceives at one time.
#[derive(Clone, Debug, PartialEq)]
pub struct Observation {
    /// The camera image.
    pub frame: Frame,
    /// The segmentation mask, row by row: 0 = scene, 1 = Tb2, 2… = the other robots.
    pub mask: Vec<u8>,
    /// Tb1's wheel odometry, with the components of [`state_channels`].
    pub state: RobotState,
    /// Time since the start of the trial, in seconds.
    pub time_s: f64,
}

/// The result of one step.
#[derive(Clone, Debug, PartialEq)]
pub struct StepResult {
    /// The observation at the end of the step.
    pub observation: Observation,
    /// How well Tb1 keeps Tb2 in view: 1 if Tb2 is in the middle of the image, 0 if it is at the left or right edge, outside
    /// or hidden. If Tb1 touched anything during the step, 1 is subtracted.
    pub reward: f32,
    /// Whether Tb2 reached its goal (`static-observer` only).
    pub terminated: bool,
    /// Whether the time limit of the trial was reached.
    pub truncated: bool,
}

/// Components of an action: Tb1's velocity command from this frame to the next.
#[must_use]
pub fn action_channels() -> Vec<Channel> {
    vec![Channel::new("linear", "m/s"), Channel::new("angular", "rad/s")]
}

/// Components of a state: the pose from Tb1's wheel odometry and the velocity from its wheel speeds. The odometry starts at
/// the true pose and drifts when wheels slip. In a room of its own it starts at 0, and drifts also because the radii of its wheels
/// are not exactly known.
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

/// Another robot: its appearance and its controller.
#[derive(Clone)]
struct OtherRobot {
    appearance: &'static RobotAppearance,
    /// Added to its gray values.
    tint: f32,
    navigator: Navigator,
    blocked_s: f32,
}

impl OtherRobot {
    /// Gives the robot its next command. After each goal it gets another one in the room `next_goals`; none where a trial ends
    /// at its goal.
    fn control(&mut self, physics: &mut PhysicsScene, robot: usize, next_goals: Option<&Room>, dt: f32) {
        let pose = physics.pose(robot);
        let is_touching = physics.is_touching(robot);
        self.blocked_s = if is_touching { self.blocked_s + dt } else { 0.0 };
        if let Some(room) = next_goals
            && (self.navigator.has_arrived(pose) || self.blocked_s > BLOCKED_LIMIT_S || self.navigator.turns_back(dt))
        {
            self.navigator.choose_goal(room, pose);
            self.blocked_s = 0.0;
        }
        let observer = physics.pose(0);
        physics.command(robot, self.navigator.command(pose, observer, dt));
    }
}

/// One running trial.
pub struct World {
    config: WorldConfig,
    parameters: TrialParameters,
    room: Room,
    physics: PhysicsScene,
    others: Vec<OtherRobot>,
    driver: Driver,
    frame_index: u64,
    observation: Observation,
    policy_action: Action,
    ended: bool,
    /// What Tb1 touched first in the last step.
    touch: Option<Touch>,
}

/// What happens to Tb1 in a step that is only tried.
#[derive(Clone, Copy, Debug, PartialEq)]
#[doc(hidden)]
pub struct TriedStep {
    /// Its true pose at the end.
    pub pose: PlanarPose,
    /// The distance to the nearest thing, in metres.
    pub gap_m: f32,
    /// Whether it touched something.
    pub touched: bool,
}

impl World {
    /// Starts trial number `trial` of the seed. Errors: as [`WorldConfig::validate`].
    pub fn new(scenario: Scenario, config: &WorldConfig, seed: Seed, trial: u64) -> Result<Self, SimError> {
        Self::from_parameters(TrialParameters::draw_in(config, scenario, seed, trial), config)
    }

    /// Starts a trial with the given parameters, to repeat a trial or to set one up by hand. Errors: as
    /// [`WorldConfig::validate`] and [`TrialParameters::validate`].
    pub fn from_parameters(parameters: TrialParameters, config: &WorldConfig) -> Result<Self, SimError> {
        config.validate()?;
        parameters.validate()?;
        let room = parameters.room();
        let mut physics = PhysicsScene::new(&room);
        physics.add_robot(parameters.observer, appearance::TURTLEBOT.radius_m);
        let mut drawn = parameters.room.is_some().then(|| parameters.stream("robots", 0));
        if let Some(random) = &mut drawn {
            let mut factor = || 1.0 + random.random_range(-WHEEL_ERROR..WHEEL_ERROR);
            physics.set_drift(0, [factor(), factor()]);
        }
        let mut others = Vec::new();
        for (index, route) in parameters.routes(&room).into_iter().enumerate() {
            let (kind, tint) = drawn.as_mut().map_or((index, 0.0), |random| {
                (
                    random.random_range(0..appearance::KINDS),
                    random.random_range(-0.25..0.25),
                )
            });
            let appearance = appearance::of_other_robot(kind);
            physics.add_robot(route.pose, appearance.radius_m);
            let random = parameters.stream("route", index as u64);
            others.push(OtherRobot {
                appearance,
                tint,
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
            room,
            physics,
            others,
            frame_index: 0,
            observation,
            policy_action: Action::try_from(vec![0.0, 0.0])?,
            ended: false,
            touch: None,
        };
        world.update_observation()?;
        Ok(world)
    }

    /// The parameters of the trial.
    #[must_use]
    pub fn parameters(&self) -> &TrialParameters {
        &self.parameters
    }

    /// What Tb1 perceives now. Repeated calls return the same observation.
    #[must_use]
    pub fn observe(&self) -> Observation {
        self.observation.clone()
    }

    /// The next action of Tb1's built-in driving policy; zero if Tb1 stands still in this scenario.
    #[must_use]
    pub fn policy_action(&self) -> Action {
        self.policy_action.clone()
    }

    /// The camera at its current pose.
    #[must_use]
    #[doc(hidden)]
    pub fn camera(&self) -> Camera {
        Camera::new(&self.config, self.camera_config(), self.physics.pose(0))
    }

    fn camera_config(&self) -> &CameraConfig {
        self.parameters
            .room
            .as_ref()
            .map_or(&self.config.camera, |own| &own.camera)
    }

    /// True poses of the other robots, Tb2 first.
    #[must_use]
    pub fn other_robot_poses(&self) -> Vec<PlanarPose> {
        (1..=self.others.len()).map(|robot| self.physics.pose(robot)).collect()
    }

    /// The radius of one of the other robots, in the order of their poses, in metres.
    #[must_use]
    #[doc(hidden)]
    pub fn other_robot_radius_m(&self, robot: usize) -> f32 {
        self.physics.radius_m(robot + 1)
    }

    /// True pose of Tb1.
    #[must_use]
    pub fn observer_pose(&self) -> PlanarPose {
        self.physics.pose(0)
    }

    /// What Tb1 touched first in the last step.
    #[must_use]
    #[doc(hidden)]
    pub fn touch(&self) -> Option<Touch> {
        self.touch
    }

    /// The distance from Tb1's edge to the nearest wall, piece or robot, in metres.
    #[must_use]
    #[doc(hidden)]
    pub fn gap_m(&self) -> f32 {
        gap_m(&self.physics, &self.room)
    }

    /// Length and width of the room, in metres: x goes from 0 to the length, y from minus to plus half the width.
    #[must_use]
    #[doc(hidden)]
    pub fn room_sides_m(&self) -> [f32; 2] {
        [self.room.length_m, self.room.width_m]
    }

    /// Whether a wall or a piece of the room stands at a place, or the place is outside the room.
    #[must_use]
    #[doc(hidden)]
    pub fn is_blocked(&self, place_m: [f32; 2]) -> bool {
        self.room.gap_m(place_m) <= 0.0
    }

    /// The radius of Tb1, in metres.
    #[must_use]
    #[doc(hidden)]
    pub fn observer_radius_m(&self) -> f32 {
        self.physics.radius_m(0)
    }

    /// A place for Tb1 to drive to: free, at least `least_m` away, not farther than `aside_rad` from straight ahead, and with a
    /// straight way that nothing stands on. Of several, one at random; `None` if there is none. Robots do not count.
    #[must_use]
    #[doc(hidden)]
    pub fn draw_goal(&self, seed: Seed, least_m: f32, aside_rad: f32) -> Option<[f32; 2]> {
        let mut random = seed.rng();
        let here = arena::position(self.physics.pose(0));
        let radius = self.physics.radius_m(0);
        let half = self.room.width_m / 2.0;
        (0..GOAL_TRIES)
            .map(|_| {
                [
                    random.random_range(0.0..self.room.length_m),
                    random.random_range(-half..half),
                ]
            })
            .find(|&place| {
                arena::distance(here, place) >= least_m
                    && arena::bearing(self.physics.pose(0), place).abs() <= aside_rad
                    && self.room.is_clear(place, radius + GOAL_MARGIN_M)
                    && self.room.is_way_free(here, place, radius + WAY_MARGIN_M)
            })
    }

    /// What would happen to Tb1 under these commands, [m/s, rad/s], one for each frame period: the world itself stays as it is.
    #[must_use]
    #[doc(hidden)]
    pub fn try_plan(&self, commands: &[[f32; 2]]) -> Vec<TriedStep> {
        let (mut physics, mut others) = (self.physics.branch(&self.room), self.others.clone());
        let next_goals = self.parameters.scenario.has_several_goals().then_some(&self.room);
        let step = |&command: &[f32; 2]| {
            physics.command(0, command);
            let touch = advance(&mut physics, &mut others, next_goals, self.config.frame_period_s as f32);
            TriedStep {
                pose: physics.pose(0),
                gap_m: gap_m(&physics, &self.room),
                touched: touch.is_some(),
            }
        };
        commands.iter().map(step).collect()
    }

    /// Renders the current camera image and its segmentation mask again: the same bytes as in [`World::observe`].
    pub fn render(&self) -> Result<(Frame, Vec<u8>), SimError> {
        let noise = self.parameters.stream("noise", self.frame_index);
        self.camera().capture(&self.room, &self.rendered_robots(), noise)
    }

    /// How far away what each pixel shows is, along the camera's axis, in metres.
    #[must_use]
    #[doc(hidden)]
    pub fn depths(&self) -> Vec<f32> {
        self.camera().depths(&self.room, &self.rendered_robots())
    }

    fn rendered_robots(&self) -> Vec<RenderedRobot> {
        let robots = self.others.iter().zip(self.other_robot_poses()).zip(1..);
        robots
            .map(|((robot, pose), id)| RenderedRobot::new(robot.appearance, robot.tint, pose, id))
            .collect()
    }

    /// Simulates one frame period with this action. Commands beyond Tb1's limits are clamped to [`super::robot::MAX_LINEAR_M_S`] and
    /// [`super::robot::MAX_ANGULAR_RAD_S`]. In `static-observer` Tb1 does not move and the action is ignored.
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
            self.physics.command(0, [linear, angular]);
        }
        let next_goals = self.parameters.scenario.has_several_goals().then_some(&self.room);
        self.touch = advance(
            &mut self.physics,
            &mut self.others,
            next_goals,
            self.config.frame_period_s as f32,
        );
        self.frame_index += 1;
        self.update_observation()?;
        let tb2_arrived = self.others[0].navigator.has_arrived(self.physics.pose(1));
        let terminated = !self.parameters.scenario.observer_drives() && tb2_arrived;
        let truncated = self.frame_index + 1 >= self.config.frame_limit();
        self.ended = terminated || truncated;
        Ok(StepResult {
            observation: self.observe(),
            reward: self.view_score() - if self.touch.is_some() { 1.0 } else { 0.0 },
            terminated,
            truncated,
        })
    }

    /// How well Tb2 is in view, 0…1: from its bearing, and 0 if none of its pixels is visible.
    fn view_score(&self) -> f32 {
        if !self.observation.mask.contains(&1) {
            return 0.0;
        }
        let bearing = arena::bearing(self.physics.pose(0), arena::position(self.physics.pose(1)));
        let half_view = self.camera_config().horizontal_fov_rad as f32 / 2.0;
        (1.0 - bearing.abs() / half_view).clamp(0.0, 1.0)
    }

    /// Renders the current observation and plans the next action of Tb1's driving policy.
    fn update_observation(&mut self) -> Result<(), SimError> {
        let (frame, mask) = self.render()?;
        self.observation = Observation {
            frame,
            mask,
            state: RobotState::try_from(if self.config.true_pose {
                self.physics.true_state(0)
            } else {
                self.physics.odometry(0)
            })?,
            time_s: self.frame_index as f64 * self.config.frame_period_s,
        };
        if self.parameters.scenario.observer_drives() {
            let others: Vec<[f32; 2]> = self.other_robot_poses().into_iter().map(arena::position).collect();
            let command = self.driver.plan(
                &self.room,
                self.physics.pose(0),
                &others,
                self.config.frame_period_s as f32,
            );
            self.policy_action = Action::try_from(command.to_vec())?;
        }
        Ok(())
    }
}

/// Simulates the physics for one frame period; returns what Tb1 touched first.
fn advance(
    physics: &mut PhysicsScene,
    others: &mut [OtherRobot],
    next_goals: Option<&Room>,
    period_s: f32,
) -> Option<Touch> {
    let steps = (period_s / PHYSICS_STEP_S).ceil().max(1.0);
    let dt = period_s / steps;
    let mut touch = None;
    for _ in 0..steps as usize {
        for (other, robot) in others.iter_mut().zip(1..) {
            other.control(physics, robot, next_goals, dt);
        }
        physics.advance(dt);
        touch = touch.or_else(|| physics.touch(0));
    }
    touch
}

fn gap_m(physics: &PhysicsScene, room: &Room) -> f32 {
    let place = arena::position(physics.pose(0));
    (room.gap_m(place) - physics.radius_m(0)).min(physics.gap_to_robots_m(0))
}
