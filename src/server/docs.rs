//! The contract as pages that can be tried out. Their scripts are in the program: nothing is fetched from elsewhere.

use axum::Router;
use utoipa_swagger_ui::{Config, SwaggerUi};

use super::App;

/// `/docs`.
pub(super) fn router() -> Router<App> {
    // The pages would otherwise ask a validator on the internet.
    let config = Config::from("/openapi.json").validator_url("none");
    SwaggerUi::new("/docs").config(config).into()
}
