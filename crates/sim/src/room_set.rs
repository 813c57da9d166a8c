//! The sets of rooms, by name. `rooms` draws them.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use super::error::SimError;

/// Which rooms trials are in, where each trial has a room of its own.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(rename_all = "kebab-case")]
pub enum RoomSet {
    /// Rooms to train on. Other trials of the set are new rooms of the same kinds.
    Varied,
    /// Only for tests: the main surfaces have patterns, and the room has a kind of furniture, that `varied` never has.
    NewMaterials,
    /// Only for tests: cameras whose height, tilt and field of view are outside the ranges of `varied`.
    NewCameras,
}

impl RoomSet {
    /// All sets.
    pub const ALL: [Self; 3] = [Self::Varied, Self::NewMaterials, Self::NewCameras];

    /// The set's name, on the command line and on disk.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Varied => "varied",
            Self::NewMaterials => "new-materials",
            Self::NewCameras => "new-cameras",
        }
    }

    /// Whether no model may be trained in these rooms.
    #[must_use]
    pub fn is_only_for_tests(self) -> bool {
        self != Self::Varied
    }
}

impl fmt::Display for RoomSet {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str(self.name())
    }
}

impl FromStr for RoomSet {
    type Err = SimError;

    fn from_str(name: &str) -> Result<Self, Self::Err> {
        let found = Self::ALL.into_iter().find(|set| set.name() == name);
        found.ok_or_else(|| SimError::UnknownRooms {
            name: name.to_owned(),
            known: Self::ALL.map(Self::name).join(", "),
        })
    }
}
