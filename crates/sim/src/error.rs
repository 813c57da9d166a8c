//! Errors of the simulator.

use foreframe_core::error_kind::{ErrorKind, HasErrorKind};
use foreframe_core::frame::{FrameError, MAX_SIDE_PX};
use foreframe_core::types::ValueError;

/// Why a world could not be created or a step could not be simulated.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SimError {
    /// No scenario has this name.
    #[error("there is no scenario \"{name}\"; there are {known}")]
    UnknownScenario {
        /// The name given.
        name: String,
        /// The names of all scenarios.
        known: String,
    },
    /// No look has this name.
    #[error("there is no look \"{name}\"; there are gray and bright")]
    UnknownLook {
        /// The name given.
        name: String,
    },
    /// No set of rooms has this name.
    #[error("there are no rooms \"{name}\"; there are {known}")]
    UnknownRooms {
        /// The name given.
        name: String,
        /// The names of all sets.
        known: String,
    },
    /// A frame side is zero or too large.
    #[error("a frame of {width}×{height} px is out of range; each side must be 1 to {max} px", max = MAX_SIDE_PX)]
    FrameSize {
        /// Width in pixels.
        width: u32,
        /// Height in pixels.
        height: u32,
    },
    /// A setting is out of range.
    #[error("{name} is {value}; it must be {rule}")]
    Setting {
        /// The field of `WorldConfig` or `TrialParameters`.
        name: &'static str,
        /// The value found.
        value: f64,
        /// What would be right.
        rule: String,
    },
    /// An action has the wrong number of components.
    #[error("the action has {found} components; it must have 2: linear (m/s) and angular (rad/s)")]
    ActionLength {
        /// Components given.
        found: usize,
    },
    /// The trial has ended.
    #[error("the trial has ended; reset the environment to start another trial")]
    Ended,
    /// An environment got a step before its first reset.
    #[error("the environment has not been reset; reset it before the first step")]
    NotReset,
    /// An action or a state contains an invalid number.
    #[error(transparent)]
    Value(#[from] ValueError),
    /// The camera's image is not a valid frame.
    #[error(transparent)]
    Frame(#[from] FrameError),
}

impl HasErrorKind for SimError {
    fn kind(&self) -> ErrorKind {
        match self {
            Self::Ended | Self::NotReset => ErrorKind::Conflict,
            Self::Frame(_) => ErrorKind::Internal,
            _ => ErrorKind::Usage,
        }
    }
}
