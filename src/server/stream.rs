//! A session and its WebSocket: [`protocol`] are the messages, `step` the rules of a session, `session` who may step it,
//! `session_table` all sessions, `connection` one socket with its `outbox` of messages that wait to be sent; `plans` searches for plans beside its predictions. `request_socket` is
//! the socket of other protocols, whose clients wait for each answer; `socket` is what both need.

pub(super) mod connection;
pub(super) mod request_socket;
pub(super) mod session;
pub(super) mod session_table;
pub(super) mod socket;
pub(super) mod step;

mod outbox;
mod plans;

pub mod protocol;
