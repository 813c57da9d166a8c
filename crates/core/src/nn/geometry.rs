//! How a camera that drives sees, and how a robot's commands move it: shared by the networks that move pixels.
//!
//! `camera` (poses and rays) → `viewer_rays` (those of all pixels, kept) → `turning` (where a turning camera saw a pixel) →
//! `wheel_dynamics` (the way of a base that follows its commands) → `state_channels` (what a robot's channels say of pose and speed).

pub(super) mod camera;
pub(super) mod state_channels;
pub(super) mod turning;
pub(super) mod viewer_rays;
pub(super) mod wheel_dynamics;
