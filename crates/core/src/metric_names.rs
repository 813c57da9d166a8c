//! The names of all metrics, with kind, unit and description. A name ends with its unit. Labels have few possible values:
//! kinds, states, reasons, route templates and model names.

use metrics::{Unit, counter, describe_counter, describe_gauge, describe_histogram};

macro_rules! names {
    ($($describe:ident $name:ident = $text:literal in $unit:ident: $help:literal;)*) => {
        $(#[doc = $help] pub const $name: &str = $text;)*

        /// All names.
        pub const ALL: &[&str] = &[$($name),*];

        /// Gives the recorder the description of each metric.
        pub fn describe() {
            $($describe!($text, Unit::$unit, $help);)*
        }
    };
}

/// Sets counters of rare events to 0, so that Prometheus sees the first event as an increase.
pub fn initialize_counters() {
    for name in [
        INFERENCE_PANICS,
        HTTP_CONNECTIONS_REFUSED,
        HTTP_CONNECTIONS_EVICTED,
        AUTH_REFUSED,
        SESSIONS_EVICTED,
        STREAM_DROPPED,
    ] {
        counter!(name).increment(0);
    }
}

names! {
    describe_gauge BUILD_INFO = "foreframe_build_info" in Count: "Always 1, with the labels version and commit.";

    describe_counter HTTP_REQUESTS = "foreframe_http_requests_total" in Count:
        "Answered requests, by method, route template and status.";
    describe_histogram HTTP_REQUEST_SECONDS = "foreframe_http_request_duration_seconds" in Seconds:
        "Time from receiving the request's headers to sending the response's headers, by route.";
    describe_gauge HTTP_CONNECTIONS = "foreframe_http_connections_open" in Count: "Open connections, including streams.";
    describe_counter HTTP_CONNECTIONS_REFUSED = "foreframe_http_connections_refused_total" in Count:
        "Connections refused because a limit of open connections was reached.";
    describe_counter HTTP_CONNECTIONS_EVICTED = "foreframe_http_connections_evicted_total" in Count:
        "Idle connections closed for new ones because a limit of open connections was reached.";
    describe_counter AUTH_REFUSED = "foreframe_auth_refused_total" in Count: "Requests refused because they had no valid key.";

    describe_histogram PREDICTION_QUEUE_WAIT_SECONDS = "foreframe_prediction_queue_wait_seconds" in Seconds:
        "Time from a prediction's arrival to the start of its batch, by model.";
    describe_histogram PREDICTION_COMPUTE_SECONDS = "foreframe_prediction_compute_seconds" in Seconds:
        "Time to compute a batch, by model.";
    describe_histogram PREDICTION_BATCH_SIZE = "foreframe_prediction_batch_size" in Count:
        "Number of predictions computed together, by model.";
    describe_gauge PREDICTIONS_WAITING = "foreframe_predictions_waiting" in Count: "Predictions waiting in the queue.";
    describe_counter PREDICTIONS_REFUSED = "foreframe_predictions_refused_total" in Count:
        "Predictions that were not computed, by reason: full, deadline, abandoned or error.";

    describe_counter PLANS = "foreframe_plans_total" in Count:
        "Searches for a plan, by model and outcome: safe, or stop if no plan was safe.";
    describe_histogram PLAN_SECONDS = "foreframe_plan_seconds" in Seconds: "Time of a search for a plan, by model.";

    describe_counter INFERENCE_PANICS = "foreframe_inference_panics_total" in Count:
        "Panics of the inference thread; each failed one batch, and the thread was restarted.";

    describe_gauge STREAMS = "foreframe_streams_active" in Count: "Open WebSocket streams.";
    describe_gauge SESSIONS = "foreframe_sessions_active" in Count: "Sessions with state on this server.";
    describe_counter SESSIONS_EVICTED = "foreframe_sessions_evicted_total" in Count:
        "Sessions ended because nobody used them for `session_grace_ms`.";
    describe_counter STREAM_FRAMES = "foreframe_stream_frames_total" in Count:
        "Frames received over streams, including refused and repeated frames, by model.";
    describe_counter STREAM_OVERTAKEN = "foreframe_stream_frames_overtaken_total" in Count:
        "Frames without a prediction because a newer frame was waiting and `on_late` is `skip`, by model.";
    describe_counter STREAM_DROPPED = "foreframe_stream_predictions_dropped_total" in Count:
        "Predictions that were computed but not sent, because the client read too slowly.";

    describe_gauge STORE_WRITABLE = "foreframe_store_writable" in Count:
        "1 if the database and the data directory could be written within the last second, otherwise 0.";
    describe_gauge JOBS = "foreframe_jobs" in Count:
        "Jobs in the store, of all servers and workers, by kind and state.";
    describe_counter JOBS_ENDED = "foreframe_jobs_ended_total" in Count:
        "Jobs that ended in this process (succeeded, failed or cancelled) or that it released for another worker, by kind and \
         outcome.";
    describe_gauge TRAINING_LOSS = "foreframe_training_loss" in Count:
        "Latest loss of the current or last training of this process, by split: train or validation.";

    describe_gauge MODELS_LOADED = "foreframe_models_loaded" in Count: "Models that are loaded and serve requests.";
    describe_counter MODEL_LOADS = "foreframe_model_loads_total" in Count:
        "Attempts to load a model version for serving, by outcome: ok or refused.";

    describe_gauge PROCESS_RESIDENT_BYTES = "process_resident_memory_bytes" in Bytes: "Resident memory of this process.";
    describe_gauge PROCESS_OPEN_FDS = "process_open_fds" in Count: "Open files and sockets of this process.";
    describe_gauge PROCESS_THREADS = "process_threads" in Count: "Threads of this process.";
    describe_gauge PROCESS_START_SECONDS = "process_start_time_seconds" in Seconds: "Start time of this process, in seconds since 1970.";
}
