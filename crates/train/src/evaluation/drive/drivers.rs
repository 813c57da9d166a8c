//! What chooses the commands. All drivers know where the goal is, and have the same limits.

use std::collections::VecDeque;
use std::time::Duration;

use rayon::prelude::*;

use super::error::DriveError;
use super::settings::DriverKind;
use foreframe_core::frame::Frame;
use foreframe_core::frame::warp::CameraModel;
use foreframe_core::planning::{
    ActionLimit, Goal, Obstacles, PlanContext, PlanSettings, PlannerInput, SearchSpace, SolverSettings, plan,
};
use foreframe_core::registry::Model;
use foreframe_core::serving::{ConditioningInput, Task, compute_task};
use foreframe_core::types::{Action, RobotState, Seed};
use foreframe_sim::World;
use foreframe_sim::pid::{Gains, Pid};
use foreframe_sim::robot::wrap;

/// Limits of the commands, those of the recorded drives: m/s and rad/s.
const LIMITS: [ActionLimit; 2] = [
    ActionLimit {
        low: 0.0,
        high: 0.5,
        max_change: None,
    },
    ActionLimit {
        low: -0.8,
        high: 0.8,
        max_change: None,
    },
];
/// Radius of the robot, in metres.
const RADIUS_M: f32 = 0.18;
/// The distance that planning drivers keep, in metres.
const MARGIN_M: f32 = 0.15;
/// The distance at which the driver `stop` stops, in metres.
const STOP_MARGIN_M: f32 = 0.05;
/// Plans of an iteration, and iterations, with the simulator as the model.
const SIMULATED: [usize; 2] = [48, 2];
/// Actions of a plan with the simulator as the model: those of the shipped models.
const SIMULATED_STEPS: usize = 5;
/// Weights of the driver `simulator`: per radian of the angle to the goal, and per metre of lacking clearance, as the planner's.
const HEADING_WEIGHT: f32 = 0.3;
const CLEARANCE_WEIGHT: f32 = 5.0;

/// What a driver knows at a frame.
pub(super) struct Situation<'a> {
    /// The world, for the driver `simulator`.
    pub(super) world: &'a World,
    /// The frames of the model's context, oldest first.
    pub(super) frames: &'a VecDeque<Frame>,
    /// The states at them.
    pub(super) states: &'a VecDeque<RobotState>,
    /// The camera.
    pub(super) camera: CameraModel,
    /// The goal as seen from the robot: metres ahead and to the left.
    pub(super) goal_m: [f32; 2],
    /// The number of the frame.
    pub(super) frame: u64,
}

/// A driver of one episode.
pub(super) struct EpisodeDriver<'a> {
    kind: DriverKind,
    model: Option<&'a Model>,
    heading: Pid,
    distance: Pid,
    period_s: f32,
    seed: Seed,
    budget: Option<Duration>,
    /// The last plan without its first action.
    present: Vec<Action>,
}

impl<'a> EpisodeDriver<'a> {
    pub(super) fn new(
        kind: DriverKind,
        model: Option<&'a Model>,
        period_s: f32,
        (seed, budget): (Seed, Option<Duration>),
    ) -> Self {
        let gains = |proportional| Gains {
            proportional,
            integral: 0.0,
            derivative: 0.0,
        };
        Self {
            kind,
            model,
            heading: Pid::new(gains(2.5), LIMITS[1].high),
            distance: Pid::new(gains(0.8), LIMITS[0].high),
            period_s,
            seed,
            budget,
            present: Vec::new(),
        }
    }

    /// The next command, m/s and rad/s.
    pub(super) fn command(&mut self, now: &Situation<'_>) -> Result<[f32; 2], DriveError> {
        match (self.kind, self.model) {
            (DriverKind::Stop, Some(model)) => self.stop_and_go(model, now),
            (DriverKind::Plan, Some(model)) => self.planned(model, now),
            (DriverKind::Simulator, _) => self.simulated(now),
            _ => Ok(self.straight(now)),
        }
    }

    fn straight(&mut self, now: &Situation<'_>) -> [f32; 2] {
        let [ahead, left] = now.goal_m;
        let bearing = left.atan2(ahead);
        let angular = self.heading.update(bearing, self.period_s);
        let linear = self.distance.update(ahead.hypot(left), self.period_s);
        [linear.max(0.0) * bearing.cos().max(0.0), angular]
    }

    /// Stands while something is on the way of the next second, and turns to the goal meanwhile.
    fn stop_and_go(&mut self, model: &Model, now: &Situation<'_>) -> Result<[f32; 2], DriveError> {
        let [linear, angular] = self.straight(now);
        let spec = model.spec();
        let steps = (1.0 / self.period_s).round().max(1.0) as usize;
        let held = vec![[linear, angular]; steps];
        let state = now.states.back().cloned();
        let plans = vec![vec![action([0.0, 0.0])?; spec.horizon]];
        let inputs = ConditioningInput::of_plans(plans, state.clone(), None, &model.manifest)?;
        let seen = compute_task(model, &context(model, now)?.task(inputs, true))?;
        let seen = seen.occupancy.unwrap_or_default();
        let obstacles = Obstacles::new(&seen, now.camera.height_m, PlanSettings::default().robot_height_m).as_now();
        let state = state
            .filter(|_| spec.state_inputs().is_some())
            .map_or_else(Vec::new, Vec::from);
        let way = model.network.commanded_motion(&state, held.as_flattened(), steps)?;
        let clearance = way.map_or(f32::INFINITY, |way| obstacles.least_clearance_m(&way, RADIUS_M));
        Ok(if clearance < STOP_MARGIN_M {
            [0.0, angular]
        } else {
            [linear, angular]
        })
    }

    fn planned(&mut self, model: &Model, now: &Situation<'_>) -> Result<[f32; 2], DriveError> {
        let [ahead, left] = now.goal_m;
        let input = PlannerInput {
            goal: Goal {
                position_m: Some(now.goal_m),
                heading_rad: Some(left.atan2(ahead)),
                image: None,
            },
            settings: PlanSettings {
                solver: SolverSettings {
                    samples: 128,
                    iterations: 3,
                    seed: self.seed.derive("plan", now.frame).0,
                    ..SolverSettings::default()
                },
                limits: Some(LIMITS.to_vec()),
                budget: self.budget,
                radius_m: RADIUS_M,
                margin_m: MARGIN_M,
                ..PlanSettings::default()
            },
            state: now.states.back().cloned(),
            camera: Some(now.camera),
            present: std::mem::take(&mut self.present),
            before: None,
        };
        let choice = plan(model, &context(model, now)?, input)?;
        let mut actions = choice.best.actions.into_iter();
        let first = actions.next().map_or_else(Vec::new, Vec::from);
        self.present = actions.collect();
        Ok(<[f32; 2]>::try_from(first).unwrap_or_default())
    }

    fn simulated(&mut self, now: &Situation<'_>) -> Result<[f32; 2], DriveError> {
        let [samples, iterations] = SIMULATED;
        let settings = SolverSettings {
            samples,
            iterations,
            seed: self.seed.derive("plan", now.frame).0,
            ..SolverSettings::default()
        };
        let present: Vec<f32> = self.present.iter().flat_map(Action::as_slice).copied().collect();
        let mut solver = settings.solver(SearchSpace::within(&LIMITS, SIMULATED_STEPS, &present, settings.seed()));
        let stop = vec![0.0; 2 * SIMULATED_STEPS];
        let mut best = (stop.clone(), simulated_cost(now, &stop));
        for _ in 0..iterations {
            let plans = solver.propose(samples);
            let scored: Vec<(Vec<f32>, f32)> = plans
                .into_par_iter()
                .map(|plan| {
                    let cost = simulated_cost(now, &plan);
                    (plan, cost)
                })
                .collect();
            for (plan, cost) in &scored {
                if *cost < best.1 {
                    best = (plan.clone(), *cost);
                }
            }
            solver.learn(&scored);
        }
        let commands = best.0.as_chunks::<2>().0;
        self.present = commands
            .iter()
            .skip(1)
            .map(|&command| action(command))
            .collect::<Result<_, _>>()?;
        Ok(commands.first().copied().unwrap_or_default())
    }
}

/// The cost of a plan by what really would happen: the costs and weights of the planner.
fn simulated_cost(now: &Situation<'_>, plan: &[f32]) -> f32 {
    let commands = plan.as_chunks::<2>().0;
    let steps = now.world.try_plan(commands);
    let start = now.world.observer_pose();
    let (sin, cos) = start.heading_rad.sin_cos();
    let [ahead, left] = now.goal_m;
    let goal = [
        start.x_m + cos * ahead - sin * left,
        start.y_m + sin * ahead + cos * left,
    ];
    let Some(end) = steps.last().map(|step| step.pose) else {
        return f32::INFINITY;
    };
    let distance = (goal[0] - end.x_m).hypot(goal[1] - end.y_m);
    let aim = start.heading_rad + left.atan2(ahead);
    let heading = wrap(aim - end.heading_rad).abs();
    let narrowest = steps.iter().map(|step| step.gap_m).fold(f32::INFINITY, f32::min);
    let touch = if steps.iter().any(|step| step.touched) {
        1.0
    } else {
        0.0
    };
    distance + HEADING_WEIGHT * heading + CLEARANCE_WEIGHT * ((MARGIN_M - narrowest).max(0.0) + touch)
}

fn context(model: &Model, now: &Situation<'_>) -> Result<PlanContext, DriveError> {
    let frames = now.frames.iter().cloned().collect();
    let past = now
        .states
        .iter()
        .take(now.states.len().saturating_sub(1))
        .cloned()
        .collect();
    let task = Task::rollout(frames, past, Some(now.camera), Vec::new(), &model.manifest)?;
    Ok(PlanContext::new(task))
}

fn action(command: [f32; 2]) -> Result<Action, DriveError> {
    Ok(Action::try_from(command.to_vec())?)
}
