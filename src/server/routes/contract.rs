//! The contracts: OpenAPI for the requests, `AsyncAPI` for the streams.

use std::sync::Arc;

use axum::Extension;
use axum::http::header;
use axum::response::IntoResponse;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use crate::server::state::App;

const STREAMS: &str = include_str!("../../../openapi/asyncapi.yaml");

/// The OpenAPI document as text; clones share it.
#[derive(Clone)]
pub(in crate::server) struct ContractText(Arc<str>);

impl From<String> for ContractText {
    fn from(text: String) -> Self {
        Self(text.into())
    }
}

pub(in crate::server) fn routes() -> OpenApiRouter<App> {
    OpenApiRouter::new()
        .routes(routes!(openapi_json))
        .routes(routes!(asyncapi_yaml))
}

/// This contract.
#[utoipa::path(
    get, path = "/openapi.json", tag = "about",
    responses((status = 200, description = "OpenAPI 3.1", content_type = "application/json"))
)]
async fn openapi_json(Extension(ContractText(text)): Extension<ContractText>) -> impl IntoResponse {
    ([(header::CONTENT_TYPE, "application/json")], text.to_string())
}

/// The contract of the streams: their messages with examples.
#[utoipa::path(
    get, path = "/asyncapi.yaml", tag = "about",
    responses((status = 200, description = "AsyncAPI 3.0", content_type = "application/yaml"))
)]
async fn asyncapi_yaml() -> impl IntoResponse {
    ([(header::CONTENT_TYPE, "application/yaml")], STREAMS)
}
