//! The OpenAPI document: what all routes have in common. The routes describe themselves.

use std::collections::BTreeMap;

use serde::Deserialize;
use serde_json::Value;
use utoipa::openapi::path::ParameterBuilder;
use utoipa::openapi::security::{HttpAuthScheme, HttpBuilder, SecurityScheme};
use utoipa::openapi::{Content, Header, Ref, RefOr, Response, ResponseBuilder};
use utoipa::{Modify, OpenApi};

use super::http::problem::Problem;

#[derive(OpenApi)]
#[openapi(
    info(
        title = "Foreframe",
        description = "Predicts the next camera frames of a robot from frames, actions and state.",
        license(name = "Apache-2.0 OR MIT", identifier = "Apache-2.0 OR MIT"),
        contact()
    ),
    components(schemas(Problem)),
    security((), ("key" = [])),
    tags(
        (name = "models", description = "Models and their predictions"),
        (name = "environments", description = "The simulator, with Gymnasium's reset and step"),
        (name = "sessions", description = "Sessions and their streams of frames"),
        (name = "jobs", description = "Collection, training and evaluation in the background"),
        (name = "datasets", description = "Collected data sets"),
        (name = "health", description = "Whether the server is alive and ready"),
        (name = "about", description = "This contract and a page for people"),
    )
)]
struct Contract;

/// How a request sends its API key. If authentication is on, a request without a valid key gets 401.
struct KeySecurity;

impl Modify for KeySecurity {
    fn modify(&self, contract: &mut utoipa::openapi::OpenApi) {
        let scheme = HttpBuilder::new()
            .scheme(HttpAuthScheme::Bearer)
            .description(Some(
                "An API key of this server, as `foreframe keys create` prints it. Without a valid key, the answer is 401.",
            ))
            .build();
        let components = contract.components.get_or_insert_default();
        components.add_security_scheme("key", SecurityScheme::Http(scheme));
    }
}

/// What all errors have in common: their media type, when to try again, and that an API key may be missing.
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
        .description("No valid API key; only if authentication is on")
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

/// Examples, so that the pages at `/docs` can send every request without editing. By path: a request body, and the model
/// in the path if it is not the default one.
const EXAMPLES: &str = include_str!("../../openapi/examples.json");
/// The example of a model in a path.
const EXAMPLE_MODEL: &str = "paper";

#[derive(Deserialize)]
struct PathExample {
    model: Option<String>,
    body: Value,
}

struct Examples;

impl Modify for Examples {
    #[expect(
        clippy::expect_used,
        reason = "the examples are part of the program, and a test sends each"
    )]
    fn modify(&self, contract: &mut utoipa::openapi::OpenApi) {
        let mut examples: BTreeMap<String, PathExample> =
            serde_json::from_str(EXAMPLES).expect("an example that is not JSON is a bug");
        for (path, item) in &mut contract.paths.paths {
            let example = examples.remove(path);
            let model = example.as_ref().and_then(|example| example.model.as_deref());
            let operations = [&mut item.get, &mut item.post, &mut item.delete];
            for operation in operations.into_iter().flatten() {
                for parameter in operation.parameters.iter_mut().flatten() {
                    if let RefOr::T(parameter) = parameter
                        && parameter.name == "model"
                    {
                        let example = Some(model.unwrap_or(EXAMPLE_MODEL).into());
                        *parameter = ParameterBuilder::from(parameter.clone()).example(example).build();
                    }
                }
                if let (Some(RefOr::T(body)), Some(example)) = (&mut operation.request_body, &example)
                    && let Some(RefOr::T(content)) = body.content.get_mut("application/json")
                {
                    content.example = Some(example.body.clone());
                }
            }
        }
        assert!(examples.is_empty(), "an example without a path is a bug");
    }
}

/// The contract without its paths.
pub(super) fn frame() -> utoipa::openapi::OpenApi {
    Contract::openapi()
}

/// The contract with its paths, completed with what all paths have in common, as JSON with a line break at its end.
#[expect(clippy::expect_used, reason = "the document is made of texts and maps")]
pub(super) fn text(mut contract: utoipa::openapi::OpenApi) -> String {
    KeySecurity.modify(&mut contract);
    Problems.modify(&mut contract);
    Examples.modify(&mut contract);
    let mut text = contract.to_pretty_json().expect("a contract that is not JSON is a bug");
    text.push('\n');
    text
}
