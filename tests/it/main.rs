//! Behaviour of the whole library, one test binary.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, missing_docs)]
#![allow(clippy::result_large_err, clippy::too_many_lines, clippy::needless_pass_by_value)]

mod architecture;
mod asyncapi;
mod browser;
mod cli;
mod client;
mod config;
mod connections;
mod contract;
mod dataset_collect;
mod dataset_sampler;
mod environments;
mod evaluation;
mod fixtures;
mod hostile_names;
mod hostile_requests;
mod hostile_streams;
mod jobs;
mod jobs_killed;
mod jobs_priority;
mod jobs_work;
mod keys;
mod metrics;
mod neighbour;
mod nn_cell;
mod nn_common;
mod nn_flow;
mod nn_model;
mod nn_optimizer;
mod nn_spec;
#[cfg(feature = "otlp")]
mod otlp;
mod process;
mod program;
mod rollouts;
mod server;
mod service;
mod session_frames;
mod session_restart;
mod sessions;
mod shared_datasets;
mod sim;
mod sim_refusals;
mod store;
mod store_objects;
mod stream;
mod stream_equal;
mod stream_slow;
mod training;
mod warp;
