//! What a robot recorded, in files: its images, and its states and actions.

mod actions;
mod images;

pub(super) use actions::ActionsFile;
pub(super) use images::{ImagePaths, SeenFrames};
