//! What another robot does: where it starts, where it goes, and the gains of its controllers.

use std::ops::Range;

use rand::Rng;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use super::pid::Gains;
use super::robot::PlanarPose;

/// Range of Tb2's proportional heading gain, drawn uniformly.
const HEADING_GAIN: Range<f32> = 1.2..4.0;

/// Gains of a robot's two PID controllers, for heading and distance, and its highest speed.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct PidGains {
    /// From heading error (rad) to angular velocity (rad/s).
    pub heading: Gains,
    /// From distance to the goal (m) to linear velocity (m/s).
    pub distance: Gains,
    /// Highest linear velocity, in m/s.
    pub max_linear_m_s: f32,
}

impl PidGains {
    pub(super) fn draw(random: &mut ChaCha8Rng) -> Self {
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

/// Start pose, first goal and controller gains of a robot.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct Route {
    /// Pose at the start.
    pub pose: PlanarPose,
    /// The first goal, [x, y].
    pub goal_m: [f32; 2],
    /// Gains of its controllers.
    pub gains: PidGains,
    /// For a robot that drives to and fro between its start and its goal: what else it does. Others get goals anywhere.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[doc(hidden)]
    pub crossing: Option<CrossingHabits>,
}

/// What a crossing robot does beside driving to and fro.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct CrossingHabits {
    /// It stands while Tb1 is close before it.
    pub reacts: bool,
    /// It halts now and then.
    pub halts: bool,
    /// It turns back now and then, before it has arrived.
    pub turns: bool,
}
