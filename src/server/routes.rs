//! The handlers, one resource a file. Each file declares its routes in a function `routes`.

pub(super) mod audit;
pub(super) mod datasets;
pub(super) mod environments;
pub(super) mod episodes;
pub(super) mod events;
pub(super) mod health;
pub(super) mod inference_protocol;
pub(super) mod job_events;
pub(super) mod jobs;
pub(super) mod metrics;
pub(super) mod models;
pub(super) mod openenv;
pub(super) mod openpi;
pub(super) mod pages;
pub(super) mod plans;
pub(super) mod predict;
pub(super) mod preview;
pub(super) mod rollouts;
pub(super) mod sessions;
pub(super) mod streams;
pub(super) mod uploads;
pub(super) mod world_sessions;

mod bounds;
mod picture;
