//! HTTP itself, before any resource: connections, limits, who may call, and the one shape that errors have.

pub(super) mod access;
pub(super) mod admission;
pub(super) mod body_budget;
mod connection_table;
pub(super) mod connections;
pub(super) mod extract;
mod http_stream;
pub(super) mod listener;
pub(super) mod message_bytes;
pub(super) mod middleware;
pub(super) mod multipart;
pub(super) mod origin;
pub(super) mod page;
pub(super) mod problem;
mod rate;
pub(super) mod requests;
pub(super) mod structured;
pub(super) mod task_limit;
pub(super) mod tls;

pub mod keys;
pub mod shutdown;
