//! The sprite network: it cuts what moves out of the context as two pictures, and moves each as a whole over black. In computer
//! graphics such a picture is called a sprite (learned from video: Jojic & Frey 2001).
//!
//! 1. `block_tracks` follows each block of the last frame back through the context, by comparing pixels, and `two_ways` finds the two
//!    ways that most of them went. Nothing is learned there.
//! 2. An encoder reads all that. It says which share of each pixel of the last frame belongs to the first sprite, which goes the first way;
//!    the rest belongs to the second.
//! 3. A sprite has moved as its blocks have, in the mean. So all frames of the context can be laid over each other where the sprite
//!    stands still, and a few convolutions see what the other sprite hides of it.
//! 4. A few layers say, step by step, how it goes on: its place in each predicted frame, and how unsure that place is along each side.
//!    `tents` moves the picture there, and spreads it where it is unsure.
//!
//! Reading order: `block_tracks` → `two_ways` → `layers` (the tensors) → `reading` (1) → `tents` → `pictures` → `separation` (2) → `motion` (4) →
//! `network` (3, and all together) → `motion_loss` (training).

mod block_tracks;
mod layers;
mod motion;
mod motion_loss;
mod network;
mod pictures;
mod reading;
mod separation;
mod tents;
mod two_ways;

pub(super) use layers::{multiply_adds_per_frame, tensor_shapes};
pub use motion_loss::motion_loss;
pub(super) use network::SpriteNetwork;
pub use network::SpritePrediction;
