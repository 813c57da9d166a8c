//! What chooses the commands. All drivers know where the goal is, and have the same limits.

use std::time::Duration;

use super::error::DriveError;
use super::known::KnownMovers;
use super::settings::DriverKind;
use super::simulated::best_commands;
use super::situation::{LIMITS, MARGIN_M, Situation, action, in_room};
use super::tracks::{MoverTracks, Viewpoint};
use foreframe_core::planning::{Goal, Obstacles, PlanSettings, PlannerInput, SolverSettings, plan_around};
use foreframe_core::registry::Model;
use foreframe_core::types::{Action, Seed};
use foreframe_sim::pid::{Gains, Pid};

/// Radius of the robot, in metres.
const RADIUS_M: f32 = 0.18;
/// The distance at which the driver `stop` stops, in metres.
const STOP_MARGIN_M: f32 = 0.05;

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
    /// The way of the last plan, in the room; empty for drivers that do not plan.
    way_m: Vec<[f32; 2]>,
    tracks: MoverTracks,
    known: KnownMovers,
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
            way_m: Vec::new(),
            tracks: MoverTracks::default(),
            known: KnownMovers::default(),
        }
    }

    /// The way of the plan that the last command is from, in the room; empty for drivers that do not plan.
    pub(super) fn way_m(&self) -> &[[f32; 2]] {
        &self.way_m
    }

    /// The next command, m/s and rad/s.
    pub(super) fn command(&mut self, now: &Situation<'_>) -> Result<[f32; 2], DriveError> {
        match (self.kind, self.model) {
            (DriverKind::Stop, Some(model)) => self.stop_and_go(model, now),
            (DriverKind::Plan | DriverKind::Velocity | DriverKind::Visible | DriverKind::Places, Some(model)) => {
                self.planned(model, now)
            }
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
        let seen = now.occupancy(model)?;
        let obstacles = Obstacles::new(&seen, now.camera.height_m, PlanSettings::default().robot_height_m).as_now();
        let state = now
            .states
            .back()
            .cloned()
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
                predicts_plans: false,
                radius_m: RADIUS_M,
                margin_m: MARGIN_M,
                ..PlanSettings::default()
            },
            state: now.states.back().cloned(),
            camera: Some(now.camera),
            present: std::mem::take(&mut self.present),
            before: None,
        };
        let (tracks, known, pose) = (&mut self.tracks, &mut self.known, now.world.observer_pose());
        let kind = self.kind;
        let viewpoint = Viewpoint {
            pose,
            view_rad: now.camera.horizontal_fov_rad / 2.0,
            period_s: self.period_s,
        };
        let choice = plan_around(model, &now.context(model)?, input, &mut |occupancy| {
            let movers = &mut occupancy.movers;
            match kind {
                DriverKind::Velocity => tracks.extrapolate(movers, viewpoint),
                DriverKind::Visible => {
                    known.extrapolate(movers, now.world, &|robot| now.views.saw(robot + 1, now.frame, 0));
                }
                DriverKind::Places => known.extrapolate(movers, now.world, &|_| true),
                _ => {}
            }
        })?;
        let way = choice.best.motion.unwrap_or_default();
        self.way_m = way
            .iter()
            .map(|&[_, ahead, left]| in_room(pose, [ahead, left]))
            .collect();
        let mut actions = choice.best.actions.into_iter();
        let first = actions.next().map_or_else(Vec::new, Vec::from);
        self.present = actions.collect();
        Ok(<[f32; 2]>::try_from(first).unwrap_or_default())
    }

    fn simulated(&mut self, now: &Situation<'_>) -> Result<[f32; 2], DriveError> {
        let present: Vec<f32> = self.present.iter().flat_map(Action::as_slice).copied().collect();
        let commands = best_commands(now, &present, self.seed.derive("plan", now.frame).0);
        let steps = now.world.try_plan(&commands);
        self.way_m = steps.iter().map(|step| [step.pose.x_m, step.pose.y_m]).collect();
        self.present = commands
            .iter()
            .skip(1)
            .map(|&command| action(command))
            .collect::<Result<_, _>>()?;
        Ok(commands.first().copied().unwrap_or_default())
    }
}
