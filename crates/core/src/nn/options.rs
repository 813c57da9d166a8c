//! The options of a model that have names: in manifests, in settings and in messages.

use serde::{Deserialize, Serialize};

use crate::named_enum;

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

impl UnknownName {
    pub(super) fn new(kind: &'static str, name: &str, known: &'static str) -> Self {
        let name = name.to_owned();
        Self { kind, name, known }
    }
}

named_enum! {
    /// The kind of network.
    #[derive(Hash, Serialize, Deserialize)]
    #[cfg_attr(feature = "schema", derive(utoipa::ToSchema), schema(as = Architecture))]
    #[serde(rename_all = "kebab-case")]
    pub enum ArchitectureKind {
        /// The paper's: a dense codec and LSTMs.
        Dense = "dense",
        /// A convolutional network that moves the pixels of the last frame.
        Flow = "flow",
        /// A network that moves two pictures, each as a whole.
        Sprites = "sprites",
    }
    else |name| -> UnknownName { UnknownName::new("architecture", name, "\"dense\", \"flow\" and \"sprites\"") }
}

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

named_enum! {
    /// The paper's two approaches to reconstruct the context frames.
    #[derive(Hash, Serialize, Deserialize)]
    #[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
    #[serde(rename_all = "kebab-case")]
    pub enum Reconstruction {
        /// Encodes the whole sequence, then decodes it (approach 1).
        Sequence = "sequence",
        /// Reconstructs after each frame (approach 2).
        Stepwise = "stepwise",
    }
    else |name| -> UnknownName { UnknownName::new("reconstruction", name, "\"sequence\" and \"stepwise\"") }
}

named_enum! {
    /// What the dense network's predictor gives at each step. The paper does not add its output to the last features.
    #[derive(Hash, Serialize, Deserialize)]
    #[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
    #[serde(rename_all = "kebab-case")]
    pub enum PredictorOutput {
        /// The change of the features since the previous frame.
        Residual = "residual",
        /// The features themselves, as in the paper.
        Absolute = "absolute",
    }
    else |name| -> UnknownName { UnknownName::new("predictor output", name, "\"residual\" and \"absolute\"") }
}

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

named_enum! {
    /// The inputs of a prediction besides the context frames.
    #[derive(Hash, Serialize, Deserialize)]
    #[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
    #[serde(rename_all = "kebab-case")]
    pub enum Conditioning {
        /// No further inputs.
        None = "none",
        /// The action that leads to each predicted frame.
        Action = "action",
        /// The state at the last context frame.
        State = "state",
        /// The action that leads to each predicted frame, and the state at the last context frame.
        StateAction = "state-action",
    }
    else |name| -> UnknownName {
        UnknownName::new("conditioning", name, "\"none\", \"action\", \"state\" and \"state-action\"")
    }
}

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
