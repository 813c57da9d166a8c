//! What operations have in common: their parameters are described, errors are problem details, and every operation lists
//! the errors that its key, path, query and body can cause.

use axum::http::Method;
use utoipa::openapi::path::{Operation, Parameter, ParameterIn, PathItem};
use utoipa::openapi::schema::{Schema, SchemaType, Type};
use utoipa::openapi::{Content, Header, OpenApi, Ref, RefOr, Response};

/// Completes the tags, parameters and responses of all operations.
pub(super) fn complete_operations(contract: &mut OpenApi) {
    for (path, item) in &mut contract.paths.paths {
        let resource = path.strip_prefix("/v1/").and_then(|path| path.split('/').next());
        for (_, operation) in operations(item) {
            if let Some(resource) = resource {
                operation.tags.get_or_insert_with(|| vec![resource.to_owned()]);
                describe_parameters(resource, operation);
                add_common_errors(resource, operation);
            }
            for (status, response) in &mut operation.responses.responses {
                if let RefOr::T(response) = response {
                    complete(status, response);
                }
            }
        }
    }
}

/// The operations of a path, with their methods.
pub(super) fn operations(item: &mut PathItem) -> impl Iterator<Item = (Method, &mut Operation)> {
    let operations = [
        (Method::GET, &mut item.get),
        (Method::POST, &mut item.post),
        (Method::DELETE, &mut item.delete),
    ];
    operations
        .into_iter()
        .filter_map(|(method, operation)| Some((method, operation.as_mut()?)))
}

/// The parameters of an operation, all of which are written in place.
fn parameters(operation: &Operation) -> impl Iterator<Item = &Parameter> {
    operation
        .parameters
        .iter()
        .flatten()
        .filter_map(|parameter| match parameter {
            RefOr::T(parameter) => Some(parameter),
            RefOr::Ref(_) => None,
        })
}

fn describe_parameters(resource: &str, operation: &mut Operation) {
    for parameter in operation.parameters.iter_mut().flatten() {
        let RefOr::T(parameter) = parameter else { continue };
        let description = match (resource, parameter.name.as_str()) {
            ("models", "model") => "The model's name",
            ("models", "version") => "The version",
            ("datasets", "dataset") => "The data set's name",
            ("datasets", "episode") => "The episode's number, from 0",
            ("environments", "id") => "The environment's id",
            ("jobs", "id") => "The job's id",
            ("uploads", "id") => "The upload's id",
            ("jobs", "file") => "The file's name",
            ("sessions" | "realtime", "id") => "The session's id",
            ("sessions", "token") => "The session's token; or as header `x-session-token`",
            ("sessions", "x-session-token") => "The session's token; or as query parameter `token`",
            _ => continue,
        };
        parameter.description = Some(description.to_owned());
    }
}

/// Adds the errors that the operation does not list itself.
fn add_common_errors(resource: &str, operation: &mut Operation) {
    let has_token = parameters(operation).any(|parameter| parameter.name.ends_with("token"));
    let mut common = vec![
        ("401", "No valid API key; only if authentication is on"),
        ("429", "The API key's rate limit is reached"),
    ];
    common.push(if has_token {
        ("403", "Not the session's token")
    } else {
        ("403", "The API key's scope does not include this")
    });
    let in_path = parameters(operation).filter(|parameter| parameter.parameter_in == ParameterIn::Path);
    let are_numbers: Vec<bool> = in_path.map(is_number).collect();
    if !are_numbers.is_empty() {
        common.extend(match resource {
            "models" => vec![("404", "No such model")],
            "datasets" => vec![("404", "No such data set")],
            "environments" => vec![(
                "404",
                "No such environment of this API key; one that nobody steps is dropped",
            )],
            "jobs" => vec![("404", "No such job")],
            "uploads" => vec![("404", "No such upload")],
            "sessions" => vec![("404", "No such session"), ("410", "It has expired")],
            "realtime" => vec![("404", "No such session")],
            _ => Vec::new(),
        });
        if are_numbers.contains(&true) {
            common.push(("400", "A number in the path is not one"));
        }
    }
    if parameters(operation).any(|parameter| parameter.parameter_in == ParameterIn::Query) {
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
        let response = || RefOr::T(Response::new(description));
        responses.entry(status.to_owned()).or_insert_with(response);
    }
}

fn is_number(parameter: &Parameter) -> bool {
    matches!(&parameter.schema, Some(RefOr::T(Schema::Object(object))) if object.schema_type == SchemaType::Type(Type::Integer))
}

/// The description that OpenAPI requires, the body of errors, and when to try again.
fn complete(status: &str, response: &mut Response) {
    if response.description.is_empty() {
        "Done".clone_into(&mut response.description);
    }
    if status.starts_with(['4', '5']) {
        let problem = Content::new(Some(Ref::from_schema_name("Problem")));
        response
            .content
            .insert("application/problem+json".to_owned(), RefOr::T(problem));
    }
    if ["429", "503"].contains(&status) {
        let seconds = Header::new(utoipa::schema!(u64));
        response.headers.insert("Retry-After".to_owned(), RefOr::T(seconds));
    }
}
