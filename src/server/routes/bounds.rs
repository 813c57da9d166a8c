//! The bounds of a channel in a description.

use serde::Serialize;

use foreframe_core::registry::calibration::ValueRange;

/// Lowest and highest value of a channel, in its unit.
#[derive(Debug, Serialize, utoipa::ToSchema)]
pub(super) struct ChannelBounds {
    /// Lowest.
    low: f32,
    /// Highest.
    high: f32,
}

impl ChannelBounds {
    /// From −`limit` to `limit`.
    pub(super) fn symmetric(limit: f32) -> Self {
        Self {
            low: -limit,
            high: limit,
        }
    }
}

impl From<ValueRange> for ChannelBounds {
    fn from(range: ValueRange) -> Self {
        Self {
            low: range.min,
            high: range.max,
        }
    }
}
