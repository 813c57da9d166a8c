//! The contract as pages where requests can be tried out. Their scripts are part of the program: nothing is fetched from
//! elsewhere.

use axum::Router;
use axum::http::{HeaderValue, header};
use axum::middleware::map_response;
use axum::response::Response;
use utoipa_swagger_ui::{Config, SwaggerUi};

use crate::server::state::App;

/// Everything comes from this server. The pages write styles into their elements.
const CONTENT_SECURITY_POLICY: &str = "default-src 'self'; img-src 'self' data:; script-src 'self'; \
     style-src 'self' 'unsafe-inline'; object-src 'none'; base-uri 'none'; frame-ancestors 'none'";

/// `/docs`.
pub(in crate::server) fn routes() -> Router<App> {
    // Otherwise the pages would ask a validator on the internet.
    let config = Config::from("/openapi.json").validator_url("none");
    let pages: Router<App> = SwaggerUi::new("/docs").config(config).into();
    pages.layer(map_response(async |mut page: Response| {
        let policy = HeaderValue::from_static(CONTENT_SECURITY_POLICY);
        page.headers_mut().insert(header::CONTENT_SECURITY_POLICY, policy);
        page
    }))
}
