//! The service over HTTP and WebSocket: [`serve`] answers until told to stop, then ends what it began. [`App`] is what
//! the handlers share, [`protocol`] the stream's messages, [`openapi`] the contract.

mod config;
mod dashboard;
mod datasets;
mod error;
mod events;
mod extract;
mod health;
mod images;
mod jobs;
mod listener;
mod middleware;
mod models;
mod picture;
mod predict;
mod preview;
mod session;
mod stream;
mod streams;

pub mod openapi;
pub mod protocol;
pub mod shutdown;

use std::sync::Arc;
use std::time::{Duration, Instant};

use axum::Router;
use axum::extract::DefaultBodyLimit;
use axum::routing::{delete, get, post};
use tokio::net::TcpListener;
use tracing::{info, warn};

pub use config::ServerConfig;
use error::ApiError;
pub use error::Problem;
pub use images::ImageFormat;
use listener::BoundedListener;
use middleware::RequestIds;
use streams::Streams;

use crate::jobs::pipeline::Pipeline;
use crate::jobs::{JobError, Jobs};
use crate::registry::LoadedModel;
use crate::serving::{Predictor, ServingError};
use crate::store::{Store, StoreError};
use crate::versions::{VersionError, Versions};

/// Why the server could not start or go on.
#[derive(Debug, thiserror::Error)]
pub enum ServerError {
    /// A setting is out of range.
    #[error("{field} is {value}; it must be {least} to {most}")]
    Config {
        /// The setting.
        field: &'static str,
        /// Its value.
        value: u64,
        /// The least it may be.
        least: u64,
        /// The most it may be.
        most: u64,
    },
    /// The predictor could not start.
    #[error(transparent)]
    Serving(#[from] ServingError),
    /// The job runner could not start.
    #[error(transparent)]
    Jobs(#[from] JobError),
    /// The store could not be opened.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// The models could not be listed.
    #[error(transparent)]
    Versions(Box<VersionError>),
    /// The listener failed.
    #[error("could not listen for connections")]
    Listen(#[source] std::io::Error),
}

impl From<VersionError> for ServerError {
    fn from(error: VersionError) -> Self {
        Self::Versions(Box::new(error))
    }
}

/// What [`finish`] may take past the deadline to say what did not end.
const GRACE: Duration = Duration::from_millis(200);
/// How often it is asked which versions other servers of the store activated.
const FOLLOW_EVERY: Duration = Duration::from_secs(1);

/// What the handlers share; clones are the same.
#[derive(Clone)]
pub struct App {
    shared: Arc<Shared>,
}

struct Shared {
    config: ServerConfig,
    predictor: Predictor,
    jobs: Jobs,
    store: Store,
    versions: Versions,
    streams: Streams,
    request_ids: RequestIds,
    contract: String,
}

impl App {
    /// Opens the store, loads the models that are to serve, and starts. To be called within a tokio runtime.
    /// Errors: `Config`, `Store`, `Versions`, `Serving`, `Jobs`.
    pub async fn open(config: ServerConfig) -> Result<Self, ServerError> {
        config.validate()?;
        let store = Store::open(&config.store()).await?;
        let models = Versions::new(store.clone(), &config.models_dir).serving().await?;
        Self::start(config, models, store)
    }

    /// Starts the threads that predict with these models and that run jobs. To be called within a tokio runtime.
    /// Errors: `Config`, `Serving`, `Jobs`.
    pub fn start(config: ServerConfig, models: Vec<LoadedModel>, store: Store) -> Result<Self, ServerError> {
        config.validate()?;
        let predictor = Predictor::start(models, config.predictor())?;
        let versions = Versions::new(store.clone(), &config.models_dir);
        let pipeline = Pipeline::new(store.clone(), versions, config.job_threads);
        let jobs = Jobs::start(store.clone(), config.jobs(), Arc::new(pipeline), config.run_jobs)?;
        let app = Self::with_parts(config, predictor, jobs, store);
        tokio::spawn(follow(app.clone()));
        Ok(app)
    }

    /// From parts that have been started, for example a job runner with other work. The configuration is not checked.
    #[must_use]
    pub fn with_parts(config: ServerConfig, predictor: Predictor, jobs: Jobs, store: Store) -> Self {
        let streams = Streams::new(config.max_streams);
        let versions = Versions::new(store.clone(), &config.models_dir);
        Self {
            shared: Arc::new(Shared {
                config,
                predictor,
                jobs,
                store,
                versions,
                streams,
                request_ids: RequestIds::new(),
                contract: openapi::document(),
            }),
        }
    }

    /// The predictor.
    #[must_use]
    pub fn predictor(&self) -> &Predictor {
        &self.shared.predictor
    }

    /// The jobs.
    #[must_use]
    pub fn jobs(&self) -> &Jobs {
        &self.shared.jobs
    }

    /// Where state is kept.
    #[must_use]
    pub fn store(&self) -> &Store {
        &self.shared.store
    }

    /// The versions of the models.
    #[must_use]
    pub fn versions(&self) -> &Versions {
        &self.shared.versions
    }

    /// The settings.
    #[must_use]
    pub fn config(&self) -> &ServerConfig {
        &self.shared.config
    }

    fn streams(&self) -> &Streams {
        &self.shared.streams
    }

    fn request_ids(&self) -> &RequestIds {
        &self.shared.request_ids
    }

    fn contract(&self) -> &str {
        &self.shared.contract
    }
}

/// Every route of the service.
pub fn router(app: App) -> Router {
    Router::new()
        .route("/", get(dashboard::page))
        .route("/livez", get(health::livez))
        .route("/readyz", get(health::readyz))
        .route("/openapi.json", get(openapi::openapi_json))
        .route("/v1/models", get(models::list))
        .route("/v1/models/{model}", get(models::get))
        .route("/v1/models/{model}/versions/{version}", delete(models::delete))
        .route("/v1/models/{model}/versions/{version}/activate", post(models::activate))
        .route("/v1/models/{model}/predict", post(predict::predict))
        .route("/v1/models/{model}/preview.png", get(preview::preview))
        .route("/v1/models/{model}/stream", get(stream::stream))
        .route("/v1/jobs", post(jobs::create).get(jobs::list))
        .route("/v1/jobs/{id}", get(jobs::get))
        .route("/v1/jobs/{id}/cancel", post(jobs::cancel))
        .route("/v1/jobs/{id}/resume", post(jobs::resume))
        .route("/v1/jobs/{id}/events", get(events::events))
        .route("/v1/jobs/{id}/logs", get(jobs::logs))
        .route("/v1/jobs/{id}/metrics", get(jobs::metrics))
        .route("/v1/jobs/{id}/files/{file}", get(jobs::file))
        .route("/v1/datasets", get(datasets::list))
        .route("/v1/datasets/{dataset}", get(datasets::get).delete(datasets::delete))
        .route(
            "/v1/datasets/{dataset}/episodes/{episode}/preview.png",
            get(datasets::sheet),
        )
        .route(
            "/v1/datasets/{dataset}/episodes/{episode}/preview.gif",
            get(datasets::animation),
        )
        .method_not_allowed_fallback(async || ApiError::MethodNotAllowed)
        .fallback(async || ApiError::NotFound("there is nothing at this path; see /openapi.json".to_owned()))
        .layer(DefaultBodyLimit::max(app.config().max_body_bytes))
        .layer(axum::middleware::from_fn_with_state(app.clone(), middleware::trace))
        .with_state(app)
}

/// Answers on the listener until `shutdown` completes; then takes no more connections, answers the requests it has,
/// closes every stream with 1001, has the running job write its checkpoint, and returns when all have ended or the
/// deadline has passed.
/// Errors: `Listen`.
pub async fn serve(
    listener: TcpListener,
    app: App,
    shutdown: impl Future<Output = ()> + Send + 'static,
) -> Result<(), ServerError> {
    let limit = Duration::from_millis(app.config().shutdown_deadline_ms);
    let (told, mut deadline) = tokio::sync::watch::channel(None::<Instant>);
    let listener = BoundedListener::new(listener, app.config().max_connections);
    let of_signal = app.clone();
    let signal = async move {
        shutdown.await;
        info!("stopping");
        of_signal.streams().stop();
        of_signal.jobs().begin_stop();
        told.send_replace(Some(Instant::now() + limit));
    };
    let server = axum::serve(listener, router(app.clone())).with_graceful_shutdown(signal);
    let at_end = deadline.clone();
    let work = async {
        server.await.map_err(ServerError::Listen)?;
        let deadline = at_end.borrow().unwrap_or_else(Instant::now);
        finish(app, deadline).await;
        Ok(())
    };
    let over = async {
        // The sender lives until it has sent.
        let deadline = deadline
            .wait_for(Option::is_some)
            .await
            .ok()
            .and_then(|deadline| *deadline);
        tokio::time::sleep_until((deadline.unwrap_or_else(Instant::now) + GRACE).into()).await;
    };
    tokio::select! {
        result = work => result,
        () = over => {
            warn!("some requests were not answered within the deadline");
            Ok(())
        }
    }
}

/// Waits for the streams, the running job and the predictor to end.
async fn finish(app: App, deadline: Instant) {
    let streams = tokio::time::timeout_at(deadline.into(), app.streams().ended());
    if streams.await.is_err() {
        warn!("some streams did not end within the deadline");
    }
    let ended = app.jobs().finish_stop(deadline).await;
    let stopped = blocking(move || app.predictor().stop()).await;
    if ended && stopped.is_ok() {
        info!("stopped");
    }
}

/// Loads the versions that were activated elsewhere, or published by a job as the first of their name, until stopped.
async fn follow(app: App) {
    let (mut stopping, mut refused) = (app.streams().stopping(), std::collections::BTreeSet::new());
    loop {
        tokio::select! {
            () = app.jobs().ended() => {}
            () = tokio::time::sleep(FOLLOW_EVERY) => {}
            () = streams::told(&mut stopping) => return,
        }
        if let Err(error) = app.versions().follow(app.predictor(), &mut refused).await {
            warn!(%error, "could not look for newly activated versions");
        }
    }
}

/// Runs what would hold up the other requests on a thread for such work. Errors: `Internal` if it panicked.
async fn blocking<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> Result<T, ApiError> {
    let span = tracing::Span::current();
    tokio::task::spawn_blocking(move || span.in_scope(work))
        .await
        .map_err(|error| ApiError::Internal(error.to_string()))
}
