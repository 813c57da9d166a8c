//! The first page: what this is, which models there are, what runs.

use axum::http::header;
use axum::response::{Html, IntoResponse};

const PAGE: &str = include_str!("dashboard/index.html");
/// The page's own script and style, and pictures from this server; nothing from elsewhere.
const CONTENT_SECURITY_POLICY: &str =
    "default-src 'self'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; frame-ancestors 'none'";

/// A page for people.
#[utoipa::path(
    get, path = "/", tag = "about",
    responses((status = 200, description = "A page", content_type = "text/html"))
)]
pub(super) async fn page() -> impl IntoResponse {
    ([(header::CONTENT_SECURITY_POLICY, CONTENT_SECURITY_POLICY)], Html(PAGE))
}
