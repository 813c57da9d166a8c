//! The scenarios, the random parameters of a trial, and which trials are held out for the test on unseen start/goal pairs and
//! PID gains.

use std::ops::Range;

use rand::Rng;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use super::config::{CameraConfig, WorldConfig, in_range};
use super::error::SimError;
use super::robot::PlanarPose;
use super::room::Room;
use super::room_set::RoomSet;
use super::rooms::free_place;
use super::route::{PidGains, Route};
use super::{arena, crossing, robot};
use foreframe_core::named_enum;
use foreframe_core::types::Seed;

/// (start, goal) pairs of Tb2 that are never used for training. Their routes cross routes of the other pairs.
pub const HELD_OUT_PAIRS: [(usize, usize); 2] = [(1, 0), (2, 3)];
/// The tenth of the range of Tb2's heading gain that is never used for training.
pub const HELD_OUT_HEADING_GAIN: Range<f32> = 2.44..2.72;
/// Robots in `crowded` besides Tb1 and Tb2.
const CROWD: usize = 3;
/// Largest number of robots besides Tb1 and Tb2 in parameters written by hand.
const MAX_CROWD: usize = 16;

named_enum! {
    /// Which robots move, and when a trial ends.
    #[derive(Hash, Serialize, Deserialize)]
    #[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
    #[serde(rename_all = "kebab-case")]
    pub enum Scenario {
        /// The paper's scenario: Tb1 stands still; the trial ends when Tb2 reaches its goal.
        StaticObserver = "static-observer",
        /// Tb1 drives too. When Tb2 reaches its goal, it gets another one; the trial ends at its time limit.
        MovingObserver = "moving-observer",
        /// Like `moving-observer`, with three more robots.
        Crowded = "crowded",
        /// Like `moving-observer`, with one, four or eight more robots that drive to and fro across the way ahead of Tb1; some
        /// halt, turn back, or stand while Tb1 is close before them.
        Crossing = "crossing",
    }
    else |name| -> SimError {
        SimError::UnknownScenario { name: name.to_owned(), known: Self::ALL.map(Self::name).join(", ") }
    }
}

impl Scenario {
    /// Whether Tb1 drives.
    #[must_use]
    pub fn observer_drives(self) -> bool {
        self != Self::StaticObserver
    }

    /// Whether Tb2 gets other goals after its first one, from anywhere to anywhere.
    #[must_use]
    pub fn has_several_goals(self) -> bool {
        self != Self::StaticObserver
    }
}

/// The room and the camera of a trial that has its own.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct TrialRoom {
    /// The set of the room. The room itself is drawn again from the trial's seed and number.
    pub set: RoomSet,
    /// Tb1's camera.
    pub camera: CameraConfig,
}

/// All random parameters of a trial.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct TrialParameters {
    /// The scenario.
    pub scenario: Scenario,
    /// Number of the trial, counted from 0 for each seed.
    pub trial: u64,
    /// The seed of all trials.
    #[cfg_attr(feature = "schema", schema(value_type = u64))]
    pub seed: Seed,
    /// Tb2's start, an index of [`arena::STARTS_M`].
    pub start: usize,
    /// Tb2's (first) goal, an index of [`arena::GOALS_M`].
    pub goal: usize,
    /// Gains of Tb2's controllers.
    pub gains: PidGains,
    /// Tb2's heading at the start, in radians.
    pub start_heading_rad: f32,
    /// Tb1's pose at the start.
    pub observer: PlanarPose,
    /// The robots besides Tb1 and Tb2 (`crowded`).
    pub crowd: Vec<Route>,
    /// Its own room and camera; none where all trials are in the same room.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub room: Option<TrialRoom>,
}

impl TrialParameters {
    /// Draws the parameters of trial number `trial` of the seed, in the room of all trials. Other trials need not be drawn
    /// first.
    #[must_use]
    pub fn draw(scenario: Scenario, seed: Seed, trial: u64) -> Self {
        Self::draw_in(&WorldConfig::default(), scenario, seed, trial)
    }

    /// As [`Self::draw`], in a room of its own if the configuration has `rooms`.
    #[must_use]
    pub fn draw_in(config: &WorldConfig, scenario: Scenario, seed: Seed, trial: u64) -> Self {
        let own_room = config.rooms.map(|set| {
            let mut random = seed.derive("trial", trial).derive("camera", 0).rng();
            TrialRoom {
                set,
                camera: set.draw_camera(&mut random, config.camera.noise_std),
            }
        });
        let room = room(own_room.as_ref(), seed, trial);
        let mut random = seed.derive("trial", trial).rng();
        let start = random.random_range(0..arena::STARTS_M.len());
        let goal = random.random_range(0..arena::GOALS_M.len());
        let gains = PidGains::draw(&mut random);
        let start_m = room.starts_m[start];
        let ahead = facing(start_m, room.goals_m[goal]);
        let start_heading_rad = robot::wrap(ahead + random.random_range(-1.5..1.5));
        let mut taken = vec![start_m];
        // The free way ahead of Tb1, for those that cross it.
        let mut way_m = 0.0;
        let observer = if scenario.observer_drives() {
            let position = free_position(&room, &mut random, &taken, 1.0);
            taken.push(position);
            let heading = if scenario == Scenario::Crossing {
                let (heading, length_m) = crossing::free_heading(&room, position, &mut random);
                way_m = length_m;
                heading
            } else {
                facing(position, start_m) + random.random_range(-0.6..0.6)
            };
            pose(position, robot::wrap(heading))
        } else {
            standing_observer(&room, &mut random)
        };
        let crowd_size = match scenario {
            Scenario::Crowded => CROWD,
            Scenario::Crossing => crossing::COUNTS[(trial % crossing::COUNTS.len() as u64) as usize],
            Scenario::StaticObserver | Scenario::MovingObserver => 0,
        };
        let crowd = (0..crowd_size)
            .map(|_| {
                let crosses = scenario == Scenario::Crossing;
                let crossing = crosses.then(|| crossing::draw_route(&room, observer, way_m, &taken, &mut random));
                let route = crossing.flatten().unwrap_or_else(|| {
                    let position = free_position(&room, &mut random, &taken, 0.6);
                    Route {
                        pose: pose(position, random.random_range(-3.1..3.1)),
                        goal_m: room.goals_m[random.random_range(0..room.goals_m.len())],
                        gains: PidGains::draw(&mut random),
                        crossing: None,
                    }
                });
                taken.push(arena::position(route.pose));
                route
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
            room: own_room,
        }
    }

    /// Checks parameters that were written by hand. Errors: `Setting` if a start or goal does not exist, a robot is outside
    /// the room, or there are too many robots.
    pub fn validate(&self) -> Result<(), SimError> {
        in_range("start", self.start as f64, 0.0, arena::STARTS_M.len() as f64 - 1.0)?;
        in_range("goal", self.goal as f64, 0.0, arena::GOALS_M.len() as f64 - 1.0)?;
        in_range("crowd's size", self.crowd.len() as f64, 0.0, MAX_CROWD as f64)?;
        let room = self.room();
        if let Some(own) = &self.room {
            own.camera.validate(room.height_m)?;
        }
        for pose in self.crowd.iter().map(|route| route.pose).chain([self.observer]) {
            in_range("x_m", f64::from(pose.x_m), 0.0, f64::from(room.length_m))?;
            let side = f64::from(room.width_m) / 2.0;
            in_range("y_m", f64::from(pose.y_m), -side, side)?;
            in_range("heading_rad", f64::from(pose.heading_rad), -7.0, 7.0)?;
        }
        Ok(())
    }

    /// Whether the trial must not be used for training, because of its start/goal pair or its heading gain. If Tb2 drives to
    /// several goals, the first pair counts, though later ones may be pairs that are held out.
    #[must_use]
    pub fn is_held_out(&self) -> bool {
        self.has_held_out_pair() || HELD_OUT_HEADING_GAIN.contains(&self.gains.heading.proportional)
    }

    /// Whether the trial's start/goal pair is one of [`HELD_OUT_PAIRS`]. In rooms of their own, pairs have no meaning.
    #[must_use]
    pub fn has_held_out_pair(&self) -> bool {
        self.room.is_none() && HELD_OUT_PAIRS.contains(&(self.start, self.goal))
    }

    /// The route of Tb2, then those of the other robots. Call it only after [`Self::validate`] has passed.
    pub(super) fn routes(&self, room: &Room) -> Vec<Route> {
        let tb2 = Route {
            pose: pose(room.starts_m[self.start], self.start_heading_rad),
            goal_m: room.goals_m[self.goal],
            gains: self.gains,
            crossing: None,
        };
        std::iter::once(tb2).chain(self.crowd.iter().copied()).collect()
    }

    /// The room of the trial.
    pub(super) fn room(&self) -> Room {
        room(self.room.as_ref(), self.seed, self.trial)
    }

    /// A separate random generator of this trial for the named use.
    pub(super) fn stream(&self, name: &str, index: u64) -> ChaCha8Rng {
        self.seed.derive("trial", self.trial).derive(name, index).rng()
    }
}

/// The room of a trial.
fn room(own: Option<&TrialRoom>, seed: Seed, trial: u64) -> Room {
    own.map_or_else(Room::arena, |own| {
        let mut random = seed.derive("trial", trial).derive("room", 0).rng();
        own.set.draw_room(&mut random)
    })
}

/// Where Tb1 stands in a scenario where it does not drive. In a room of its own, that is a free place, and it looks in the direction of
/// a goal.
fn standing_observer(room: &Room, random: &mut ChaCha8Rng) -> PlanarPose {
    if !room.checks_ways {
        return arena::OBSERVER;
    }
    let position = free_place(room, random, &room.starts_m, 0.8);
    pose(position, facing(position, room.goals_m[0]))
}

fn pose([x_m, y_m]: [f32; 2], heading_rad: f32) -> PlanarPose {
    PlanarPose { x_m, y_m, heading_rad }
}

/// Heading from one point to another.
fn facing(from: [f32; 2], to: [f32; 2]) -> f32 {
    (to[1] - from[1]).atan2(to[0] - from[0])
}

/// A random position away from walls and pieces, at least `min_distance` metres from the positions `taken`.
fn free_position(room: &Room, random: &mut ChaCha8Rng, taken: &[[f32; 2]], min_distance: f32) -> [f32; 2] {
    if room.checks_ways {
        return free_place(room, random, taken, min_distance);
    }
    loop {
        let x = random.random_range(0.4..arena::LENGTH_M - 0.4);
        let y = random.random_range(0.4 - arena::WIDTH_M / 2.0..arena::WIDTH_M / 2.0 - 0.4);
        let to = |other| arena::distance(other, [x, y]);
        let clears = |pillar: &arena::Pillar| to(pillar.position_m) > pillar.radius_m + 0.3;
        if arena::PILLARS.iter().all(clears) && taken.iter().all(|&other| to(other) >= min_distance) {
            return [x, y];
        }
    }
}
