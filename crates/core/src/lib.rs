//! The core of Foreframe: frames, networks, models on disk, the predictor and the state of sessions. Use it through the
//! crate `foreframe`.
//!
//! The modules in reading order; each uses only those above it:

pub mod types;

pub mod vectorized;

pub mod error_kind;
pub mod error_text;
pub mod files;
pub mod metric_names;

pub mod frame;

pub mod nn;

pub mod registry;

pub mod serving;

pub mod planning;
