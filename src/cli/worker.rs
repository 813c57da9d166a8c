//! `foreframe worker` and `foreframe run-job`

use std::time::{Duration, Instant};

use tokio::sync::watch;
use tracing::{info, warn};

use super::admin_address::{self, ADMIN_BIND};
use super::error::CliError;
use super::process::print_line;
use super::settings::{CommonArgs, open_store_waiting, with_checked_directories};
use crate::config::Config;
use crate::server::{serve_worker_health, start_jobs};
use crate::telemetry::{self, LogFormat};
use foreframe_jobs::jobs::child;
use foreframe_jobs::versions::Versions;

/// Run jobs without serving.
///
/// Runs the jobs that servers of the same store accepted: same --data-dir, or same --database-url and --objects-url. On Ctrl-C
/// or SIGTERM the running job writes its checkpoint and returns to the queue.
#[derive(clap::Args)]
#[command(
    after_help = "Example, beside `foreframe serve --run-jobs false` in the same directory:
  foreframe worker"
)]
pub(super) struct WorkerArgs {
    #[command(flatten)]
    settings: CommonArgs,
}

pub(super) fn run(args: &WorkerArgs) -> Result<(), CliError> {
    let loaded = args.settings.load()?;
    let has_default_admin = loaded.is_default(ADMIN_BIND);
    let mut config = with_checked_directories(loaded)?;
    config.server.job_program = Some(std::env::current_exe().map_err(CliError::failed)?);
    let _telemetry = telemetry::init(config.log_format, config.otlp_endpoint.as_deref())?;
    telemetry::install_recorder();
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build()
        .map_err(CliError::failed)?;
    runtime.block_on(work(&config, has_default_admin))
}

/// `foreframe run-job`: the child process of a server or worker that runs one job.
pub(super) fn run_job() -> Result<(), CliError> {
    // The settings of the server come later, with the job.
    let format = match std::env::var(child::LOG_FORMAT) {
        Ok(format) if format == LogFormat::Json.name() => LogFormat::Json,
        _ => LogFormat::Text,
    };
    let _telemetry = telemetry::init(format, None)?;
    child::run().map_err(CliError::Failed)
}

async fn work(config: &Config, has_default_admin: bool) -> Result<(), CliError> {
    let server = &config.server;
    // From the beginning: as the first process of a container, the program would otherwise get no signal before it has started.
    let mut shutdown = Box::pin(crate::server::shutdown::requested());
    let store = tokio::select! {
        store = open_store_waiting(config) => store?,
        () = &mut shutdown => return Ok(()),
    };
    let versions = Versions::new(store.clone(), &server.models_dir);
    let jobs = start_jobs(server, &store, &versions, true).map_err(CliError::failed)?;
    let (stopping, is_stopping) = watch::channel(false);
    // Beside a server of the same machine, the default address would be taken.
    let admin = if has_default_admin {
        None
    } else {
        admin_address::listen(config, false).await?
    };
    let admin = admin.map(|admin| {
        let (server, store) = (server.clone(), store.clone());
        tokio::spawn(async move { serve_worker_health(admin, &server, store, is_stopping).await })
    });
    print_line("Foreframe runs jobs — press Ctrl-C to stop")?;
    shutdown.await;
    info!("stopping");
    stopping.send_replace(true);
    jobs.begin_stop();
    let deadline = Instant::now() + Duration::from_millis(server.shutdown_deadline_ms);
    if jobs.finish_stop(deadline).await {
        info!("stopped");
    }
    if let Some(admin) = admin {
        admin.abort();
    }
    if let Err(error) = store.close().await {
        warn!(%error, "could not close the store");
    }
    Ok(())
}
