//! Which scope each operation needs, and which operations change state for good, so that they are audited.

use axum::extract::{MatchedPath, Request};
use axum::http::Method;

use foreframe_jobs::store::KeyScope;

/// The template of the route that a request takes; empty if there is none.
pub(super) fn route(request: &Request) -> &str {
    request.extensions().get().map_or("", MatchedPath::as_str)
}

/// The scope that a request needs, by its method and its route's template. A route without a rule needs `admin`.
pub(in crate::server) fn required_scope(method: &Method, route: &str) -> KeyScope {
    // The Open Inference Protocol only predicts, OpenEnv only simulates.
    if route.starts_with("/v2/") || route.starts_with("/openenv/") {
        return KeyScope::Predict;
    }
    let mut parts = route.split('/').skip(2);
    let (resource, changes_versions) = (parts.next().unwrap_or_default(), route.contains("/versions/"));
    match resource {
        "models" if changes_versions => KeyScope::Admin,
        "models" | "sessions" | "realtime" | "environments" | "events" => KeyScope::Predict,
        "datasets" if *method == Method::DELETE => KeyScope::Admin,
        "datasets" | "jobs" | "uploads" => KeyScope::Jobs,
        _ => KeyScope::Admin,
    }
}

/// Whether the body of a request is written to the disk as it comes: it may be long and take long, and is not held in memory.
pub(super) fn is_upload(route: &str) -> bool {
    route == "/v1/uploads"
}

/// The operations that change state for good: each writes an entry of the audit trail with its change, and is completed also if
/// the client goes away. Sessions, environments and predictions change nothing that lasts.
const AUDITED: [(&str, &str); 6] = [
    ("POST", "/v1/jobs"),
    ("POST", "/v1/jobs/{id}/cancel"),
    ("POST", "/v1/jobs/{id}/resume"),
    ("POST", "/v1/models/{model}/versions/{version}/activate"),
    ("DELETE", "/v1/models/{model}/versions/{version}"),
    ("DELETE", "/v1/datasets/{dataset}"),
];

/// Whether a request changes state for good, by its method and its route's template.
pub(super) fn is_audited(method: &Method, route: &str) -> bool {
    AUDITED.contains(&(method.as_str(), route))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_route_without_a_rule_needs_the_scope_admin() {
        for (method, route, scope) in [
            (Method::GET, "/v1/models", KeyScope::Predict),
            (Method::POST, "/v1/models/{model}/predict", KeyScope::Predict),
            (Method::DELETE, "/v1/models/{model}/versions/{version}", KeyScope::Admin),
            (Method::GET, "/v1/events", KeyScope::Predict),
            (Method::POST, "/v1/realtime/sessions/{id}/step", KeyScope::Predict),
            (Method::GET, "/v1/datasets", KeyScope::Jobs),
            (Method::DELETE, "/v1/datasets/{dataset}", KeyScope::Admin),
            (Method::POST, "/v1/jobs", KeyScope::Jobs),
            (Method::POST, "/v1/uploads", KeyScope::Jobs),
            (Method::GET, "/v1/audit", KeyScope::Admin),
            (Method::GET, "/v1/new", KeyScope::Admin),
            (Method::GET, "/openenv/{scenario}/ws", KeyScope::Predict),
            (
                Method::POST,
                "/v2/models/{model}/versions/{version}/infer",
                KeyScope::Predict,
            ),
        ] {
            assert_eq!(required_scope(&method, route), scope, "{method} {route}");
        }
    }
}
