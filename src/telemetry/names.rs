//! The names of all metrics, with their kinds, units and meanings. Units are last in the names. Labels are of few values:
//! kinds, states, reasons, the templates of routes, and the models that there are.

use metrics::{Unit, counter, describe_counter, describe_gauge, describe_histogram};

macro_rules! names {
    ($($describe:ident $name:ident = $text:literal in $unit:ident: $help:literal;)*) => {
        $(#[doc = $help] pub const $name: &str = $text;)*

        /// Every name there is.
        pub const ALL: &[&str] = &[$($name),*];

        /// Tells the recorder what each metric means.
        pub(super) fn describe() {
            $($describe!($text, Unit::$unit, $help);)*
        }
    };
}

/// Shows what seldom happens as 0 until it does, so that its first time is seen as a rise.
pub(super) fn begin() {
    for name in [INFERENCE_PANICS, HTTP_CONNECTIONS_REFUSED, AUTH_REFUSED, SESSIONS_EVICTED, STREAM_DROPPED] {
        counter!(name).increment(0);
    }
}

names! {
    describe_gauge BUILD_INFO = "foreframe_build_info" in Count: "1, labelled version and commit.";

    describe_counter HTTP_REQUESTS = "foreframe_http_requests_total" in Count:
        "Answered requests, by method, route (its template) and status.";
    describe_histogram HTTP_REQUEST_SECONDS = "foreframe_http_request_duration_seconds" in Seconds:
        "From a request's head to its answer's head, by route.";
    describe_gauge HTTP_CONNECTIONS = "foreframe_http_connections_open" in Count: "Open connections, streams included.";
    describe_counter HTTP_CONNECTIONS_REFUSED = "foreframe_http_connections_refused_total" in Count:
        "Connections refused because as many were open as may.";
    describe_counter AUTH_REFUSED = "foreframe_auth_refused_total" in Count: "Requests refused for want of a valid key.";

    describe_histogram PREDICTION_QUEUE_WAIT_SECONDS = "foreframe_prediction_queue_wait_seconds" in Seconds:
        "From a prediction's arrival to the start of its batch, by model.";
    describe_histogram PREDICTION_COMPUTE_SECONDS = "foreframe_prediction_compute_seconds" in Seconds:
        "Computation of a batch, by model.";
    describe_histogram PREDICTION_BATCH_SIZE = "foreframe_prediction_batch_size" in Count:
        "Predictions computed together, by model.";
    describe_gauge PREDICTIONS_WAITING = "foreframe_predictions_waiting" in Count: "Predictions in the queue.";
    describe_counter PREDICTIONS_REFUSED = "foreframe_predictions_refused_total" in Count:
        "Predictions that were not computed, by reason: full, deadline, abandoned or error.";

    describe_counter INFERENCE_PANICS = "foreframe_inference_panics_total" in Count:
        "Panics of the inference thread; each failed one batch, and the thread was restarted.";

    describe_gauge STREAMS = "foreframe_streams_active" in Count: "Open WebSocket streams.";
    describe_gauge SESSIONS = "foreframe_sessions_active" in Count: "Sessions that hold state.";
    describe_counter SESSIONS_EVICTED = "foreframe_sessions_evicted_total" in Count:
        "Sessions that nobody used for `session_grace_ms`, and that were ended.";
    describe_counter STREAM_FRAMES = "foreframe_stream_frames_total" in Count:
        "Frames that came over streams, those refused or sent again included, by model.";
    describe_counter STREAM_OVERTAKEN = "foreframe_stream_frames_overtaken_total" in Count:
        "Frames that nothing was predicted from, since a newer one waited and `on_late` is `skip`, by model.";
    describe_counter STREAM_DROPPED = "foreframe_stream_predictions_dropped_total" in Count:
        "Predictions that were computed and not sent, because the client read too slowly.";

    describe_gauge JOBS = "foreframe_jobs" in Count:
        "Jobs in the store, whoever works on them, by kind and state.";
    describe_counter JOBS_ENDED = "foreframe_jobs_ended_total" in Count:
        "Jobs that this process worked on until they succeeded, failed or were cancelled, or that it left to be gone on with, \
         by kind and outcome.";
    describe_gauge TRAINING_LOSS = "foreframe_training_loss" in Count:
        "Latest loss of the training that this process works on, or last did, by split: train or validation.";

    describe_gauge MODELS_LOADED = "foreframe_models_loaded" in Count: "Models that answer.";
    describe_counter MODEL_LOADS = "foreframe_model_loads_total" in Count:
        "Versions of models that were to serve, by outcome: ok or refused.";

    describe_gauge PROCESS_RESIDENT_BYTES = "process_resident_memory_bytes" in Bytes: "Memory of this process.";
    describe_gauge PROCESS_OPEN_FDS = "process_open_fds" in Count: "Open files and sockets of this process.";
    describe_gauge PROCESS_THREADS = "process_threads" in Count: "Threads of this process.";
    describe_gauge PROCESS_START_SECONDS = "process_start_time_seconds" in Seconds: "When this process started, since 1970.";
}
