//! The scenarios, what is drawn for a trial of one, and which trials are kept for the test on unseen ways and gains.

use std::fmt;
use std::ops::Range;
use std::str::FromStr;

use rand::Rng;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use super::config::in_range;
use super::pid::Gains;
use super::{PlanarPose, SimError, arena, robot};
use crate::types::Seed;

/// (start, goal) pairs of Tb2 that no training sees; their ways cross others.
pub const HELD_OUT_PAIRS: [(usize, usize); 2] = [(1, 0), (2, 3)];
/// Tb2's proportional heading gains, drawn evenly.
pub const HEADING_GAIN: Range<f32> = 1.2..4.0;
/// The tenth of [`HEADING_GAIN`] that no training sees.
pub const HELD_OUT_HEADING_GAIN: Range<f32> = 2.44..2.72;
/// Movers in `crowded` besides Tb2.
const CROWD: usize = 3;
/// Most movers besides Tb2 that parameters written by hand may ask for.
const MAX_CROWD: usize = 16;

/// Who moves, and when a trial ends.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "server", derive(utoipa::ToSchema))]
#[serde(rename_all = "kebab-case")]
pub enum Scenario {
    /// The paper's: Tb1 stands still; the trial ends when Tb2 reaches its goal.
    StaticObserver,
    /// Tb1 drives too; Tb2 takes another goal when it reaches one, until the time is over.
    MovingObserver,
    /// Like `moving-observer` with three more movers.
    Crowded,
}

impl Scenario {
    /// All there are.
    pub const ALL: [Self; 3] = [Self::StaticObserver, Self::MovingObserver, Self::Crowded];

    /// Its name on the command line and on disk.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::StaticObserver => "static-observer",
            Self::MovingObserver => "moving-observer",
            Self::Crowded => "crowded",
        }
    }

    /// Whether Tb1 moves.
    #[must_use]
    pub fn observer_drives(self) -> bool {
        self != Self::StaticObserver
    }
}

/// The scenarios' names, as a list for messages.
pub(super) fn names() -> String {
    Scenario::ALL.map(Scenario::name).join(", ")
}

impl fmt::Display for Scenario {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str(self.name())
    }
}

impl FromStr for Scenario {
    type Err = SimError;

    fn from_str(name: &str) -> Result<Self, SimError> {
        let found = Self::ALL.into_iter().find(|scenario| scenario.name() == name);
        found.ok_or_else(|| SimError::UnknownScenario { name: name.to_owned() })
    }
}

/// How a mover is driven: a controller for its heading, one for its distance, and its own top speed.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "server", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct PidGains {
    /// From heading error (rad) to angular velocity (rad/s).
    pub heading: Gains,
    /// From distance to the goal (m) to linear velocity (m/s).
    pub distance: Gains,
    /// The linear velocity's limit, in metres a second.
    pub max_linear_m_s: f32,
}

impl PidGains {
    fn draw(random: &mut ChaCha8Rng) -> Self {
        Self {
            heading: Gains {
                proportional: random.random_range(HEADING_GAIN),
                integral: random.random_range(0.0..3.0),
                derivative: random.random_range(0.0..0.2),
            },
            distance: Gains {
                proportional: random.random_range(0.5..1.1),
                integral: random.random_range(0.0..0.1),
                derivative: random.random_range(0.0..0.1),
            },
            max_linear_m_s: random.random_range(0.3..0.6),
        }
    }
}

/// Where a mover begins, where it goes first, and how.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "server", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct Route {
    /// At the beginning.
    pub pose: PlanarPose,
    /// The first goal, [x, y].
    pub goal_m: [f32; 2],
    /// How it is driven.
    pub gains: PidGains,
}

/// All that was drawn for a trial.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "server", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct TrialParameters {
    /// Who moves.
    pub scenario: Scenario,
    /// Position in the seed's sequence.
    pub trial: u64,
    /// Of the sequence.
    #[cfg_attr(feature = "server", schema(value_type = u64))]
    pub seed: Seed,
    /// Tb2's start, an index of [`arena::STARTS_M`].
    pub start: usize,
    /// Tb2's (first) goal, an index of [`arena::GOALS_M`].
    pub goal: usize,
    /// How Tb2 is driven.
    pub gains: PidGains,
    /// Tb2's heading at the start, in radians.
    pub start_heading_rad: f32,
    /// Where Tb1 begins.
    pub observer: PlanarPose,
    /// The further movers (`crowded`).
    pub crowd: Vec<Route>,
}

impl TrialParameters {
    /// Draws trial `trial` of the seed's sequence, without drawing those before it.
    #[must_use]
    pub fn draw(scenario: Scenario, seed: Seed, trial: u64) -> Self {
        let mut random = seed.derive("trial", trial).rng();
        let start = random.random_range(0..arena::STARTS_M.len());
        let goal = random.random_range(0..arena::GOALS_M.len());
        let gains = PidGains::draw(&mut random);
        let start_m = arena::STARTS_M[start];
        let ahead = facing(start_m, arena::GOALS_M[goal]);
        let start_heading_rad = robot::wrap(ahead + random.random_range(-1.5..1.5));
        let mut taken = vec![start_m];
        let observer = if scenario.observer_drives() {
            let place = free_place(&mut random, &taken, 1.0);
            taken.push(place);
            let heading = facing(place, start_m) + random.random_range(-0.6..0.6);
            pose(place, robot::wrap(heading))
        } else {
            arena::OBSERVER
        };
        let crowd_size = if scenario == Scenario::Crowded { CROWD } else { 0 };
        let crowd = (0..crowd_size)
            .map(|_| {
                let place = free_place(&mut random, &taken, 0.6);
                taken.push(place);
                Route {
                    pose: pose(place, random.random_range(-3.1..3.1)),
                    goal_m: arena::GOALS_M[random.random_range(0..arena::GOALS_M.len())],
                    gains: PidGains::draw(&mut random),
                }
            })
            .collect();
        Self {
            scenario,
            trial,
            seed,
            start,
            goal,
            gains,
            start_heading_rad,
            observer,
            crowd,
        }
    }

    /// Errors: `Setting` where parameters that were written by hand name a start or goal that is not there, place a robot
    /// outside the room, or crowd it.
    pub fn validate(&self) -> Result<(), SimError> {
        in_range("start", self.start as f64, 0.0, arena::STARTS_M.len() as f64 - 1.0)?;
        in_range("goal", self.goal as f64, 0.0, arena::GOALS_M.len() as f64 - 1.0)?;
        in_range("crowd's size", self.crowd.len() as f64, 0.0, MAX_CROWD as f64)?;
        for pose in self.crowd.iter().map(|route| route.pose).chain([self.observer]) {
            in_range("x_m", f64::from(pose.x_m), 0.0, f64::from(arena::LENGTH_M))?;
            let side = f64::from(arena::WIDTH_M) / 2.0;
            in_range("y_m", f64::from(pose.y_m), -side, side)?;
            in_range("heading_rad", f64::from(pose.heading_rad), -7.0, 7.0)?;
        }
        Ok(())
    }

    /// Whether the trial belongs to those that no training may see, by its start/goal pair or its heading gain. Where
    /// Tb2 goes on to further goals, the first pair counts.
    #[must_use]
    pub fn is_held_out(&self) -> bool {
        self.has_held_out_pair() || HELD_OUT_HEADING_GAIN.contains(&self.gains.heading.proportional)
    }

    /// Whether the trial's start/goal pair is one of [`HELD_OUT_PAIRS`].
    #[must_use]
    pub fn has_held_out_pair(&self) -> bool {
        HELD_OUT_PAIRS.contains(&(self.start, self.goal))
    }

    /// Tb2's way first, then the crowd's.
    pub(super) fn routes(&self) -> Vec<Route> {
        let start_m = arena::STARTS_M.get(self.start).copied().unwrap_or(arena::STARTS_M[0]);
        let goal_m = arena::GOALS_M.get(self.goal).copied().unwrap_or(arena::GOALS_M[0]);
        let tb2 = Route {
            pose: pose(start_m, self.start_heading_rad),
            goal_m,
            gains: self.gains,
        };
        std::iter::once(tb2).chain(self.crowd.iter().copied()).collect()
    }

    /// A generator of the trial's own for that use.
    pub(super) fn stream(&self, name: &str, index: u64) -> ChaCha8Rng {
        self.seed.derive("trial", self.trial).derive(name, index).rng()
    }
}

fn pose([x_m, y_m]: [f32; 2], heading_rad: f32) -> PlanarPose {
    PlanarPose { x_m, y_m, heading_rad }
}

/// Heading from one point to another.
fn facing(from: [f32; 2], to: [f32; 2]) -> f32 {
    (to[1] - from[1]).atan2(to[0] - from[0])
}

/// A place in the room away from walls and pillars, `apart` metres from those taken.
fn free_place(random: &mut ChaCha8Rng, taken: &[[f32; 2]], apart: f32) -> [f32; 2] {
    loop {
        let x = random.random_range(0.4..arena::LENGTH_M - 0.4);
        let y = random.random_range(0.4 - arena::WIDTH_M / 2.0..arena::WIDTH_M / 2.0 - 0.4);
        let pillars = arena::PILLARS
            .iter()
            .all(|pillar| arena::distance(pillar.position_m, [x, y]) > pillar.radius_m + 0.3);
        if pillars && taken.iter().all(|&other| arena::distance(other, [x, y]) >= apart) {
            return [x, y];
        }
    }
}
