//! The components of actions and states, and how they are scaled for the network.

use std::fmt;

use serde::{Deserialize, Serialize};

use crate::types::Channel;

/// Smallest standard deviation used to scale a channel, in the channel's unit. It avoids division by zero for a constant
/// channel.
pub const MIN_CHANNEL_STD: f32 = 1e-3;
/// Standard deviations from the mean beyond which the flow network limits a value.
const MAX_DEVIATIONS: f32 = 1e6;

/// One component of an action or a state, and how it is scaled for the network: (value − mean) / std.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct ChannelScale {
    /// The component's name, for example `linear`.
    pub name: String,
    /// Its unit, for example `m/s`; empty if it has none.
    pub unit: String,
    /// Mean over the training data, in that unit.
    pub mean: f32,
    /// Standard deviation over the training data, in that unit; at least [`MIN_CHANNEL_STD`] is used.
    pub std: f32,
}

impl ChannelScale {
    /// The value, limited to [`MAX_DEVIATIONS`] standard deviations from the mean.
    pub(in crate::nn) fn limited(&self, value: f32) -> f32 {
        let most = MAX_DEVIATIONS * self.std.max(MIN_CHANNEL_STD);
        value.clamp(self.mean - most, self.mean + most)
    }

    /// The value scaled for the network: (value − mean) / std.
    #[must_use]
    pub fn scaled(&self, value: f32) -> f32 {
        (value - self.mean) / self.std.max(MIN_CHANNEL_STD)
    }
}

impl fmt::Display for ChannelScale {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        Channel::new(&self.name, &self.unit).fmt(f)
    }
}
