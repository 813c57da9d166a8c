//! [`App`]: what the handlers share, and how it starts.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use axum::extract::FromRef;
use tracing::warn;

use super::blocking::BlockingWork;
use super::config::{ServerConfig, SettingError};
use super::environments::Environments;
use super::http::admission::Admission;
use super::http::body_budget::BodyBudget;
use super::http::keys::{Caller, Keys};
use super::http::message_bytes::MessageBytes;
use super::http::task_limit::{TaskLimit, stop_requested};
use super::http::tls::ServerTls;
use super::render_cache::RenderCache;
use super::stream::connection::StreamServices;
use super::stream::session_table::SessionTable;
use foreframe_core::registry::Model;
use foreframe_core::serving::{Predictor, ServingError};
use foreframe_jobs::jobs::child;
use foreframe_jobs::jobs::pipeline::Pipeline;
use foreframe_jobs::jobs::{JobError, Jobs};
use foreframe_jobs::store::{Store, StoreError};
use foreframe_jobs::versions::{VersionError, Versions};

/// How often the server checks which versions other servers of the same store activated.
const FOLLOW_EVERY: Duration = Duration::from_secs(1);

/// Why the server could not start.
#[derive(Debug, thiserror::Error)]
pub enum ServerError {
    /// A setting is out of range.
    #[error(transparent)]
    Config(#[from] SettingError),
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

/// What the handlers share; clones share it too.
#[derive(Clone)]
pub struct App {
    shared: Arc<AppState>,
    keys: Keys,
    tls: Option<ServerTls>,
}

/// The parts of an [`App`] that have threads or a database.
pub struct AppParts {
    /// Computes the predictions.
    pub predictor: Predictor,
    /// Runs and lists the jobs.
    pub jobs: Jobs,
    /// Where metadata and files are kept.
    pub store: Store,
    /// The versions of the models.
    pub versions: Versions,
}

struct AppState {
    config: Arc<ServerConfig>,
    parts: AppParts,
    streams: TaskLimit,
    event_streams: TaskLimit,
    requests: TaskLimit,
    admission: Admission,
    body_budget: BodyBudget,
    predictions: BlockingWork,
    render_cache: RenderCache,
    blocking: BlockingWork,
    environments: Environments,
    draining: Arc<AtomicBool>,
    sessions: SessionTable,
}

impl App {
    /// Opens the store, loads the models to serve, and starts. To be called within a tokio runtime.
    /// Errors: `Config`, `Store`, `Versions`, `Serving`, `Jobs`.
    pub async fn open(config: ServerConfig) -> Result<Self, ServerError> {
        config.validate()?;
        let store = Store::open(&config.store()).await?;
        Self::with_store(config, store).await
    }

    /// The same with a store that is open already. Errors: `Config`, `Versions`, `Serving`, `Jobs`.
    pub async fn with_store(config: ServerConfig, store: Store) -> Result<Self, ServerError> {
        config.validate()?;
        let versions = Versions::new(store.clone(), &config.models_dir);
        let models = versions.load_serving().await?;
        Self::start_with(config, models, store, versions)
    }

    /// Starts the threads that predict with these models and that run jobs. To be called within a tokio runtime.
    /// Errors: `Config`, `Serving`, `Jobs`.
    pub fn start(config: ServerConfig, models: Vec<Model>, store: Store) -> Result<Self, ServerError> {
        let versions = Versions::new(store.clone(), &config.models_dir);
        Self::start_with(config, models, store, versions)
    }

    fn start_with(
        config: ServerConfig,
        models: Vec<Model>,
        store: Store,
        versions: Versions,
    ) -> Result<Self, ServerError> {
        config.validate()?;
        let predictor = Predictor::start(models, config.predictor())?;
        let pipeline = Pipeline::new(store.clone(), versions.clone(), config.job_resources());
        let executor = child::executor(pipeline, config.job_process());
        let jobs = Jobs::start(store.clone(), config.jobs(), executor, config.run_jobs)?;
        let app = Self::with_parts(
            config,
            AppParts {
                predictor,
                jobs,
                store,
                versions,
            },
        );
        tokio::spawn(follow(app.clone()));
        Ok(app)
    }

    /// From parts that have been started, for example a job runner with other work. The configuration is not checked.
    #[must_use]
    pub fn with_parts(config: ServerConfig, parts: AppParts) -> Self {
        Self {
            shared: Arc::new(AppState {
                streams: TaskLimit::new("streams are open", config.max_streams),
                event_streams: TaskLimit::new("event streams are open", config.max_event_streams),
                requests: TaskLimit::new("requests are being processed", config.max_requests),
                admission: Admission::new(&config),
                body_budget: BodyBudget::new(&config),
                predictions: BlockingWork::new("predictions", config.request_threads, false),
                render_cache: RenderCache::new(&config),
                blocking: BlockingWork::new("requests", config.request_threads, false),
                environments: Environments::new(&config),
                draining: Arc::default(),
                sessions: SessionTable::new(config.max_sessions, Duration::from_millis(config.session_grace_ms)),
                config: Arc::new(config),
                parts,
            }),
            keys: Keys::none(),
            tls: None,
        }
    }

    /// The same app with TLS on its public address. Without this call, it speaks plain HTTP.
    #[must_use]
    pub fn with_tls(self, tls: Option<ServerTls>) -> Self {
        Self { tls, ..self }
    }

    pub(super) fn tls(&self) -> Option<&ServerTls> {
        self.tls.as_ref()
    }

    /// The same app with these API keys. Without this call, authentication is off.
    #[must_use]
    pub fn with_keys(self, keys: Keys) -> Self {
        Self { keys, ..self }
    }

    /// The predictor.
    #[must_use]
    pub fn predictor(&self) -> &Predictor {
        &self.shared.parts.predictor
    }

    /// The jobs.
    #[must_use]
    pub fn jobs(&self) -> &Jobs {
        &self.shared.parts.jobs
    }

    /// Where metadata and files are kept.
    #[must_use]
    pub fn store(&self) -> &Store {
        &self.shared.parts.store
    }

    /// The versions of the models.
    #[must_use]
    pub fn versions(&self) -> &Versions {
        &self.shared.parts.versions
    }

    /// The settings.
    #[must_use]
    pub fn config(&self) -> &ServerConfig {
        &self.shared.config
    }

    pub(super) fn shared_config(&self) -> Arc<ServerConfig> {
        Arc::clone(&self.shared.config)
    }

    pub(super) fn body_budget(&self) -> &BodyBudget {
        &self.shared.body_budget
    }

    pub(super) fn keys(&self) -> &Keys {
        &self.keys
    }

    pub(super) fn streams(&self) -> &TaskLimit {
        &self.shared.streams
    }

    pub(super) fn event_streams(&self) -> &TaskLimit {
        &self.shared.event_streams
    }

    /// The requests that are being processed.
    pub(super) fn requests(&self) -> &TaskLimit {
        &self.shared.requests
    }

    pub(super) fn admission(&self) -> &Admission {
        &self.shared.admission
    }

    /// The threads for images of predictions.
    pub(super) fn predictions(&self) -> &BlockingWork {
        &self.shared.predictions
    }

    pub(super) fn render_cache(&self) -> &RenderCache {
        &self.shared.render_cache
    }

    /// The threads for simulations and for what is neither a prediction nor a picture.
    pub(super) fn blocking(&self) -> &BlockingWork {
        &self.shared.blocking
    }

    pub(super) fn environments(&self) -> &Environments {
        &self.shared.environments
    }

    pub(super) fn sessions(&self) -> &SessionTable {
        &self.shared.sessions
    }

    /// Whether the server is stopping: it still answers, but reports that it is not ready.
    pub(super) fn is_draining(&self) -> bool {
        self.shared.draining.load(Ordering::Acquire)
    }

    pub(super) fn drain(&self) {
        self.shared.draining.store(true, Ordering::Release);
    }

    /// Becomes true when the server stops.
    pub(super) fn draining(&self) -> Arc<AtomicBool> {
        Arc::clone(&self.shared.draining)
    }

    /// What a stream of that caller needs of this app.
    pub(super) fn stream_services(&self, caller: Caller, messages: MessageBytes) -> StreamServices {
        StreamServices {
            config: self.shared_config(),
            predictor: self.predictor().clone(),
            blocking: self.predictions().clone(),
            streams: self.streams().clone(),
            keys: self.keys().clone(),
            caller,
            messages,
        }
    }

    /// What to do if no model is loaded; `None` if there is one.
    #[must_use]
    pub fn no_model_advice(&self) -> Option<String> {
        let is_empty = self.predictor().models().is_empty();
        is_empty.then(|| {
            format!(
                "no model found in {}; name the right directory with --models-dir, publish a trained model with `foreframe publish \
                 DIR`, or train one with POST /v1/jobs",
                self.config().models_dir.display()
            )
        })
    }
}

impl FromRef<App> for Admission {
    fn from_ref(app: &App) -> Self {
        app.admission().clone()
    }
}

impl FromRef<App> for Arc<ServerConfig> {
    fn from_ref(app: &App) -> Self {
        app.shared_config()
    }
}

/// Loads the versions that were activated on other servers, or that a job published as the first of their name, until the
/// server stops.
async fn follow(app: App) {
    let (mut stopping, mut refused) = (app.streams().stopping(), BTreeSet::new());
    loop {
        tokio::select! {
            () = app.jobs().job_ended() => {}
            () = tokio::time::sleep(FOLLOW_EVERY) => {}
            () = stop_requested(&mut stopping) => return,
        }
        if let Err(error) = app.versions().load_activated(app.predictor(), &mut refused).await {
            warn!(%error, "could not check for newly activated versions");
        }
    }
}
