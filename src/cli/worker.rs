//! `foreframe worker`

use std::time::{Duration, Instant};

use tracing::{info, warn};

use super::settings::{StoreSettings, checked};
use super::{CliError, say};
use crate::jobs::pipeline::Pipeline;
use crate::jobs::{Jobs, child};
use crate::server::{self, ServerConfig};
use crate::store::Store;
use crate::telemetry;
use crate::versions::Versions;

/// Work on jobs without serving.
///
/// Takes up the jobs that servers of the same store took: same --data-dir, or same --database-url and --objects-url. On Ctrl-C or
/// SIGTERM the running job writes its checkpoint and goes back among those that wait.
#[derive(clap::Args)]
#[command(after_help = "Example, beside `foreframe serve --no-jobs` in the same directory:
  foreframe worker")]
pub(super) struct WorkerArgs {
    #[command(flatten)]
    store: StoreSettings,
}

pub(super) fn run(args: &WorkerArgs) -> Result<(), CliError> {
    let config = checked(args.store.load()?)?;
    let _telemetry = telemetry::init(config.log_format, config.otlp_endpoint.as_deref())?;
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build()
        .map_err(CliError::failed)?;
    let server = ServerConfig {
        job_program: Some(std::env::current_exe().map_err(CliError::failed)?),
        ..config.server
    };
    runtime.block_on(work(&server))
}

async fn work(config: &ServerConfig) -> Result<(), CliError> {
    let store = Store::open(&config.store()).await?;
    let versions = Versions::new(store.clone(), &config.models_dir);
    let pipeline = Pipeline::new(store.clone(), versions, config.job_threads).with_memory_limit(config.job_memory_mb);
    let executor = child::executor(pipeline, config.job_process());
    let jobs = Jobs::start(store.clone(), config.jobs(), executor, true).map_err(CliError::failed)?;
    say("Foreframe works on jobs — Ctrl-C stops it")?;
    server::shutdown::requested().await;
    info!("stopping");
    jobs.begin_stop();
    let deadline = Instant::now() + Duration::from_millis(config.shutdown_deadline_ms);
    if jobs.finish_stop(deadline).await {
        info!("stopped");
    }
    if let Err(error) = store.close().await {
        warn!(%error, "could not close the store");
    }
    Ok(())
}
