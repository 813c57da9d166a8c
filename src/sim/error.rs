//! Why a world was not made or a step not taken.

use super::scenario;
use crate::frame::{FrameError, MAX_SIDE_PX};
use crate::types::ValueError;

/// Why a world was not made or a step not taken.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SimError {
    /// No scenario has that name.
    #[error("there is no scenario \"{name}\"; there are {}", scenario::names())]
    UnknownScenario {
        /// The name given.
        name: String,
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
    #[error("an action of {found} components was given; it takes 2: linear (m/s) and angular (rad/s)")]
    ActionLength {
        /// Components given.
        found: usize,
    },
    /// The trial has ended.
    #[error("the trial has ended; reset to begin another")]
    Ended,
    /// A step was asked of an environment that was never reset.
    #[error("the environment was never reset; reset it before the first step")]
    NotReset,
    /// A number that is not finite reached an action or a state.
    #[error(transparent)]
    Value(#[from] ValueError),
    /// The camera's picture is no frame.
    #[error(transparent)]
    Frame(#[from] FrameError),
}
