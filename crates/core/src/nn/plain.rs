//! The operations of the networks in candle's own tensor operations: short to read, and on any device. The operations of
//! [`super::ops`] compute the same on the CPU, faster; the tests compare both.
//!
//! Images have their channels first here, `[N, C, H, W]`, as candle's convolution takes them. Gradients are candle's, but for the
//! convolution: candle's own gradient of its input is slow on a graphics card.

pub(super) mod convolution;
pub(super) mod layers;
pub(super) mod losses;
pub(super) mod sampling;
