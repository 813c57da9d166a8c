//! Why a drive was refused or stopped.

use foreframe_core::error_kind::{ErrorKind, HasErrorKind};
use foreframe_core::frame::FrameError;
use foreframe_core::nn::NnError;
use foreframe_core::planning::PlanError;
use foreframe_core::serving::{InputError, ServingError};
use foreframe_core::types::{ModelName, ValueError};
use foreframe_sim::{Scenario, SimError};

/// What was wrong, and what would be right.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum DriveError {
    /// A driver that sees or plans with a model.
    #[error("driver {driver} needs a model; name one")]
    NoModel {
        /// The driver.
        driver: &'static str,
    },
    /// A driver that sees how far away things are.
    #[error("driver {driver} needs a model that estimates depth; model \"{model}\" does not")]
    NoDepth {
        /// The driver.
        driver: &'static str,
        /// The model.
        model: ModelName,
    },
    /// A driver that follows movers.
    #[error("driver {driver} needs a model that finds movers; model \"{model}\" does not")]
    NoMovers {
        /// The driver.
        driver: &'static str,
        /// The model.
        model: ModelName,
    },
    /// The robot with the camera stands still there.
    #[error("in {scenario}, the robot with the camera does not drive; choose moving-observer, crowded or crossing")]
    Standing {
        /// The scenario.
        scenario: Scenario,
    },
    /// No driver.
    #[error("drivers is empty; name at least one of pid, stop, velocity, visible, places, plan and simulator")]
    NoDriver,
    /// The actions of the model are not those of the robot.
    #[error(
        "model \"{model}\" takes other actions or states than the simulated robot has: linear m/s and angular rad/s"
    )]
    OtherRobot {
        /// The model.
        model: ModelName,
    },
    /// None of the rooms that were drawn for an episode has a goal.
    #[error(
        "episode {episode} has no place that the robot can drive to in any of the rooms drawn for it; choose another seed"
    )]
    NoGoal {
        /// The episode.
        episode: usize,
    },
    /// The simulator refused something.
    #[error(transparent)]
    Sim(#[from] SimError),
    /// A search failed.
    #[error(transparent)]
    Plan(#[from] PlanError),
    /// An input does not fit the model.
    #[error(transparent)]
    Input(#[from] InputError),
    /// A prediction failed.
    #[error(transparent)]
    Prediction(#[from] ServingError),
    /// The network failed.
    #[error("the motion of a plan could not be computed")]
    Network(#[from] NnError),
    /// A picture of an episode could not be drawn.
    #[error("the picture of an episode could not be drawn")]
    Picture(#[from] FrameError),
    /// A command is not a number.
    #[error(transparent)]
    Action(#[from] ValueError),
}

impl HasErrorKind for DriveError {
    fn kind(&self) -> ErrorKind {
        match self {
            Self::Sim(error) => error.kind(),
            Self::Plan(error) => error.kind(),
            Self::Prediction(error) => error.kind(),
            Self::Network(_) | Self::Picture(_) | Self::Action(_) => ErrorKind::Internal,
            _ => ErrorKind::Usage,
        }
    }
}
