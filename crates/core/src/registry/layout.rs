//! The names of the files in a model's directory.

/// Name of the weights file in a model's directory.
pub const WEIGHTS_FILE: &str = "model.safetensors";
/// Name of the manifest file in a model's directory.
pub const MANIFEST_FILE: &str = "manifest.json";
