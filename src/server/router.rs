//! All routes with the layers around them. A route is declared once, at its handler; this also makes the contract.

use std::sync::Arc;

use axum::extract::DefaultBodyLimit;
use axum::middleware::from_fn_with_state;
use axum::{Extension, Router};
use utoipa::openapi::OpenApi;
use utoipa_axum::router::OpenApiRouter;

use super::config::ServerConfig;
use super::http::body_budget;
use super::http::keys;
use super::http::middleware::{self, RequestTrace};
use super::http::origin::{self, OriginPolicy};
use super::http::problem::ApiError;
use super::http::requests;
use super::openapi;
use super::routes::{
    audit, datasets, environments, episodes, events, health, inference_protocol, job_events, jobs, metrics, models,
    openenv, openpi, pages, plans, predict, preview, rollouts, sessions, streams, uploads, world_sessions,
};
use super::state::App;

/// Every route of the service.
pub fn router(app: App) -> Router {
    let config = app.config();
    let api = request_routes(config)
        .route_layer(from_fn_with_state(app.requests.clone(), requests::answer))
        .merge(stream_routes())
        .route_layer(from_fn_with_state(app.keys.clone(), keys::check));
    let (router, contract) = open_routes().merge(api).split_for_parts();
    let document = openapi::text(contract);
    let trace = RequestTrace::new(config, Arc::clone(&app.draining));
    let origins = OriginPolicy::new(config, app.keys.clone());
    router
        .merge(pages::docs())
        .layer(Extension(pages::ContractText(document.into())))
        .method_not_allowed_fallback(async || ApiError::MethodNotAllowed)
        .fallback(async || ApiError::NotFound("there is nothing at this path; see /openapi.json".to_owned()))
        .layer(DefaultBodyLimit::max(config.max_body_bytes))
        .layer(from_fn_with_state(app.body_budget.clone(), body_budget::count))
        .layer(from_fn_with_state(origins, origin::check))
        .layer(from_fn_with_state(trace, middleware::trace))
        .with_state(app)
}

/// The OpenAPI 3.1 document of the whole service, as JSON with a line break at its end.
#[must_use]
pub fn openapi_document() -> String {
    openapi::text(contract(&ServerConfig::default()))
}

fn contract(config: &ServerConfig) -> OpenApi {
    open_routes()
        .merge(request_routes(config))
        .merge(stream_routes())
        .into_openapi()
}

/// The routes that need no API key.
fn open_routes() -> OpenApiRouter<App> {
    OpenApiRouter::with_openapi(openapi::frame())
        .merge(pages::routes())
        .merge(health::routes())
        .merge(metrics::routes())
        .merge(inference_protocol::open_routes())
}

/// The routes of requests; they need an API key if authentication is on.
fn request_routes(config: &ServerConfig) -> OpenApiRouter<App> {
    OpenApiRouter::new()
        .merge(models::routes())
        .merge(predict::routes())
        .merge(preview::routes())
        .merge(rollouts::routes())
        .merge(plans::routes())
        .merge(sessions::routes())
        .merge(jobs::routes(config.max_job_bytes))
        .merge(datasets::routes())
        .merge(episodes::routes())
        .merge(environments::routes())
        .merge(uploads::routes())
        .merge(world_sessions::routes())
        .merge(openenv::routes())
        .merge(audit::routes())
        .merge(inference_protocol::routes())
}

/// The routes of streams, which have limits of their own; they need an API key if authentication is on.
fn stream_routes() -> OpenApiRouter<App> {
    OpenApiRouter::new()
        .merge(streams::routes())
        .merge(openpi::routes())
        .merge(openenv::stream_routes())
        .merge(job_events::routes())
        .merge(events::routes())
}
