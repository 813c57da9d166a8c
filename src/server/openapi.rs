//! The OpenAPI document: what all routes have in common. The routes describe themselves.

mod responses;
mod variants;

use std::collections::BTreeMap;

use serde::Deserialize;
use serde_json::Value;
use utoipa::OpenApi;
use utoipa::openapi::path::{Parameter, ParameterBuilder};
use utoipa::openapi::schema::{KnownFormat, Schema, SchemaFormat};
use utoipa::openapi::security::{HttpAuthScheme, HttpBuilder, SecurityRequirement, SecurityScheme};
use utoipa::openapi::{OpenApi as Document, RefOr};

use self::responses::{complete_operations, operations};
use self::variants::complete_variants;
use super::http::access::required_scope;
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
fn add_key(contract: &mut Document) {
    let scheme = HttpBuilder::new()
        .scheme(HttpAuthScheme::Bearer)
        .description(Some(
            "An API key of this server, as `foreframe keys create` prints it. Each operation names the scope that it needs; `admin` includes `jobs`, and `jobs` includes `predict`.",
        ))
        .build();
    let components = contract.components.get_or_insert_default();
    components.add_security_scheme("key", SecurityScheme::Http(scheme));
    let paths = contract.paths.paths.iter_mut();
    for (path, item) in paths.filter(|(path, _)| path.starts_with("/v1")) {
        for (method, operation) in operations(item) {
            let scope = required_scope(&method, path).name();
            let with_key = SecurityRequirement::new("key", [scope]);
            operation.security = Some(vec![SecurityRequirement::default(), with_key]);
        }
    }
}

/// Makes the names of operations unique: a name that several resources use gets its tag in front.
fn add_operation_ids(contract: &mut Document) {
    let mut uses = BTreeMap::<String, usize>::new();
    for (_, operation) in contract.paths.paths.values_mut().flat_map(operations) {
        *uses
            .entry(operation.operation_id.clone().unwrap_or_default())
            .or_default() += 1;
    }
    for (_, operation) in contract.paths.paths.values_mut().flat_map(operations) {
        let tag = operation.tags.iter().flatten().next();
        if let (Some(id), Some(tag)) = (&mut operation.operation_id, tag)
            && uses.get(id).is_some_and(|uses| *uses > 1)
        {
            *id = format!("{tag}_{id}");
        }
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

fn add_examples(contract: &mut Document) {
    let mut examples: BTreeMap<String, PathExample> =
        serde_json::from_str(EXAMPLES).expect("an example that is not JSON is a bug");
    for (path, item) in &mut contract.paths.paths {
        let example = examples.remove(path);
        let model = example.as_ref().and_then(|example| example.model.as_deref());
        for (_, operation) in operations(item) {
            for parameter in operation.parameters.iter_mut().flatten() {
                let RefOr::T(parameter) = parameter else { continue };
                limit(parameter);
                if parameter.name == "model" {
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

/// Says how large the number in a path can be: not every client knows the format `uint32`.
fn limit(parameter: &mut Parameter) {
    if let Some(RefOr::T(Schema::Object(number))) = &mut parameter.schema
        && number.format == Some(SchemaFormat::KnownFormat(KnownFormat::UInt32))
    {
        number.maximum = Some(u32::MAX.into());
    }
}

/// The contract without its paths.
pub(super) fn frame() -> Document {
    Contract::openapi()
}

/// The contract with its paths, completed with what all paths have in common, as JSON with a line break at its end.
pub(super) fn text(mut contract: Document) -> String {
    complete_variants(&mut contract);
    add_key(&mut contract);
    complete_operations(&mut contract);
    add_operation_ids(&mut contract);
    add_examples(&mut contract);
    let mut text = contract.to_pretty_json().expect("a contract that is not JSON is a bug");
    text.push('\n');
    text
}
