//! The flow network: it moves the pixels of the last frame instead of computing new ones.
//!
//! An encoder reads the last frames once, in the last one's view. Then, for each predicted step: `motion` says how
//! the camera will have moved, the encoder's features are sampled as that camera sees them, a block of convolutions that
//! is modulated by actions, state and step refines them, and `ops::compose` mixes moved pixels with new content. The content
//! comes from the `scene`, a learned function of the camera's pose that remembers what the surroundings look like. In the
//! `recurrent` form, each step continues from the one before it.
//!
//! Sizes beside those of [`crate::nn`]: M items (N rollouts of K steps each, step after step), C channels on the grid of a
//! quarter of the frame's sides.
//!
//! The form with `depth` estimates how deep the last frame is, and `reprojection` says where the moved camera saw each of its pixels. It
//! remembers nothing, unless it has a `memory` of one room.
//!
//! Reading order: `room_geometry` and `ray_description` → `encoder_views` and `rollout_rows` (what the network reads) → `scene` and
//! `motion`, or `depth_views`, `reprojection`, `depth_head`, `speed_head`, `mover_head`, `memory` and `occupancy` → `layers` (its tensors)
//! → `network` → `direct`, `recurrent` and `depth` (its three forms) → `predict` → `beyond_horizon`. `plain` has the same in candle's own
//! tensor operations.

mod beyond_horizon;
mod blocks;
mod depth;
mod depth_head;
mod depth_views;
mod direct;
mod encoder_views;
mod layers;
mod memory;
mod motion;
mod mover_head;
mod network;
mod occupancy;
mod plain;
mod predict;
mod ray_description;
mod recurrent;
mod reprojection;
mod rollout_rows;
mod room_geometry;
mod scene;
mod speed_head;
mod steps_ahead;

pub(super) use layers::{multiply_adds_per_frame, tensor_shapes};
pub(super) use network::FlowNetwork;
pub use network::FlowPrediction;
pub use occupancy::Occupancy;
pub(super) use predict::Asked;
