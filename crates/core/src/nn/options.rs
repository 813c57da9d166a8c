//! The options of a model that have names: in manifests, in settings and in messages.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

/// No value of an enumeration has this name.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("unknown {kind} \"{name}\"; there are {known}")]
pub struct UnknownName {
    /// The enumeration.
    pub kind: &'static str,
    /// The name given.
    pub name: String,
    /// The known names.
    pub known: &'static str,
}

/// An enumeration whose values have one name each, in JSON, on the command line and in messages.
macro_rules! named_enum {
    ($(#[$attribute:meta])* $name:ident, $kind:literal, $known:literal, { $($(#[$vdoc:meta])* $variant:ident = $text:literal),+ $(,)? }) => {
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
        #[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
        #[serde(rename_all = "kebab-case")]
        $(#[$attribute])*
        pub enum $name {
            $($(#[$vdoc])* $variant,)+
        }

        impl fmt::Display for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.pad(match self { $(Self::$variant => $text,)+ })
            }
        }

        impl FromStr for $name {
            type Err = $crate::nn::options::UnknownName;

            fn from_str(name: &str) -> Result<Self, Self::Err> {
                match name {
                    $($text => Ok(Self::$variant),)+
                    _ => Err($crate::nn::options::UnknownName { kind: $kind, name: name.to_owned(), known: $known }),
                }
            }
        }
    };
}
pub(in crate::nn) use named_enum;

named_enum!(
    /// The kind of network.
    #[cfg_attr(feature = "schema", schema(as = Architecture))]
    ArchitectureKind, "architecture", "\"dense\", \"flow\" and \"sprites\"", {
        /// The paper's: a dense codec and LSTMs.
        Dense = "dense",
        /// A convolutional network that moves the pixels of the last frame.
        Flow = "flow",
        /// A network that moves two pictures, each as a whole.
        Sprites = "sprites",
    }
);

impl ArchitectureKind {
    /// The architecture of specifications that name none.
    #[must_use]
    pub fn dense() -> Self {
        Self::Dense
    }

    #[expect(clippy::trivially_copy_pass_by_ref, reason = "serde passes a reference")]
    pub(in crate::nn) fn is_dense(&self) -> bool {
        *self == Self::Dense
    }
}

named_enum!(
    /// The paper's two approaches to reconstruct the context frames.
    Reconstruction, "reconstruction", "\"sequence\" and \"stepwise\"", {
        /// Encodes the whole sequence, then decodes it (approach 1).
        Sequence = "sequence",
        /// Reconstructs after each frame (approach 2).
        Stepwise = "stepwise",
    }
);

named_enum!(
    /// What the dense network's predictor gives at each step. The paper does not add its output to the last features.
    PredictorOutput, "predictor output", "\"residual\" and \"absolute\"", {
        /// The change of the features since the previous frame.
        Residual = "residual",
        /// The features themselves, as in the paper.
        Absolute = "absolute",
    }
);

impl PredictorOutput {
    /// That of specifications that name none.
    #[must_use]
    pub fn residual() -> Self {
        Self::Residual
    }

    #[expect(clippy::trivially_copy_pass_by_ref, reason = "serde passes a reference")]
    pub(in crate::nn) fn is_residual(&self) -> bool {
        *self == Self::Residual
    }
}

named_enum!(
    /// The inputs of a prediction besides the context frames.
    Conditioning, "conditioning", "\"none\", \"action\", \"state\" and \"state-action\"", {
        /// No further inputs.
        None = "none",
        /// The action that leads to each predicted frame.
        Action = "action",
        /// The state at the last context frame.
        State = "state",
        /// The action that leads to each predicted frame, and the state at the last context frame.
        StateAction = "state-action",
    }
);

impl Conditioning {
    /// Whether the inputs include actions.
    #[must_use]
    pub fn has_actions(self) -> bool {
        matches!(self, Self::Action | Self::StateAction)
    }

    /// Whether the inputs include the state.
    #[must_use]
    pub fn has_state(self) -> bool {
        matches!(self, Self::State | Self::StateAction)
    }
}
