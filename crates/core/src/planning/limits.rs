//! How large actions may be, and how fast they may change.

use serde::{Deserialize, Serialize};

use super::error::PlanError;
use crate::registry::Manifest;

/// The largest limit.
const MAX_LIMIT: f32 = 1e6;

/// The limits of one action channel, in its unit.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct ActionLimit {
    /// Smallest value, at least -1,000,000.
    pub low: f32,
    /// Largest value, at most 1,000,000.
    pub high: f32,
    /// Largest change from one step to the next. Absent: any.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub max_change: Option<f32>,
}

/// The limits of a model's action channels, in their order.
#[derive(Clone, Debug, PartialEq)]
pub struct ActionLimits {
    channels: Vec<ActionLimit>,
    /// The action that acted before the plan, from which the first change is counted.
    before: Option<Vec<f32>>,
}

impl ActionLimits {
    /// The given limits; without them, the ranges of the training, as the manifest has them. Errors: `NoLimits`, `Channels`,
    /// `OutOfRange`.
    pub fn new(
        given: Option<Vec<ActionLimit>>,
        before: Option<Vec<f32>>,
        manifest: &Manifest,
    ) -> Result<Self, PlanError> {
        let expected = manifest.spec.actions.len();
        let of_training = || {
            let ranges = &manifest.calibration.as_ref()?.actions;
            let limit = |range: &crate::registry::calibration::ValueRange| ActionLimit {
                low: range.min,
                high: range.max,
                max_change: None,
            };
            Some(ranges.iter().map(limit).collect())
        };
        let channels: Vec<ActionLimit> = given.or_else(of_training).ok_or_else(|| PlanError::NoLimits {
            model: manifest.name.clone(),
        })?;
        let counts = [
            ("limits", Some(channels.len())),
            ("action", before.as_ref().map(Vec::len)),
        ];
        for (field, found) in counts {
            if let Some(found) = found.filter(|&found| found != expected) {
                return Err(PlanError::Channels {
                    field: field.to_owned(),
                    found,
                    model: manifest.name.clone(),
                    expected,
                });
            }
        }
        for (index, limit) in channels.iter().enumerate() {
            limit.check(index)?;
        }
        Ok(Self { channels, before })
    }

    /// Limits that are known to be right.
    pub(super) fn of_channels(channels: Vec<ActionLimit>) -> Self {
        Self { channels, before: None }
    }

    /// The channels' limits.
    #[must_use]
    pub fn channels(&self) -> &[ActionLimit] {
        &self.channels
    }

    /// The same limits, but a robot may also stop where its actions otherwise have to be larger.
    pub(super) fn with_zero(&self) -> Self {
        let mut limits = self.clone();
        for limit in &mut limits.channels {
            (limit.low, limit.high) = (limit.low.min(0.0), limit.high.max(0.0));
        }
        limits
    }

    /// Moves the actions of a plan into the limits, step after step.
    pub(super) fn enforce(&self, plan: &mut [f32]) {
        let mut before = self.before.clone();
        for action in plan.chunks_exact_mut(self.channels.len()) {
            for (index, (value, limit)) in action.iter_mut().zip(&self.channels).enumerate() {
                let (mut low, mut high) = (limit.low, limit.high);
                if let (Some(before), Some(change)) = (before.as_ref().map(|before| before[index]), limit.max_change) {
                    // Where the robot now moves faster than allowed, it slows down as fast as it may.
                    low = low.max(before - change).min(before + change);
                    high = high.min(before + change).max(before - change);
                }
                *value = value.clamp(low.min(high), high.max(low));
            }
            before = Some(action.to_vec());
        }
    }
}

impl ActionLimit {
    fn check(&self, index: usize) -> Result<(), PlanError> {
        let wrong = |part: &str, value: f32, range: String| PlanError::OutOfRange {
            field: format!("limits[{index}].{part}"),
            value: f64::from(value),
            range,
        };
        if !(-MAX_LIMIT..=MAX_LIMIT).contains(&self.low) {
            return Err(wrong("low", self.low, format!("-{MAX_LIMIT} to {MAX_LIMIT}")));
        }
        if !(self.low..=MAX_LIMIT).contains(&self.high) {
            let range = format!("at least limits[{index}].low, {}, and at most {MAX_LIMIT}", self.low);
            return Err(wrong("high", self.high, range));
        }
        match self.max_change {
            Some(change) if !(change > 0.0 && change <= MAX_LIMIT) => {
                Err(wrong("max_change", change, format!("above 0 and at most {MAX_LIMIT}")))
            }
            _ => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::serving::test_model;

    fn limits(max_change: Option<f32>, before: Option<Vec<f32>>) -> Result<ActionLimits, PlanError> {
        let limit = ActionLimit {
            low: -1.0,
            high: 2.0,
            max_change,
        };
        ActionLimits::new(Some(vec![limit]), before, &test_model().manifest)
    }

    #[test]
    fn a_plan_is_moved_into_the_limits() {
        let mut plan = [5.0, -5.0, 0.5];
        limits(None, None).unwrap().enforce(&mut plan);
        assert_eq!(plan, [2.0, -1.0, 0.5]);
        let mut plan = [5.0, -5.0, 0.5];
        limits(Some(0.5), Some(vec![0.0])).unwrap().enforce(&mut plan);
        assert_eq!(plan, [0.5, 0.0, 0.5]);
        // From outside the limits, the way back is as slow as any change.
        let mut plan = [0.0, 0.0, 0.0];
        limits(Some(0.5), Some(vec![3.0])).unwrap().enforce(&mut plan);
        assert_eq!(plan, [2.5, 2.0, 1.5]);
    }

    #[test]
    fn wrong_limits_are_refused_with_their_field() {
        let refused = |found: Result<ActionLimits, PlanError>| found.unwrap_err().to_string();
        assert_eq!(
            refused(limits(Some(0.0), None)),
            "limits[0].max_change is 0; it must be above 0 and at most 1000000"
        );
        assert_eq!(
            refused(limits(None, Some(vec![0.0, 1.0]))),
            "action has 2 entries; model \"test\" has 1 action channels"
        );
        for (low, high) in [(-3e38, 0.0), (0.0, 3e38), (f32::NAN, 0.0), (1.0, 0.0)] {
            let limit = ActionLimit {
                low,
                high,
                max_change: None,
            };
            let found = ActionLimits::new(Some(vec![limit]), None, &test_model().manifest);
            assert!(refused(found).starts_with("limits[0]."), "{low} {high}");
        }
        let unknown = refused(ActionLimits::new(None, None, &test_model().manifest));
        assert!(unknown.contains("not calibrated"), "{unknown}");
    }
}
