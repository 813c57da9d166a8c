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
mod healthy_robot;
mod import;
mod jobs;
mod jobs_end_to_end;
mod jobs_killed;
mod jobs_limits;
mod jobs_priority;
mod keys;
mod malformed_requests;
mod malformed_streams;
mod metrics;
mod nn_cell;
mod nn_fixtures;
mod nn_model;
mod nn_optimizer;
mod nn_spec;
#[cfg(feature = "otlp")]
mod otlp;
mod path_traversal;
mod process;
mod program;
mod readme;
mod rollouts;
mod server;
mod service;
mod session_frames;
mod session_restart;
mod sessions;
mod shared_datasets;
mod sim;
mod sim_errors;
mod slow_clients;
mod store;
mod store_objects;
mod stream;
mod stream_accuracy;
mod training;
mod warp;
