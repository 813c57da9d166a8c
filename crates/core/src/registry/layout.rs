//! The names of models, and of the files in their directories.

/// Name of the weights file in a model's directory.
pub const WEIGHTS_FILE: &str = "model.safetensors";
/// Name of the manifest file in a model's directory.
pub const MANIFEST_FILE: &str = "manifest.json";

/// Whether the name is safe as a directory name and in a URL: 1 to 64 of a–z, 0–9 and '-', not starting with '-'.
#[must_use]
pub fn is_valid_name(name: &str) -> bool {
    let bytes = name.as_bytes();
    (1..=64).contains(&bytes.len())
        && bytes[0] != b'-'
        && bytes.iter().all(|b| matches!(b, b'a'..=b'z' | b'0'..=b'9' | b'-'))
}
