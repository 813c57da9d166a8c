//! What the predictor measures.

use std::time::{Duration, Instant};

use metrics::{counter, gauge, histogram};

use crate::telemetry::names;

/// Notes a batch of one model: when its tasks were accepted, when its computation started, and how long that took.
pub(super) fn computed(model: &str, accepted: &[Instant], started: Instant, compute_us: u64) {
    let model = model.to_owned();
    histogram!(names::PREDICTION_COMPUTE_SECONDS, "model" => model.clone()).record(Duration::from_micros(compute_us));
    histogram!(names::PREDICTION_BATCH_SIZE, "model" => model.clone()).record(accepted.len() as f64);
    let waits = histogram!(names::PREDICTION_QUEUE_WAIT_SECONDS, "model" => model);
    for accepted in accepted {
        waits.record(started.saturating_duration_since(*accepted));
    }
}

/// Notes a prediction that was not computed.
pub(super) fn refused(reason: &'static str) {
    counter!(names::PREDICTIONS_REFUSED, "reason" => reason).increment(1);
}

/// Notes how many wait now.
pub(super) fn waiting(count: usize) {
    gauge!(names::PREDICTIONS_WAITING).set(count as f64);
}
