//! Which episodes are driven, and by whom.

use std::time::Duration;

use serde::{Deserialize, Serialize};

use super::error::DriveError;
use foreframe_core::named_enum;
use foreframe_core::registry::Model;
use foreframe_core::types::Seed;
use foreframe_sim::{RoomSet, Scenario, action_channels, state_channels};

named_enum! {
    /// What chooses the commands.
    #[derive(Serialize, Deserialize)]
    #[serde(rename_all = "kebab-case")]
    pub enum DriverKind {
        /// Straight to the goal, by two PID controllers; sees nothing.
        Pid = "pid",
        /// As `pid`, but stands while the model's depth network sees something on its way within the next second.
        Stop = "stop",
        /// As `plan`, but movers are expected to go on as fast as in the last frames, instead of as the model predicts. Those that
        /// have left the picture are remembered.
        Velocity = "velocity",
        /// As `velocity`, but knows the true place, size and speed of each robot that the camera shows now, and remembers none.
        Visible = "visible",
        /// As `visible`, but knows that of every robot, also of those that the camera does not show.
        Places = "places",
        /// Follows the plan that the model finds, and plans anew at every frame.
        Plan = "plan",
        /// Plans with the simulator itself as the model: it knows where everything will be. The upper limit.
        Simulator = "simulator",
    }
    else |name| -> String {
        format!("there is no driver {name:?}; there are: {}", Self::ALL.map(Self::name).join(", "))
    }
}

/// Which episodes are driven, and by whom.
#[derive(Clone, Debug)]
pub struct DriveSettings {
    /// The scenario; in it, the robot with the camera must drive.
    pub scenario: Scenario,
    /// Each trial in a room of its own from that set; without it, all are in the same room.
    pub rooms: Option<RoomSet>,
    /// Number of episodes.
    pub episodes: usize,
    /// The seed of episodes, goals and plans.
    pub seed: Seed,
    /// The drivers; each drives all episodes.
    pub drivers: Vec<DriverKind>,
    /// Longest time of an episode, in seconds.
    pub duration_s: f64,
    /// Time for a plan of drivers that use a model; without it, searches are whole, and a drive can be repeated.
    pub budget: Option<Duration>,
}

impl Default for DriveSettings {
    fn default() -> Self {
        Self {
            scenario: Scenario::Crowded,
            rooms: None,
            episodes: 20,
            seed: Seed(0),
            drivers: vec![DriverKind::Pid],
            duration_s: 20.0,
            budget: None,
        }
    }
}

impl DriveSettings {
    /// Errors: `Standing`, `NoDriver`, `NoModel`, `NoDepth`, `NoMovers`, `OtherRobot`.
    pub(super) fn check(&self, model: Option<&Model>) -> Result<(), DriveError> {
        if !self.scenario.observer_drives() {
            return Err(DriveError::Standing {
                scenario: self.scenario,
            });
        }
        if self.drivers.is_empty() {
            return Err(DriveError::NoDriver);
        }
        for &driver in &self.drivers {
            if matches!(driver, DriverKind::Pid | DriverKind::Simulator) {
                continue;
            }
            let Some(model) = model else {
                return Err(DriveError::NoModel { driver: driver.name() });
            };
            let (spec, name) = (model.spec(), || model.manifest.name.clone());
            let units = |channels: &[foreframe_core::nn::ChannelScale]| -> Vec<String> {
                channels.iter().map(ToString::to_string).collect()
            };
            let own = |channels: Vec<foreframe_core::types::Channel>| -> Vec<String> {
                channels.iter().map(ToString::to_string).collect()
            };
            let fits = spec.action_inputs().is_some() && units(&spec.actions) == own(action_channels());
            let fits = fits && (spec.state_inputs().is_none() || units(&spec.states) == own(state_channels()));
            if !fits {
                return Err(DriveError::OtherRobot { model: name() });
            }
            if matches!(driver, DriverKind::Velocity | DriverKind::Visible | DriverKind::Places)
                && !spec.flow().is_some_and(|flow| flow.layers.movers)
            {
                return Err(DriveError::NoMovers {
                    driver: driver.name(),
                    model: name(),
                });
            }
            if driver == DriverKind::Stop && !spec.flow().is_some_and(|flow| flow.layers.depth) {
                return Err(DriveError::NoDepth {
                    driver: driver.name(),
                    model: name(),
                });
            }
        }
        Ok(())
    }
}
