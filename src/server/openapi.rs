//! The contract, from the code.

use axum::extract::State;
use axum::http::header;
use axum::response::IntoResponse;
use utoipa::OpenApi;

use super::{App, dashboard, datasets, error, events, health, jobs, models, predict, preview, stream};

#[derive(OpenApi)]
#[openapi(
    info(
        title = "Foreframe",
        description = "Predicts the camera frames to come from frames, actions and state.",
        license(name = "Apache-2.0 OR MIT", identifier = "Apache-2.0 OR MIT"),
        contact()
    ),
    paths(
        health::livez,
        health::readyz,
        models::list,
        models::get,
        models::activate,
        models::delete,
        predict::predict,
        preview::preview,
        stream::stream,
        jobs::create,
        jobs::list,
        jobs::get,
        jobs::cancel,
        jobs::resume,
        jobs::logs,
        jobs::metrics,
        jobs::file,
        events::events,
        datasets::list,
        datasets::get,
        datasets::delete,
        datasets::sheet,
        datasets::animation,
        openapi_json,
        dashboard::page,
    ),
    components(schemas(error::Problem)),
    tags(
        (name = "models", description = "Models and their predictions"),
        (name = "jobs", description = "Collection, training and evaluation in the background"),
        (name = "datasets", description = "What was collected"),
        (name = "health", description = "Whether the server lives and is ready"),
        (name = "about", description = "This contract and a page for people"),
    )
)]
struct Contract;

/// The OpenAPI 3.1 document of the whole service, as JSON with a line break at its end.
#[must_use]
pub fn document() -> String {
    let mut text = Contract::openapi().to_pretty_json().unwrap_or_default();
    text.push('\n');
    text
}

/// This contract.
#[utoipa::path(
    get, path = "/openapi.json", tag = "about",
    responses((status = 200, description = "OpenAPI 3.1", content_type = "application/json"))
)]
pub(super) async fn openapi_json(State(app): State<App>) -> impl IntoResponse {
    ([(header::CONTENT_TYPE, "application/json")], app.contract().to_owned())
}
