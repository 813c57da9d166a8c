//! A session and its WebSocket: [`protocol`] are the messages, `step` the rules of a session, `session` who may step it,
//! `session_table` all sessions, `connection` one socket with its `outbox` of messages that wait to be sent.

pub(super) mod connection;
pub(super) mod session;
pub(super) mod session_table;
pub(super) mod step;

mod outbox;

pub mod protocol;
