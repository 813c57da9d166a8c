//! Steering by prediction: which of many plans is good, by what is expected to happen under it.
//!
//! [`Planner`] searches. It has no clock, no thread and no weights: it gives batches of plans whose frames it needs, and takes
//! the rollouts. So the same search runs on the caller's own thread ([`plan`]) and in a server. A plan is judged by
//! [`PlanCost`]s: where it leads by the dynamics of the wheels, how near it comes to what the depth network sees, what the camera
//! is predicted to show. The costs that need no predicted frames are computed for every plan; if none of the others steers
//! the search, only the best few plans are predicted.
//!
//! The modules in reading order; each uses only those above it: `error` → `goal` → `limits` (of actions) → `solver` (which plans to
//! try next) → `obstacles` → `cost` → `settings` → `choice` (the answer) → `judge` → `planner` → `local`.

mod choice;
mod cost;
mod error;
mod goal;
mod judge;
mod limits;
mod local;
mod obstacles;
mod planner;
mod settings;
mod solver;

pub use choice::{CandidateKind, PlanCandidate, PlanChoice, UnsafeReason};
pub use cost::{CostTerm, PlanCost};
pub use error::PlanError;
pub use goal::Goal;
pub use judge::PlannerInput;
pub use limits::{ActionLimit, ActionLimits};
pub use local::{plan, plan_around};
pub use obstacles::Obstacles;
pub use planner::{PlanBatch, Planner};
pub use settings::{PlanSettings, SolverKind, SolverSettings};
pub use solver::{SearchSpace, Solver};
