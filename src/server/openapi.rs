//! The contract, from the code.

use axum::extract::State;
use axum::http::header;
use axum::response::IntoResponse;
use utoipa::openapi::security::{HttpAuthScheme, HttpBuilder, SecurityScheme};
use utoipa::openapi::{Content, Header, Ref, RefOr, Response, ResponseBuilder};
use utoipa::{Modify, OpenApi};

use super::{
    App, dashboard, datasets, environments, error, events, health, jobs, metrics, models, predict, preview, rollouts,
    sessions, stream,
};

const STREAMS: &str = include_str!("../../openapi/asyncapi.yaml");

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
        asyncapi_yaml,
        dashboard::page,
    ),
    components(schemas(error::Problem)),
    modifiers(&KeySecurity, &Problems),
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
struct KeySecurity;

impl Modify for KeySecurity {
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

/// What all refusals have in common: their media type, when to try again, and that a key may be missing.
struct Problems;

impl Modify for Problems {
    fn modify(&self, contract: &mut utoipa::openapi::OpenApi) {
        for (path, item) in &mut contract.paths.paths {
            let operations = [&mut item.get, &mut item.post, &mut item.delete];
            for operation in operations.into_iter().flatten() {
                let responses = &mut operation.responses.responses;
                if path.starts_with("/v1") {
                    responses.insert("401".to_owned(), RefOr::T(no_key()));
                }
                for (status, response) in responses {
                    if let RefOr::T(response) = response
                        && status.starts_with(['4', '5'])
                    {
                        as_problem(status, response);
                    }
                }
            }
        }
    }
}

fn no_key() -> Response {
    let problem = Content::new(Some(Ref::from_schema_name("Problem")));
    ResponseBuilder::new()
        .description("No valid key, where the server asks for one")
        .content("application/json", problem)
        .build()
}

fn as_problem(status: &str, response: &mut Response) {
    if let Some(content) = response.content.swap_remove("application/json") {
        response.content.insert("application/problem+json".to_owned(), content);
    }
    if status == "503" {
        let seconds = Header::new(utoipa::schema!(u64));
        response.headers.insert("Retry-After".to_owned(), RefOr::T(seconds));
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

/// The contract of the streams: their messages with examples.
#[utoipa::path(
    get, path = "/asyncapi.yaml", tag = "about",
    responses((status = 200, description = "AsyncAPI 3.0", content_type = "application/yaml"))
)]
pub(super) async fn asyncapi_yaml() -> impl IntoResponse {
    ([(header::CONTENT_TYPE, "application/yaml")], STREAMS)
}
