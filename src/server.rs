//! The service over HTTP and WebSocket: [`serve`] answers until told to stop, then ends what it began. [`App`] is what
//! the handlers share, [`protocol`] the stream's messages, [`openapi`] the contract.

mod config;
mod dashboard;
mod error;
mod extract;
mod health;
mod images;
mod jobs;
mod listener;
mod middleware;
mod models;
mod multipart;
mod picture;
mod predict;
mod preview;
mod rollouts;
mod sessions;
mod stream;
mod streams;

pub mod openapi;
pub mod protocol;
pub mod shutdown;

use std::sync::Arc;
use std::time::{Duration, Instant};

use axum::Router;
use axum::extract::DefaultBodyLimit;
use axum::routing::{get, post};
use tokio::net::TcpListener;
use tracing::{info, warn};

pub use config::ServerConfig;
use error::ApiError;
pub use error::Problem;
pub use images::{ImageBytes, ImageFormat};
use listener::BoundedListener;
use middleware::RequestIds;
use sessions::table::Table;
use streams::Streams;

use crate::jobs::pipeline::Pipeline;
use crate::jobs::{JobError, Jobs};
use crate::registry::LoadedModel;
use crate::serving::{Predictor, ServingError};

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
    /// The listener failed.
    #[error("could not listen for connections")]
    Listen(#[source] std::io::Error),
}

/// What [`finish`] may take past the deadline to say what did not end.
const GRACE: Duration = Duration::from_millis(200);

/// What the handlers share; clones are the same.
#[derive(Clone)]
pub struct App {
    shared: Arc<Shared>,
}

struct Shared {
    config: ServerConfig,
    predictor: Predictor,
    jobs: Jobs,
    streams: Streams,
    sessions: Table,
    request_ids: RequestIds,
    contract: String,
}

impl App {
    /// Starts the threads that predict with these models and that run jobs. Errors: `Config`, `Serving`, `Jobs`.
    pub fn start(config: ServerConfig, models: Vec<LoadedModel>) -> Result<Self, ServerError> {
        config.validate()?;
        let predictor = Predictor::start(models, config.predictor())?;
        let pipeline = Pipeline {
            data_dir: config.data_dir.clone(),
            predictor: predictor.clone(),
        };
        let jobs = Jobs::start(config.jobs(), Box::new(pipeline))?;
        Ok(Self::with_parts(config, predictor, jobs))
    }

    /// From parts that have been started, for example a job runner with other work. The configuration is not checked.
    #[must_use]
    pub fn with_parts(config: ServerConfig, predictor: Predictor, jobs: Jobs) -> Self {
        let streams = Streams::new(config.max_streams);
        let sessions = Table::new(config.max_sessions, Duration::from_millis(config.session_grace_ms));
        Self {
            shared: Arc::new(Shared {
                config,
                predictor,
                jobs,
                streams,
                sessions,
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

    /// The settings.
    #[must_use]
    pub fn config(&self) -> &ServerConfig {
        &self.shared.config
    }

    fn streams(&self) -> &Streams {
        &self.shared.streams
    }

    fn sessions(&self) -> &Table {
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
        .route("/livez", get(health::livez))
        .route("/readyz", get(health::readyz))
        .route("/openapi.json", get(openapi::openapi_json))
        .route("/v1/models", get(models::list))
        .route("/v1/models/{model}", get(models::get))
        .route("/v1/models/{model}/predict", post(predict::predict))
        .route("/v1/models/{model}/preview.png", get(preview::preview))
        .route("/v1/models/{model}/rollouts", post(rollouts::of_model))
        .route("/v1/models/{model}/stream", get(stream::of_model))
        .route("/v1/sessions", post(sessions::create).get(sessions::list))
        .route("/v1/sessions/{id}", get(sessions::get).delete(sessions::delete))
        .route("/v1/sessions/{id}/state", get(sessions::state))
        .route("/v1/sessions/{id}/rollouts", post(rollouts::of_session))
        .route("/v1/sessions/{id}/stream", get(stream::of_session))
        .route("/v1/jobs", post(jobs::create).get(jobs::list))
        .route("/v1/jobs/{id}", get(jobs::get))
        .route("/v1/jobs/{id}/cancel", post(jobs::cancel))
        .method_not_allowed_fallback(async || ApiError::MethodNotAllowed)
        .fallback(async || ApiError::NotFound("there is nothing at this path; see /openapi.json".to_owned()))
        .layer(DefaultBodyLimit::max(app.config().max_body_bytes))
        .layer(axum::middleware::from_fn_with_state(app.clone(), middleware::trace))
        .with_state(app)
}

/// Answers on the listener until `shutdown` completes; then takes no more connections, answers the requests it has,
/// closes every stream with 1001, cancels the jobs, and returns when all have ended or the deadline has passed.
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
    let ended = blocking(move || {
        let ended = app.jobs().finish_stop(deadline);
        app.predictor().stop();
        ended
    });
    if ended.await == Ok(true) {
        info!("stopped");
    }
}

/// Runs what would hold up the other requests on a thread for such work. Errors: `Internal` if it panicked.
async fn blocking<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> Result<T, ApiError> {
    let span = tracing::Span::current();
    tokio::task::spawn_blocking(move || span.in_scope(work))
        .await
        .map_err(|error| ApiError::Internal(error.to_string()))
}
