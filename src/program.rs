//! What the program carries: a model, and the commit from which it was built.

use foreframe_core::registry::{self, EmbeddedModel};

/// The commit; empty if it is not known.
pub(crate) const GIT_COMMIT: &str = env!("GIT_COMMIT_AT_BUILD");

const MODEL: EmbeddedModel = EmbeddedModel {
    name: "moving-flow",
    manifest: include_bytes!("../models/moving-flow/manifest.json"),
    weights: include_bytes!("../models/moving-flow/model.safetensors"),
};

/// Tells both to the registry of models.
pub(crate) fn announce() {
    registry::embed(MODEL);
    if !GIT_COMMIT.is_empty() {
        registry::set_git_commit(GIT_COMMIT);
    }
}
