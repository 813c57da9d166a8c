//! What Foreframe's server does in the background: the database, the versions of models, and jobs. Use it through the crate
//! `foreframe`.

pub mod store;

pub mod versions;

pub mod jobs;
