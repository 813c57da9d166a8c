//! The service over HTTP and WebSocket: [`serve`] answers until told to stop, then ends what it began. [`App`] is what
//! the handlers share, [`protocol`] the stream's messages, [`openapi`] the contract.

mod admission;
mod config;
mod connections;
mod dashboard;
mod datasets;
mod docs;
mod environments;
mod error;
mod events;
mod extract;
mod health;
mod images;
mod jobs;
mod listener;
mod metrics;
mod middleware;
mod models;
mod multipart;
mod origin;
mod page;
mod picture;
mod predict;
mod preview;
mod rollouts;
mod sessions;
mod stream;
mod streams;

pub mod keys;
pub mod openapi;
pub mod protocol;
pub mod shutdown;

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use axum::Router;
use axum::extract::DefaultBodyLimit;
use axum::routing::{delete, get, post};
use tokio::net::TcpListener;
use tokio::time::{timeout, timeout_at};
use tracing::{Instrument as _, info, warn};

use admission::Admission;
pub use config::ServerConfig;
use connections::Connections;
use environments::Environments;
use error::ApiError;
pub use error::Problem;
pub use images::{ImageBytes, ImageFormat};
use keys::Keys;
use listener::BoundedListener;
use middleware::RequestIds;
use sessions::table::SessionTable;
use streams::Streams;

use crate::jobs::child;
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
}

impl From<VersionError> for ServerError {
    fn from(error: VersionError) -> Self {
        Self::Versions(Box::new(error))
    }
}

/// What [`serve`] may take past the deadline to say what did not end.
const GRACE: Duration = Duration::from_millis(200);
/// How often it is asked which versions other servers of the store activated.
const FOLLOW_EVERY: Duration = Duration::from_secs(1);

/// What the handlers share; clones are the same.
#[derive(Clone)]
pub struct App {
    shared: Arc<AppState>,
    keys: Keys,
}

struct AppState {
    config: ServerConfig,
    predictor: Predictor,
    jobs: Jobs,
    store: Store,
    versions: Versions,
    streams: Streams,
    admission: Admission,
    environments: Environments,
    draining: AtomicBool,
    sessions: SessionTable,
    request_ids: RequestIds,
    contract: String,
}

impl App {
    /// Opens the store, loads the models that are to serve, and starts. To be called within a tokio runtime.
    /// Errors: `Config`, `Store`, `Versions`, `Serving`, `Jobs`.
    pub async fn open(config: ServerConfig) -> Result<Self, ServerError> {
        config.validate()?;
        let store = Store::open(&config.store()).await?;
        let models = Versions::new(store.clone(), &config.models_dir).load_serving().await?;
        Self::start(config, models, store)
    }

    /// Starts the threads that predict with these models and that run jobs. To be called within a tokio runtime.
    /// Errors: `Config`, `Serving`, `Jobs`.
    pub fn start(config: ServerConfig, models: Vec<LoadedModel>, store: Store) -> Result<Self, ServerError> {
        config.validate()?;
        let predictor = Predictor::start(models, config.predictor())?;
        let versions = Versions::new(store.clone(), &config.models_dir);
        let pipeline = Pipeline::new(store.clone(), versions, config.job_threads).with_memory_limit(config.job_memory_mb);
        let executor = child::executor(pipeline, config.job_process());
        let jobs = Jobs::start(store.clone(), config.jobs(), executor, !config.no_jobs)?;
        let app = Self::with_parts(config, predictor, jobs, store);
        tokio::spawn(follow(app.clone()));
        Ok(app)
    }

    /// From parts that have been started, for example a job runner with other work. The configuration is not checked.
    #[must_use]
    pub fn with_parts(config: ServerConfig, predictor: Predictor, jobs: Jobs, store: Store) -> Self {
        let streams = Streams::new(config.max_streams);
        let admission = Admission::new(&config);
        let idle = Duration::from_millis(config.environment_idle_ms);
        let environments = Environments::new(config.max_environments, idle);
        let sessions = SessionTable::new(config.max_sessions, Duration::from_millis(config.session_grace_ms));
        let versions = Versions::new(store.clone(), &config.models_dir);
        Self {
            shared: Arc::new(AppState {
                config,
                predictor,
                jobs,
                store,
                versions,
                streams,
                admission,
                environments,
                draining: AtomicBool::new(false),
                sessions,
                request_ids: RequestIds::new(),
                contract: openapi::document(),
            }),
            keys: Keys::open(),
        }
    }

    /// The same with these keys; without, everybody may call.
    #[must_use]
    pub fn with_keys(self, keys: Keys) -> Self {
        Self { keys, ..self }
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

    fn keys(&self) -> &Keys {
        &self.keys
    }

    fn streams(&self) -> &Streams {
        &self.shared.streams
    }

    fn admission(&self) -> &Admission {
        &self.shared.admission
    }

    fn environments(&self) -> &Environments {
        &self.shared.environments
    }

    /// Whether the server is about to end: it answers, and wants no more.
    fn is_draining(&self) -> bool {
        self.shared.draining.load(Ordering::Acquire)
    }

    fn drain(&self) {
        self.shared.draining.store(true, Ordering::Release);
    }

    fn sessions(&self) -> &SessionTable {
        &self.shared.sessions
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
        .route("/dashboard.js", get(dashboard::script))
        .route("/dashboard.css", get(dashboard::style))
        .route("/livez", get(health::livez))
        .route("/readyz", get(health::readyz))
        .route("/metrics", get(metrics::metrics))
        .route("/openapi.json", get(openapi::openapi_json))
        .route("/asyncapi.yaml", get(openapi::asyncapi_yaml))
        .merge(docs::router())
        .merge(api(&app))
        .method_not_allowed_fallback(async || ApiError::MethodNotAllowed)
        .fallback(async || ApiError::NotFound("there is nothing at this path; see /openapi.json".to_owned()))
        .layer(DefaultBodyLimit::max(app.config().max_body_bytes))
        .layer(axum::middleware::from_fn_with_state(app.clone(), origin::check))
        .layer(axum::middleware::from_fn_with_state(app.clone(), middleware::trace))
        .with_state(app)
}

/// The routes that need a key where keys are asked for.
fn api(app: &App) -> Router<App> {
    let job_limit = DefaultBodyLimit::max(app.config().max_job_bytes);
    let jobs_route = post(jobs::create).layer(job_limit).get(jobs::list);
    Router::new()
        .route("/v1/models", get(models::list))
        .route("/v1/models/{model}", get(models::get))
        .route("/v1/models/{model}/versions/{version}", delete(models::delete))
        .route("/v1/models/{model}/versions/{version}/activate", post(models::activate))
        .route("/v1/models/{model}/predict", post(predict::predict))
        .route("/v1/models/{model}/preview.png", get(preview::preview))
        .route("/v1/models/{model}/rollouts", post(rollouts::of_model))
        .route("/v1/models/{model}/stream", get(stream::of_model))
        .route("/v1/sessions", post(sessions::create).get(sessions::list))
        .route("/v1/sessions/{id}", get(sessions::get).delete(sessions::delete))
        .route("/v1/sessions/{id}/state", get(sessions::state))
        .route("/v1/sessions/{id}/rollouts", post(rollouts::of_session))
        .route("/v1/sessions/{id}/stream", get(stream::of_session))
        .route("/v1/jobs", jobs_route)
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
        .route("/v1/environments", post(environments::create))
        .route("/v1/environments/{id}", delete(environments::delete))
        .route("/v1/environments/{id}/reset", post(environments::reset))
        .route("/v1/environments/{id}/step", post(environments::step))
        .route_layer(axum::middleware::from_fn_with_state(app.clone(), keys::check))
}

/// Answers on the listener until `shutdown` completes. Then it is not ready but goes on for `drain_ms`; takes no more
/// connections, answers the requests it has, closes every stream with 1001, has the running job write its
/// checkpoint, and returns when all have ended or the deadline has passed.
pub async fn serve(listener: TcpListener, app: App, shutdown: impl Future<Output = ()>) {
    let config = app.config();
    let limit = Duration::from_millis(config.shutdown_deadline_ms);
    let drain = Duration::from_millis(config.drain_ms);
    let listener = BoundedListener::new(listener, config);
    let mut connections = Connections::new(&app);
    tokio::select! {
        never = connections.accept(&listener) => match never {},
        never = metrics::keep_folded() => match never {},
        never = app.keys().keep_fresh(Duration::from_millis(config.key_refresh_ms)) => match never {},
        () = shutdown => {}
    }
    info!("stopping");
    let deadline = Instant::now() + limit;
    app.drain();
    app.jobs().begin_stop();
    // Even without time to drain, connections that are established are taken: their clients wait for an answer.
    let Err(_) = timeout(drain, connections.accept(&listener)).await;
    drop(listener);
    app.streams().stop();
    if timeout_at(deadline.into(), connections.ended()).await.is_err() {
        warn!("some requests were not answered within the deadline");
    }
    if timeout_at(deadline.into(), app.streams().ended()).await.is_err() {
        warn!("some streams did not end within the deadline");
    }
    let ended = async {
        let left = app.jobs().finish_stop(deadline).await;
        let predictor = app.predictor().clone();
        left && blocking(move || predictor.stop()).await.is_ok()
    };
    if timeout_at((deadline + GRACE).into(), ended).await == Ok(true) {
        info!("stopped");
    } else {
        warn!("a computation did not end within the deadline");
    }
}

/// Loads the versions that were activated elsewhere, or published by a job as the first of their name, until stopped.
async fn follow(app: App) {
    let (mut stopping, mut refused) = (app.streams().stopping(), std::collections::BTreeSet::new());
    loop {
        tokio::select! {
            () = app.jobs().job_ended() => {}
            () = tokio::time::sleep(FOLLOW_EVERY) => {}
            () = streams::told(&mut stopping) => return,
        }
        if let Err(error) = app.versions().load_activated(app.predictor(), &mut refused).await {
            warn!(%error, "could not look for newly activated versions");
        }
    }
}

/// Goes on with what must not end half-way, even if whoever asked for it goes. Errors: `Internal` if it panicked.
async fn to_its_end<T: Send + 'static>(work: impl Future<Output = T> + Send + 'static) -> Result<T, ApiError> {
    tokio::spawn(work.in_current_span())
        .await
        .map_err(|error| ApiError::Internal(error.to_string()))
}

/// Runs what would hold up the other requests on a thread for such work. Errors: `Internal` if it panicked.
async fn blocking<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> Result<T, ApiError> {
    let span = tracing::Span::current();
    tokio::task::spawn_blocking(move || span.in_scope(work))
        .await
        .map_err(|error| ApiError::Internal(error.to_string()))
}
