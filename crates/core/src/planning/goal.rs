//! What a plan is to reach.

use serde::{Deserialize, Serialize};

use super::error::PlanError;
use crate::frame::Frame;

/// Farthest goal, in metres.
const FARTHEST_M: f32 = 1000.0;
/// Largest heading, in radians.
const MOST_RAD: f32 = 7.0;

/// What a plan is to reach, as seen from the robot at the last frame. At least one part is given.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Goal {
    /// Where the robot should get: metres ahead and to the left.
    pub position_m: Option<[f32; 2]>,
    /// Where it should look in the end: radians, counter-clockwise from where it looks now.
    pub heading_rad: Option<f32>,
    /// What its camera should show in the end, of the model's size.
    #[serde(skip)]
    pub image: Option<Frame>,
}

impl Goal {
    /// Errors: `NoGoal`, `OutOfRange`.
    pub(super) fn check(&self) -> Result<(), PlanError> {
        if self.position_m.is_none() && self.heading_rad.is_none() && self.image.is_none() {
            return Err(PlanError::NoGoal);
        }
        let values = [
            ("goal.position_m[0]", self.position_m.map(|place| place[0]), FARTHEST_M),
            ("goal.position_m[1]", self.position_m.map(|place| place[1]), FARTHEST_M),
            ("goal.heading_rad", self.heading_rad, MOST_RAD),
        ];
        for (field, value, most) in values {
            // NaN is in no range.
            if let Some(value) = value.filter(|value| !(-most..=most).contains(value)) {
                return Err(PlanError::OutOfRange {
                    field: field.to_owned(),
                    value: f64::from(value),
                    range: format!("-{most} to {most}"),
                });
            }
        }
        Ok(())
    }
}
