//! Pages for people and contracts for programs. Nothing is fetched from elsewhere: scripts and styles are part of the program.
//!
//! `/` is the page with the views Play, Dream, What if, Data and Train; `server/page` holds its modules. At `/docs`, requests
//! can be tried out. The contracts are `OpenAPI` for the requests and `AsyncAPI` for the streams.

use std::sync::Arc;

use axum::http::{HeaderMap, HeaderValue, header};
use axum::middleware::map_response;
use axum::response::{Html, IntoResponse, Response};
use axum::routing::get;
use axum::{Extension, Router};
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;
use utoipa_swagger_ui::{Config, SwaggerUi};

use super::openpi;
use super::streams::{Messages, Upgrade};
use crate::server::http::problem::ApiError;
use crate::server::state::App;

const PAGE: &str = include_str!("../page/index.html");

/// A file of the page, by its path.
macro_rules! page_files {
    ($($name:literal),* $(,)?) => {
        [$((concat!("/page/", $name), include_str!(concat!("../page/", $name))),)*]
    };
}

const PAGE_FILES: [(&str, &str); 31] = page_files![
    "address.js",
    "api.js",
    "app.js",
    "base64.js",
    "camera.js",
    "data.js",
    "dream.js",
    "episode.js",
    "gif.js",
    "gray.js",
    "import_form.js",
    "job.js",
    "keys.js",
    "models.js",
    "picture.js",
    "play.js",
    "plot.js",
    "preact.js",
    "predict.js",
    "robot.js",
    "score.js",
    "server_lists.js",
    "shared.js",
    "snippets.js",
    "sources.js",
    "stream.js",
    "style.css",
    "train.js",
    "uplot.css",
    "uplot.js",
    "what_if.js",
];

const STREAMS: &str = include_str!("../../../openapi/asyncapi.yaml");

/// Scripts and styles come from this server, pictures from its answers; nothing from elsewhere.
const PAGE_POLICY: &str = "default-src 'self'; img-src 'self' data: blob:; script-src 'self'; style-src 'self'; \
     object-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'";
/// Everything comes from this server. The pages write styles into their elements.
const DOCS_POLICY: &str = "default-src 'self'; img-src 'self' data:; script-src 'self'; \
     style-src 'self' 'unsafe-inline'; object-src 'none'; base-uri 'none'; frame-ancestors 'none'";

pub(in crate::server) fn routes() -> OpenApiRouter<App> {
    let pages = OpenApiRouter::new()
        .routes(routes!(page))
        .routes(routes!(openapi_json))
        .routes(routes!(asyncapi_yaml));
    PAGE_FILES.into_iter().fold(pages, |pages, (path, text)| {
        let media_type = if path.split('.').next_back() == Some("css") {
            "text/css"
        } else {
            "text/javascript"
        };
        let headers = [(header::CONTENT_TYPE, format!("{media_type}; charset=utf-8"))];
        pages.route(path, get(async move || (headers, text)))
    })
}

/// `/docs`.
pub(in crate::server) fn docs() -> Router<App> {
    // Otherwise the pages would ask a validator on the internet.
    let config = Config::from("/openapi.json").validator_url("none");
    let pages: Router<App> = SwaggerUi::new("/docs").config(config).into();
    pages.layer(map_response(async |mut page: Response| {
        let policy = HeaderValue::from_static(DOCS_POLICY);
        page.headers_mut().insert(header::CONTENT_SECURITY_POLICY, policy);
        page
    }))
}

/// A page for people. A WebSocket handshake here opens the socket of openpi's clients instead, because they know no path.
#[utoipa::path(
    get, path = "/", tag = "about",
    responses((status = 200, description = "A page", content_type = "text/html"))
)]
async fn page(app: App, headers: HeaderMap, messages: Messages, upgrade: Upgrade) -> Result<Response, ApiError> {
    match upgrade {
        Ok(upgrade) => openpi::open_at_root(&app, &headers, messages, upgrade),
        Err(_) => Ok(([(header::CONTENT_SECURITY_POLICY, PAGE_POLICY)], Html(PAGE)).into_response()),
    }
}

/// The OpenAPI document as text; clones share it.
#[derive(Clone)]
pub(in crate::server) struct ContractText(pub(in crate::server) Arc<str>);

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
