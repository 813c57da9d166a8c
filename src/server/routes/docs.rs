//! The contract as pages where requests can be tried out. Their scripts are part of the program: nothing is fetched from
//! elsewhere.

use axum::Router;
use utoipa_swagger_ui::{Config, SwaggerUi};

use crate::server::state::App;

/// `/docs`.
pub(in crate::server) fn routes() -> Router<App> {
    // Otherwise the pages would ask a validator on the internet.
    let config = Config::from("/openapi.json").validator_url("none");
    SwaggerUi::new("/docs").config(config).into()
}
