//! One episode with one driver.

use std::collections::VecDeque;
use std::f32::consts::PI;
use std::time::Instant;

use serde::{Deserialize, Serialize};

use super::drivers::EpisodeDriver;
use super::error::DriveError;
use super::settings::{DriveSettings, DriverKind};
use super::situation::{RobotViews, Situation, seen_from};
use foreframe_core::frame::warp::CameraModel;
use foreframe_core::registry::Model;
use foreframe_core::types::Action;
use foreframe_sim::{Scenario, Touch, World, WorldConfig};

/// The robot has arrived at this distance from its goal, in metres.
const ARRIVAL_M: f32 = 0.25;
/// The goal is at least this far away, in metres.
const LEAST_GOAL_M: f32 = 1.5;
/// In `crossing`, the goal is not farther than this from straight ahead, in radians.
const CROSSED_RAD: f32 = 0.35;
/// Some starts leave the robot no way. Then the episode is drawn again, up to this number of draws.
const ROOMS_TRIED: u64 = 8;
/// From one draw's trial number to the next one's: more than there are episodes.
const OTHER_ROOM: u64 = 1 << 32;
/// Without a model, the robot stands for this many frames, as others stand until their model's context is full.
const CONTEXT: usize = 5;
/// A robot counts as seen for so long after the camera showed it, in seconds.
const SEEN_S: f32 = 2.0;
/// Commands below this are standing, in m/s.
const STANDING_M_S: f32 = 0.02;

/// What happened in an episode.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct EpisodeResult {
    /// Whether the robot arrived within the time.
    pub arrived: bool,
    /// How often it began to touch something.
    pub collisions: usize,
    /// Collisions in which it did not drive forward: it stood or turned on the spot.
    pub while_standing: usize,
    /// Collisions with a robot that the camera had not shown in the two seconds before.
    pub unseen: usize,
    /// The time until it arrived, or all of it, in seconds.
    pub time_s: f64,
    /// The way that it drove, in metres.
    pub way_m: f64,
    /// The straight way to where it arrives, which is free but for other robots, in metres.
    pub shortest_m: f64,
    /// The least distance to anything, in metres; at or below 0 it touched it.
    pub closest_m: f64,
    /// How often it stopped before it had arrived.
    pub stops: usize,
    /// The time of each choice of a command, in milliseconds.
    #[serde(skip)]
    pub planning_ms: PlanningTimes,
}

impl EpisodeResult {
    /// Whether the robot arrived without a collision.
    pub(super) fn is_success(&self) -> bool {
        self.arrived && self.collisions == 0
    }

    /// `shortest_m`: the straight way to where the robot arrives; `gap_m`: the distance to the nearest thing.
    fn at_start(shortest_m: f32, gap_m: f32) -> Self {
        Self {
            arrived: false,
            collisions: 0,
            while_standing: 0,
            unseen: 0,
            time_s: 0.0,
            way_m: 0.0,
            shortest_m: f64::from(shortest_m),
            closest_m: f64::from(gap_m),
            stops: 0,
            planning_ms: PlanningTimes::default(),
        }
    }

    /// Counts a collision. `is_unseen`: whether it is with a robot that the camera had not shown.
    fn count(&mut self, touch: Touch, is_unseen: bool) {
        self.collisions += 1;
        self.while_standing += usize::from(touch.speed_m_s < STANDING_M_S);
        self.unseen += usize::from(is_unseen);
    }
}

/// An episode after a step, for those who look on.
#[derive(Clone, Copy)]
pub struct DriveStep<'a> {
    /// The world: robots, camera, time.
    pub world: &'a World,
    /// The goal, [x, y] in the room.
    pub goal_m: [f32; 2],
    /// The way of the plan that the driver follows from here on, in the room; empty without a plan.
    pub plan_m: &'a [[f32; 2]],
    /// From one step to the next, in seconds.
    pub period_s: f32,
}

/// Times, which differ from run to run: they do not count when results are compared.
#[derive(Clone, Debug, Default)]
pub struct PlanningTimes(pub Vec<f64>);

impl PartialEq for PlanningTimes {
    fn eq(&self, _other: &Self) -> bool {
        true
    }
}

/// An episode before its first frame.
struct EpisodeStart {
    world: World,
    /// The goal, in the room.
    goal_m: [f32; 2],
    camera: CameraModel,
    /// The frames that a driver waits for.
    context: usize,
    period_s: f32,
}

impl EpisodeStart {
    fn new(model: Option<&Model>, settings: &DriveSettings, episode: usize) -> Result<Self, DriveError> {
        let mut config = WorldConfig {
            max_duration_s: settings.duration_s,
            rooms: settings.rooms,
            ..WorldConfig::default()
        };
        let mut context = CONTEXT;
        if let Some(spec) = model.map(Model::spec) {
            (config.frame_width_px, config.frame_height_px) = (spec.frame_width_px, spec.frame_height_px);
            config.frame_period_s = spec.frame_period_s;
            context = spec.context;
        }
        for nth in 0..ROOMS_TRIED {
            let Some((world, goal_m)) = world_with_goal(settings, &config, episode as u64 + nth * OTHER_ROOM)? else {
                continue;
            };
            let own = world.parameters().room.as_ref();
            let own = own.map(|room| room.camera.model_with_height());
            return Ok(Self {
                goal_m,
                camera: own.unwrap_or_else(|| config.camera.model_with_height()),
                world,
                context,
                period_s: config.frame_period_s as f32,
            });
        }
        Err(DriveError::NoGoal { episode })
    }
}

/// A trial's world and a goal that the robot can reach there; `None` if there is no such goal.
fn world_with_goal(
    settings: &DriveSettings,
    config: &WorldConfig,
    trial: u64,
) -> Result<Option<(World, [f32; 2])>, DriveError> {
    let world = World::new(settings.scenario, config, settings.seed, trial)?;
    let seed = settings.seed.derive("goal", trial);
    // Robots cross the way ahead.
    let aside_rad = if settings.scenario == Scenario::Crossing {
        CROSSED_RAD
    } else {
        PI
    };
    let tries = [(LEAST_GOAL_M, aside_rad), (LEAST_GOAL_M, PI), (LEAST_GOAL_M / 2.0, PI)];
    let goal = tries
        .into_iter()
        .find_map(|(least_m, aside_rad)| world.draw_goal(seed, least_m, aside_rad));
    Ok(goal.map(|goal| (world, goal)))
}

/// Drives an episode. `on_step` is called after each step, and after the choice of the next command.
pub(super) fn drive(
    kind: DriverKind,
    model: Option<&Model>,
    settings: &DriveSettings,
    episode: usize,
    on_step: &mut dyn FnMut(&DriveStep<'_>) -> Result<(), DriveError>,
) -> Result<EpisodeResult, DriveError> {
    let EpisodeStart {
        mut world,
        goal_m: goal,
        camera,
        context,
        period_s,
    } = EpisodeStart::new(model, settings, episode)?;
    let seeds = (settings.seed.derive("driver", episode as u64), settings.budget);
    let mut driver = EpisodeDriver::new(kind, model, period_s, seeds);
    let mut show = |world: &World, plan_m: &[[f32; 2]]| {
        on_step(&DriveStep {
            world,
            goal_m: goal,
            plan_m,
            period_s,
        })
    };
    let mut result = EpisodeResult::at_start(distance(&world, goal) - ARRIVAL_M, world.gap_m());
    let (mut frames, mut states) = (VecDeque::new(), VecDeque::new());
    let (mut views, recent) = (RobotViews::default(), (SEEN_S / period_s).round() as u64);
    let (mut was_touching, mut was_moving) = (false, false);
    for frame in 0.. {
        let observation = world.observe();
        views.record(&observation.mask, frame);
        frames.push_back(observation.frame);
        states.push_back(observation.state);
        if frames.len() > context {
            frames.pop_front();
            states.pop_front();
        }
        let mut command = [0.0, 0.0];
        if frames.len() == context {
            let now = Situation {
                world: &world,
                frames: &frames,
                states: &states,
                camera,
                goal_m: seen_from(world.observer_pose(), goal),
                frame,
                views: &views,
            };
            let begun = Instant::now();
            command = driver.command(&now)?;
            result.planning_ms.0.push(begun.elapsed().as_secs_f64() * 1000.0);
        }
        if frame > 0 {
            show(&world, driver.way_m())?;
        }
        let is_moving = command[0] > STANDING_M_S;
        result.stops += usize::from(was_moving && !is_moving);
        was_moving = is_moving;
        let before = world.observer_pose();
        let step = world.step(&Action::try_from(command.to_vec())?)?;
        result.way_m += f64::from(distance(&world, [before.x_m, before.y_m]));
        let (gap_m, touch) = (f64::from(world.gap_m()), world.touch());
        // A touch can be over at the frame.
        result.closest_m = result
            .closest_m
            .min(if touch.is_some() { gap_m.min(0.0) } else { gap_m });
        if let Some(touch) = touch.filter(|_| !was_touching) {
            result.count(touch, touch.robot.is_some_and(|robot| !views.saw(robot, frame, recent)));
        }
        was_touching = touch.is_some();
        result.time_s = step.observation.time_s;
        result.arrived = distance(&world, goal) < ARRIVAL_M;
        if result.arrived || step.truncated || step.terminated {
            break;
        }
    }
    show(&world, &[])?;
    Ok(result)
}

fn distance(world: &World, [x, y]: [f32; 2]) -> f32 {
    let pose = world.observer_pose();
    (x - pose.x_m).hypot(y - pose.y_m)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_collision_counts_in_its_classes() {
        let mut result = EpisodeResult::at_start(2.0, 0.5);
        let touch = |speed_m_s| Touch {
            speed_m_s,
            robot: Some(1),
        };
        result.count(touch(0.3), false);
        assert_eq!((result.collisions, result.while_standing, result.unseen), (1, 0, 0));
        result.count(touch(0.0), false);
        assert_eq!((result.collisions, result.while_standing, result.unseen), (2, 1, 0));
        // Its wheels turn slower than a command that drives.
        result.count(touch(0.9 * STANDING_M_S), true);
        assert_eq!((result.collisions, result.while_standing, result.unseen), (3, 2, 1));
    }
}
