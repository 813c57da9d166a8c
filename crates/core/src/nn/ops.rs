//! The operations that the networks are made of, each with its gradient. They know no model.

pub(super) mod activated_convolution;
pub(super) mod activation;
mod bordered_convolution;
mod byte_convolution;
#[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
mod casts;
pub(super) mod compose;
pub(super) mod convolution;
pub(super) mod gathering;
pub(super) mod image_geometry;
pub(super) mod joining;
pub(super) mod linear;
pub(super) mod modulation;
pub(super) mod packed;
pub(super) mod pixel_shuffle;
mod reduced;
pub(super) mod row_weights;
pub(super) mod sampling;
pub(super) mod scratch;
pub(super) mod waves;
mod winograd;
