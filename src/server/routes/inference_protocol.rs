//! The Open Inference Protocol, version 2, with its binary extension, for clients of other inference servers. Its
//! specification is the contract, so these routes are not in the `OpenAPI` document; errors are `{"error": …}`.

mod infer;
mod message;
mod metadata;
mod tensor;

use axum::routing::{get, post};
use utoipa_axum::router::OpenApiRouter;

use crate::server::state::App;

/// The routes that need no API key.
pub(in crate::server) fn open_routes() -> OpenApiRouter<App> {
    OpenApiRouter::new()
        .route("/v2", get(metadata::server))
        .route("/v2/health/live", get(metadata::live))
        .route("/v2/health/ready", get(metadata::ready))
}

/// The routes that need an API key if authentication is on.
pub(in crate::server) fn routes() -> OpenApiRouter<App> {
    let mut router = OpenApiRouter::new()
        .route("/v2/repository/index", post(metadata::index))
        .route("/v2/models/stats", get(metadata::all_statistics));
    for path in ["/v2/models/{model}", "/v2/models/{model}/versions/{version}"] {
        router = router
            .route(path, get(metadata::model))
            .route(&format!("{path}/ready"), get(metadata::model_ready))
            .route(&format!("{path}/config"), get(metadata::config))
            .route(&format!("{path}/stats"), get(metadata::statistics))
            .route(&format!("{path}/infer"), post(infer::infer));
    }
    router
}
