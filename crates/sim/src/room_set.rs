//! The sets of rooms, by name. `rooms` draws them.

use serde::{Deserialize, Serialize};

use super::error::SimError;
use foreframe_core::named_enum;

named_enum! {
    /// Which rooms trials are in, where each trial has a room of its own.
    #[derive(Serialize, Deserialize)]
    #[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
    #[serde(rename_all = "kebab-case")]
    pub enum RoomSet {
        /// Rooms to train on. Other trials of the set are new rooms of the same kinds.
        Varied = "varied",
        /// Only for tests: the main surfaces have patterns, and the room has a kind of furniture, that `varied` never has.
        NewMaterials = "new-materials",
        /// Only for tests: cameras whose height, tilt and field of view are outside the ranges of `varied`.
        NewCameras = "new-cameras",
    }
    else |name| -> SimError {
        SimError::UnknownRooms { name: name.to_owned(), known: Self::ALL.map(Self::name).join(", ") }
    }
}

impl RoomSet {
    /// Whether no model may be trained in these rooms.
    #[must_use]
    pub fn is_only_for_tests(self) -> bool {
        self != Self::Varied
    }
}
