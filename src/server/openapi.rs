//! The contract, from the code.

use axum::extract::State;
use axum::http::header;
use axum::response::IntoResponse;
use utoipa::openapi::security::{HttpAuthScheme, HttpBuilder, SecurityScheme};
use utoipa::{Modify, OpenApi};

use super::{
    App, dashboard, datasets, environments, error, events, health, jobs, metrics, models, predict, preview, rollouts,
    sessions, stream,
};

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
        metrics::metrics,
        models::list,
        models::get,
        models::activate,
        models::delete,
        predict::predict,
        preview::preview,
        environments::create,
        environments::reset,
        environments::step,
        environments::delete,
        rollouts::of_model,
        stream::of_model,
        sessions::create,
        sessions::list,
        sessions::get,
        sessions::delete,
        sessions::state,
        rollouts::of_session,
        stream::of_session,
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
    modifiers(&Keys),
    security((), ("key" = [])),
    tags(
        (name = "models", description = "Models and their predictions"),
        (name = "environments", description = "The simulator, with Gymnasium's reset and step"),
        (name = "sessions", description = "Streams of frames that are remembered"),
        (name = "jobs", description = "Collection, training and evaluation in the background"),
        (name = "datasets", description = "What was collected"),
        (name = "health", description = "Whether the server lives and is ready"),
        (name = "about", description = "This contract and a page for people"),
    )
)]
struct Contract;

/// How a request shows its key, where one is asked for; without a valid one the answer is 401.
struct Keys;

impl Modify for Keys {
    fn modify(&self, contract: &mut utoipa::openapi::OpenApi) {
        let scheme = HttpBuilder::new()
            .scheme(HttpAuthScheme::Bearer)
            .description(Some(
                "A key of this server, as `foreframe keys create` prints it; without a valid one: 401.",
            ))
            .build();
        let components = contract.components.get_or_insert_default();
        components.add_security_scheme("key", SecurityScheme::Http(scheme));
    }
}

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
