//! Plans: what a robot should do to reach a goal, searched for on this server. `request` and `response` are the bodies, over HTTP and in
//! a stream, `search` is the search.

pub(super) mod request;
pub(super) mod response;
pub(super) mod search;
