//! What all responses have in common: errors are problem details, and every operation lists the errors that its key, path,
//! query and body can cause.

use utoipa::Modify;
use utoipa::openapi::path::{Operation, ParameterIn, PathItem};
use utoipa::openapi::schema::{Schema, SchemaType, Type};
use utoipa::openapi::{Content, Header, Ref, RefOr, Response, ResponseBuilder};

/// Completes the responses of all operations.
pub(super) struct Responses;

impl Modify for Responses {
    fn modify(&self, contract: &mut utoipa::openapi::OpenApi) {
        for (path, item) in &mut contract.paths.paths {
            for operation in operations(item) {
                if path.starts_with("/v1") {
                    add_common(operation);
                }
                for (status, response) in &mut operation.responses.responses {
                    if let RefOr::T(response) = response {
                        complete(status, response);
                    }
                }
            }
        }
    }
}

/// The operations of a path.
pub(super) fn operations(item: &mut PathItem) -> impl Iterator<Item = &mut Operation> {
    [&mut item.get, &mut item.post, &mut item.delete].into_iter().flatten()
}

/// Adds the errors that the operation does not list itself.
fn add_common(operation: &mut Operation) {
    let mut common = vec![
        ("401", "No valid API key; only if authentication is on"),
        ("403", "The API key's scope does not include this"),
        ("429", "The API key's rate limit is reached"),
    ];
    let parameters = || {
        operation
            .parameters
            .iter()
            .flatten()
            .filter_map(|parameter| match parameter {
                RefOr::T(parameter) => Some(parameter),
                RefOr::Ref(_) => None,
            })
    };
    if parameters().any(|parameter| parameter.parameter_in == ParameterIn::Path && is_number(parameter.schema.as_ref()))
    {
        common.push(("400", "A number in the path is not one"));
    }
    if parameters().any(|parameter| parameter.parameter_in == ParameterIn::Query) {
        common.push(("422", "A query parameter is unknown or not valid"));
    }
    if operation.request_body.is_some() {
        common.extend([
            ("400", "The body cannot be read"),
            ("408", "The body did not arrive in time"),
            ("413", "The body exceeds its limit"),
            ("415", "The Content-Type is not one of these"),
            (
                "422",
                "A field of the body is unknown, missing or not valid; the answer names it",
            ),
        ]);
    }
    let responses = &mut operation.responses.responses;
    for (status, description) in common {
        if !responses.contains_key(status) {
            let problem = Content::new(Some(Ref::from_schema_name("Problem")));
            let response = ResponseBuilder::new()
                .description(description)
                .content("application/json", problem);
            responses.insert(status.to_owned(), RefOr::T(response.build()));
        }
    }
}

fn is_number(schema: Option<&RefOr<Schema>>) -> bool {
    matches!(schema, Some(RefOr::T(Schema::Object(object))) if object.schema_type == SchemaType::Type(Type::Integer))
}

/// The description that OpenAPI requires, the media type of errors, and when to try again.
fn complete(status: &str, response: &mut Response) {
    if response.description.is_empty() {
        "Done".clone_into(&mut response.description);
    }
    if status.starts_with(['4', '5'])
        && let Some(content) = response.content.swap_remove("application/json")
    {
        response.content.insert("application/problem+json".to_owned(), content);
    }
    if ["429", "503"].contains(&status) {
        let seconds = Header::new(utoipa::schema!(u64));
        response.headers.insert("Retry-After".to_owned(), RefOr::T(seconds));
    }
}
