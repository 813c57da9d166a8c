//! Behaviour of the whole library, one test binary.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, missing_docs)]
mod architecture;
mod evaluation;
mod sim;
mod training;
