//! From a model and a data set to a report that can be trusted.

pub mod baselines;
pub mod bootstrap;
pub mod metrics;
pub mod motion;
pub mod skill;
