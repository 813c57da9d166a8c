//! Foreframe sees a few moments ahead for robots: from camera frames, actions and state it predicts the frames to come.
//!
//! The modules in reading order; each uses only those above it:
#![forbid(unsafe_code)]

pub mod types;

pub mod files;

pub mod error_text;
pub mod telemetry;

pub mod frame;

pub mod nn;

pub mod sim;

pub mod dataset;

pub mod registry;

pub mod training;

pub mod evaluation;

pub mod serving;

pub mod store;

pub mod versions;

pub mod jobs;

pub mod server;

pub mod config;

pub mod cli;
