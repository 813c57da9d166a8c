//! The predictor's metrics.

use std::time::{Duration, Instant};

use metrics::{counter, gauge, histogram};

use crate::metric_names;
use crate::types::ModelName;

/// Records a batch of one model: when its tasks were accepted, when its computation started, and how long that took.
pub(super) fn record_batch(model: &ModelName, accepted: &[Instant], started: Instant, compute_us: u64) {
    let model = model.to_string();
    histogram!(metric_names::PREDICTION_COMPUTE_SECONDS, "model" => model.clone())
        .record(Duration::from_micros(compute_us));
    histogram!(metric_names::PREDICTION_BATCH_SIZE, "model" => model.clone()).record(accepted.len() as f64);
    let waits = histogram!(metric_names::PREDICTION_QUEUE_WAIT_SECONDS, "model" => model);
    for accepted in accepted {
        waits.record(started.saturating_duration_since(*accepted));
    }
}

/// Counts a prediction that was not computed.
pub(super) fn record_refusal(reason: &'static str) {
    counter!(metric_names::PREDICTIONS_REFUSED, "reason" => reason).increment(1);
}

/// Counts a panic of the inference thread.
pub(super) fn record_panic() {
    counter!(metric_names::INFERENCE_PANICS).increment(1);
}

/// Sets how many predictions are waiting now.
pub(super) fn set_waiting(count: usize) {
    gauge!(metric_names::PREDICTIONS_WAITING).set(count as f64);
}
