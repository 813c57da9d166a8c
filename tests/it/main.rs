//! Behaviour of the whole library, one test binary.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, missing_docs)]
#![allow(clippy::result_large_err, clippy::too_many_lines, clippy::needless_pass_by_value)]

mod architecture;
mod dataset_collect;
mod dataset_sampler;
mod evaluation;
mod jobs;
mod jobs_killed;
mod jobs_work;
mod nn_cell;
mod nn_common;
mod nn_model;
mod nn_optimizer;
mod nn_spec;
mod server;
mod service;
mod sim;
mod sim_refusals;
mod store;
mod stream;
mod training;
