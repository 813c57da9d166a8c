//! Which scope each operation needs, and which operations change state for good, so that they are audited.

use axum::http::{Method, header};
use axum::response::Response;

use crate::store::KeyScope;

/// The scope that a request needs, by its method and its route's template. A route without a rule needs `admin`.
pub(in crate::server) fn required_scope(method: &Method, route: &str) -> KeyScope {
    let mut parts = route.split('/').skip(2);
    let (resource, changes_versions) = (parts.next().unwrap_or_default(), route.contains("/versions/"));
    match resource {
        "models" if changes_versions => KeyScope::Admin,
        "models" | "sessions" | "environments" => KeyScope::Predict,
        "datasets" if *method == Method::DELETE => KeyScope::Admin,
        "datasets" | "jobs" => KeyScope::Jobs,
        _ => KeyScope::Admin,
    }
}

/// A change of state by a request.
#[derive(Debug, PartialEq)]
pub(super) struct Change {
    /// For example `job.create`.
    pub(super) action: &'static str,
    /// What the path names; empty for a new job.
    target: String,
}

impl Change {
    /// The change that a request asks for, if it is one. Sessions, environments and predictions change nothing that lasts.
    pub(super) fn of(method: &Method, route: &str, path: &str) -> Option<Self> {
        let mut parts = path.split('/').skip(3);
        let (name, version) = (parts.next().unwrap_or_default(), parts.nth(1).unwrap_or_default());
        let (action, target) = match (method.as_str(), route) {
            ("POST", "/v1/jobs") => ("job.create", String::new()),
            ("POST", "/v1/jobs/{id}/cancel") => ("job.cancel", name.to_owned()),
            ("POST", "/v1/jobs/{id}/resume") => ("job.resume", name.to_owned()),
            ("POST", "/v1/models/{model}/versions/{version}/activate") => {
                ("version.activate", format!("{name}@{version}"))
            }
            ("DELETE", "/v1/models/{model}/versions/{version}") => ("version.delete", format!("{name}@{version}")),
            ("DELETE", "/v1/datasets/{dataset}") => ("dataset.delete", name.to_owned()),
            _ => return None,
        };
        Some(Self { action, target })
    }

    /// What was changed; a new job is named by the response.
    pub(super) fn target(&self, response: &Response) -> String {
        if !self.target.is_empty() {
            return self.target.clone();
        }
        let location = response.headers().get(header::LOCATION);
        let path = location.and_then(|path| path.to_str().ok()).unwrap_or_default();
        path.rsplit('/').next().unwrap_or_default().to_owned()
    }
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
            (Method::GET, "/v1/datasets", KeyScope::Jobs),
            (Method::DELETE, "/v1/datasets/{dataset}", KeyScope::Admin),
            (Method::POST, "/v1/jobs", KeyScope::Jobs),
            (Method::GET, "/v1/audit", KeyScope::Admin),
            (Method::GET, "/v1/new", KeyScope::Admin),
        ] {
            assert_eq!(required_scope(&method, route), scope, "{method} {route}");
        }
    }

    #[test]
    fn a_change_names_what_it_changes() {
        let change = |method, route, path| Change::of(&method, route, path);
        let route = "/v1/models/{model}/versions/{version}/activate";
        let activated = change(Method::POST, route, "/v1/models/mine/versions/2/activate").unwrap();
        assert_eq!(
            (activated.action, activated.target.as_str()),
            ("version.activate", "mine@2")
        );
        let mut response = Response::default();
        let location = axum::http::HeaderValue::from_static("/v1/jobs/job-7");
        response.headers_mut().insert(header::LOCATION, location);
        let created = change(Method::POST, "/v1/jobs", "/v1/jobs").unwrap();
        assert_eq!(created.target(&response), "job-7");
        assert_eq!(change(Method::POST, "/v1/sessions", "/v1/sessions"), None);
    }
}
