//! Behaviour of the whole library, one test binary.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, missing_docs)]

mod architecture;
mod dataset_collect;
mod dataset_sampler;
mod jobs;
mod server;
mod service;
mod sim;

mod nn_cell;
mod nn_common;
mod nn_model;
mod nn_optimizer;
mod nn_spec;
mod sim_refusals;
mod evaluation;
mod sim;
mod stream;
mod training;
