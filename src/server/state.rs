//! [`App`]: what the handlers share, and how it starts.

use std::collections::BTreeSet;
use std::convert::Infallible;
use std::error::Error;
use std::ops::Deref;
use std::sync::atomic::{AtomicBool, AtomicU64};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use axum::Extension;
use axum::extract::rejection::ExtensionRejection;
use axum::extract::{FromRef, FromRequestParts};
use axum::http::request::Parts;
use tracing::warn;

use super::blocking::BlockingWork;
use super::config::ServerConfig;
use super::environments::Environments;
use super::http::admission::Admission;
use super::http::body_budget::BodyBudget;
use super::http::keys::{Caller, Keys};
use super::http::task_limit::{TaskLimit, stop_requested};
use super::http::tls::ServerTls;
use super::inference_statistics::InferenceStatistics;
use super::render_cache::RenderCache;
use super::shared_reading::SharedReading;
use super::stream::session_table::SessionTable;
use super::uploads::Uploads;
use super::world_session::SharedWorldSession;
use foreframe_core::registry::Model;
use foreframe_core::serving::Predictor;
use foreframe_jobs::jobs::pipeline::Pipeline;
use foreframe_jobs::jobs::{JobError, Jobs, child};
use foreframe_jobs::store::{Author, Store};
use foreframe_jobs::versions::Versions;
use foreframe_sim::Environment;

/// How often the server checks which versions other servers of the same store activated.
const FOLLOW_EVERY: Duration = Duration::from_secs(1);

/// Why the server could not start; nobody tells the reasons apart.
type StartError = Box<dyn Error + Send + Sync>;

/// What the handlers share; clones share it too.
#[derive(Clone)]
pub struct App {
    shared: Arc<AppState>,
    pub(super) keys: Keys,
    pub(super) tls: Option<ServerTls>,
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

/// What all clones of an [`App`] share.
pub struct AppState {
    parts: AppParts,
    pub(super) config: Arc<ServerConfig>,
    pub(super) streams: TaskLimit,
    pub(super) event_streams: TaskLimit,
    /// Hashes of the lists whose changes their clients hear of.
    pub(super) compared_lists: SharedReading<[u64; 2]>,
    /// The requests that are being processed.
    pub(super) requests: TaskLimit,
    pub(super) admission: Admission,
    pub(super) body_budget: BodyBudget,
    /// The threads for images of predictions.
    pub(super) predictions: BlockingWork,
    pub(super) render_cache: RenderCache,
    /// The threads for simulations and for what is neither a prediction nor a picture.
    pub(super) blocking: BlockingWork,
    pub(super) environments: Environments<Mutex<Environment>>,
    pub(super) world_sessions: Environments<SharedWorldSession>,
    pub(super) uploads: Uploads,
    /// Whether the server is stopping: it still answers, but reports that it is not ready.
    pub(super) draining: Arc<AtomicBool>,
    /// How many data sets were deleted here, which no job tells.
    pub(super) deleted_datasets: AtomicU64,
    pub(super) sessions: SessionTable,
    pub(super) inference_statistics: InferenceStatistics,
}

impl Deref for App {
    type Target = AppState;

    fn deref(&self) -> &AppState {
        &self.shared
    }
}

impl App {
    /// Opens the store, loads the models to serve, and starts. To be called within a tokio runtime.
    pub async fn open(config: ServerConfig) -> Result<Self, StartError> {
        let store = Store::open(&config.store()).await?;
        Self::with_store(config, store).await
    }

    /// The same with a store that is open already.
    pub async fn with_store(config: ServerConfig, store: Store) -> Result<Self, StartError> {
        config.validate()?;
        let versions = Versions::new(store.clone(), &config.models_dir);
        let models = versions.load_serving().await?;
        Self::start(config, models, store)
    }

    /// Starts the threads that predict with these models and that run jobs. To be called within a tokio runtime.
    pub fn start(config: ServerConfig, models: Vec<Model>, store: Store) -> Result<Self, StartError> {
        config.validate()?;
        let versions = Versions::new(store.clone(), &config.models_dir);
        let predictor = Predictor::start(models, config.predictor())?;
        let parts = AppParts {
            predictor,
            jobs: start_jobs(&config, &store, &versions, config.run_jobs)?,
            store,
            versions,
        };
        let app = Self::with_parts(config, parts);
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
                compared_lists: SharedReading::default(),
                requests: TaskLimit::new("requests are being processed", config.max_requests),
                admission: Admission::new(&config),
                body_budget: BodyBudget::new(&config),
                predictions: BlockingWork::new("predictions", config.request_threads, false),
                render_cache: RenderCache::new(&config),
                blocking: BlockingWork::new("requests", config.request_threads, false),
                environments: Environments::new("environment", &config),
                uploads: Uploads::new(&config),
                world_sessions: Environments::new("session", &config),
                draining: Arc::default(),
                deleted_datasets: AtomicU64::default(),
                sessions: SessionTable::new(config.max_sessions, Duration::from_millis(config.session_grace_ms)),
                inference_statistics: InferenceStatistics::default(),
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

    /// The same app with these API keys. Without this call, authentication is off.
    #[must_use]
    pub fn with_keys(self, keys: Keys) -> Self {
        Self { keys, ..self }
    }

    /// The predictor.
    #[must_use]
    pub fn predictor(&self) -> &Predictor {
        &self.parts.predictor
    }

    /// The jobs.
    #[must_use]
    pub fn jobs(&self) -> &Jobs {
        &self.parts.jobs
    }

    /// Where metadata and files are kept.
    #[must_use]
    pub fn store(&self) -> &Store {
        &self.parts.store
    }

    /// The versions of the models.
    #[must_use]
    pub fn versions(&self) -> &Versions {
        &self.parts.versions
    }

    /// The settings.
    #[must_use]
    pub fn config(&self) -> &ServerConfig {
        &self.config
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

impl FromRequestParts<App> for App {
    type Rejection = Infallible;

    async fn from_request_parts(_: &mut Parts, app: &App) -> Result<Self, Infallible> {
        Ok(app.clone())
    }
}

impl FromRequestParts<App> for Caller {
    type Rejection = ExtensionRejection;

    async fn from_request_parts(parts: &mut Parts, app: &App) -> Result<Self, ExtensionRejection> {
        let Extension(caller) = Extension::from_request_parts(parts, app).await?;
        Ok(caller)
    }
}

impl FromRequestParts<App> for Author {
    type Rejection = ExtensionRejection;

    async fn from_request_parts(parts: &mut Parts, app: &App) -> Result<Self, ExtensionRejection> {
        let Extension(author) = Extension::from_request_parts(parts, app).await?;
        Ok(author)
    }
}

impl FromRef<App> for Admission {
    fn from_ref(app: &App) -> Self {
        app.admission.clone()
    }
}

impl FromRef<App> for Arc<ServerConfig> {
    fn from_ref(app: &App) -> Self {
        Arc::clone(&app.config)
    }
}

/// Starts the runner of jobs. `runs_jobs`: it also works on them, instead of only accepting them. To be called within a tokio
/// runtime.
pub fn start_jobs(
    config: &ServerConfig,
    store: &Store,
    versions: &Versions,
    runs_jobs: bool,
) -> Result<Jobs, JobError> {
    let pipeline = Pipeline::new(store.clone(), versions.clone(), config.job_resources());
    let executor = child::executor(pipeline, config.job_process());
    Jobs::start(store.clone(), config.jobs(), executor, runs_jobs)
}

/// Loads the versions that were activated on other servers, or that a job published as the first of their name, and deletes uploads
/// whose import has ended, until the server stops.
async fn follow(app: App) {
    let (mut stopping, mut refused) = (app.streams.stopping(), BTreeSet::new());
    loop {
        tokio::select! {
            () = app.jobs().job_ended() => {}
            () = tokio::time::sleep(FOLLOW_EVERY) => {}
            () = stop_requested(&mut stopping) => return,
        }
        if let Err(error) = app.versions().load_activated(app.predictor(), &mut refused).await {
            warn!(%error, "could not check for newly activated versions");
        }
        if let Err(error) = app.uploads.sweep(app.jobs(), app.store().objects()).await {
            warn!(%error, "could not delete uploads that are no longer needed");
        }
    }
}
