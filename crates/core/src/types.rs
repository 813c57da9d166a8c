//! Values that every module uses: seeds, names, actions, states and channels. They are validated once, when they are made.

mod named_enum;
mod names;

use std::fmt;

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

pub use self::names::{DatasetName, ModelName};

/// Why a value was refused.
#[derive(Debug, thiserror::Error, PartialEq)]
#[non_exhaustive]
pub enum ValueError {
    /// An action or state held NaN, an infinity, or a number beyond [`MAX_MAGNITUDE`].
    #[error("{kind} component {index} is {value}; every component must be a number from -1e30 to 1e30")]
    OutOfRange {
        /// `action` or `state`.
        kind: &'static str,
        /// Position in the vector.
        index: usize,
        /// The value found.
        value: f32,
    },
    /// A text is no valid name of a model or a data set.
    #[error(
        "{0:?} is not a valid name; a name has 1 to 64 characters of a to z, 0 to 9 and -, and does not start with -"
    )]
    Name(String),
}

/// The greatest magnitude of a component of an action or a state. It stays finite when it is scaled and weighted in a
/// network, so that no accepted value makes a prediction NaN.
pub const MAX_MAGNITUDE: f32 = 1e30;

/// The start of all random numbers of one run: the same seed gives the same bytes on the same machine.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Seed(pub u64);

impl Seed {
    /// A separate seed for item `index` of the named stream. So no two uses share random numbers, and an item can be
    /// made without the items before it.
    #[must_use]
    pub fn derive(self, stream: &str, index: u64) -> Self {
        let named = stream
            .bytes()
            .fold(mix(self.0), |hash, byte| mix(hash ^ u64::from(byte)));
        Self(mix(named ^ index))
    }

    /// A generator that starts from this seed.
    #[must_use]
    pub fn rng(self) -> ChaCha8Rng {
        ChaCha8Rng::seed_from_u64(self.0)
    }
}

/// SplitMix64's output function (Steele, Lea & Flood 2014): every input bit changes every output bit.
fn mix(value: u64) -> u64 {
    let z = value.wrapping_add(0x9E37_79B9_7F4A_7C15);
    let z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    let z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^ (z >> 31)
}

macro_rules! finite_vector {
    ($(#[$doc:meta])* $name:ident, $kind:literal) => {
        $(#[$doc])*
        #[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
        #[serde(try_from = "Vec<f32>", into = "Vec<f32>")]
        pub struct $name(Vec<f32>);

        impl $name {
            /// The components, in the order of the channels of the model or the data set.
            #[must_use]
            pub fn as_slice(&self) -> &[f32] {
                &self.0
            }
        }

        impl TryFrom<Vec<f32>> for $name {
            type Error = ValueError;

            fn try_from(values: Vec<f32>) -> Result<Self, ValueError> {
                // A range never contains NaN.
                let is_in_range = |value: &f32| (-MAX_MAGNITUDE..=MAX_MAGNITUDE).contains(value);
                match values.iter().position(|value| !is_in_range(value)) {
                    Some(index) => Err(ValueError::OutOfRange { kind: $kind, index, value: values[index] }),
                    None => Ok(Self(values)),
                }
            }
        }

        impl From<$name> for Vec<f32> {
            fn from(vector: $name) -> Self {
                vector.0
            }
        }
    };
}

finite_vector!(
    /// The command that acts from one frame to the next: numbers up to [`MAX_MAGNITUDE`], in the order and units of the
    /// [`Channel`]s.
    Action,
    "action"
);
finite_vector!(
    /// What the robot measures about itself when a frame is taken: numbers up to [`MAX_MAGNITUDE`], in the order and
    /// units of the [`Channel`]s.
    RobotState,
    "state"
);

/// Name and unit of one component of an action or a state.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(deny_unknown_fields)]
pub struct Channel {
    /// What the component is, for example `linear`.
    pub name: String,
    /// Its unit, for example `m/s`; empty where it has none.
    pub unit: String,
}

impl Channel {
    /// A channel with this name and unit.
    #[must_use]
    pub fn new(name: &str, unit: &str) -> Self {
        Self {
            name: name.to_owned(),
            unit: unit.to_owned(),
        }
    }
}

impl fmt::Display for Channel {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let space = if self.unit.is_empty() { "" } else { " " };
        write!(f, "{}{space}{}", self.name, self.unit)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn derived_seeds_differ_by_stream_and_index() {
        let seed = Seed(7);
        assert_ne!(seed.derive("trial", 0), seed.derive("trial", 1));
        assert_ne!(seed.derive("trial", 0), seed.derive("noise", 0));
        assert_eq!(seed.derive("trial", 3), seed.derive("trial", 3));
    }

    #[test]
    fn an_action_with_nan_is_refused_with_its_position() {
        let error = Action::try_from(vec![0.0, f32::NAN]).unwrap_err();
        assert!(error.to_string().starts_with("action component 1 is NaN"));
        assert!(Action::try_from(vec![f32::MAX]).is_err() && Action::try_from(vec![-1e30]).is_ok());
    }
}
