//! `foreframe serve`

use std::net::SocketAddr;
use std::path::PathBuf;

use tokio::net::TcpListener;
use tracing::info;

use super::{CliError, say};
use crate::server::{self, App, ServerConfig};

const DEFAULT_ADDRESS: &str = "127.0.0.1:8642";

/// Serve models over HTTP and WebSocket.
///
/// Loads the models in --models and those that training jobs published, prints its address, and answers until Ctrl-C or
/// SIGTERM.
#[derive(clap::Args)]
#[command(after_help = "Then look at http://127.0.0.1:8642/ or ask it:
  curl http://127.0.0.1:8642/v1/models")]
pub(super) struct Args {
    /// Where to listen
    #[arg(long, value_name = "ADDRESS:PORT", default_value = DEFAULT_ADDRESS)]
    bind: SocketAddr,
    #[command(flatten)]
    state: StateArgs,
    /// Only take jobs, and leave them to `foreframe worker`
    #[arg(long)]
    no_jobs: bool,
    /// Listen on other than a loopback address although nobody is asked who they are
    #[arg(long)]
    insecure: bool,
}

/// Where state is kept.
#[derive(clap::Args)]
pub(super) struct StateArgs {
    /// The directory of the models to serve
    #[arg(long, value_name = "DIR", default_value = "models")]
    models: PathBuf,
    /// Where jobs keep data sets, runs and the models they train
    #[arg(long, value_name = "DIR", default_value = "data")]
    data_dir: PathBuf,
    #[arg(
        long,
        value_name = "URL",
        help = "sqlite:FILE or postgres://USER@HOST/NAME [default: foreframe.db in --data-dir]"
    )]
    database: Option<String>,
    #[arg(
        long,
        value_name = "URL",
        help = "A directory or s3://BUCKET/PREFIX for the files that several machines share [default: --data-dir]"
    )]
    objects: Option<String>,
    /// How long a process that works on a job may be silent before others take it up, in milliseconds
    #[arg(long, value_name = "MS", default_value_t = ServerConfig::default().job_lease_ms)]
    job_lease_ms: u64,
}

impl StateArgs {
    /// The defaults with what was said.
    pub(super) fn config(&self) -> ServerConfig {
        ServerConfig {
            data_dir: self.data_dir.clone(),
            models_dir: self.models.clone(),
            database: self.database.clone(),
            objects: self.objects.clone(),
            job_lease_ms: self.job_lease_ms,
            ..ServerConfig::default()
        }
    }
}

impl Default for Args {
    fn default() -> Self {
        Self {
            bind: SocketAddr::from(([127, 0, 0, 1], 8642)),
            state: StateArgs {
                models: PathBuf::from("models"),
                data_dir: PathBuf::from("data"),
                database: None,
                objects: None,
                job_lease_ms: ServerConfig::default().job_lease_ms,
            },
            no_jobs: false,
            insecure: false,
        }
    }
}

pub(super) fn run(args: &Args) -> Result<(), CliError> {
    if !args.bind.ip().is_loopback() && !args.insecure {
        return Err(CliError::Usage(format!(
            "{} can be reached from other machines and this server asks nobody who they are; bind a loopback address, or \
             say --insecure",
            args.bind
        )));
    }
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build()
        .map_err(CliError::failed)?;
    runtime.block_on(listen(args))
}

async fn listen(args: &Args) -> Result<(), CliError> {
    let listener = TcpListener::bind(args.bind).await.map_err(|error| {
        CliError::Failed(format!(
            "could not listen on {}: {error}; try another --bind",
            args.bind
        ))
    })?;
    let address = listener.local_addr().map_err(CliError::failed)?;
    let config = ServerConfig {
        run_jobs: !args.no_jobs,
        ..args.state.config()
    };
    let app = App::open(config).await.map_err(CliError::failed)?;
    for manifest in app.predictor().models() {
        info!(model = manifest.name, version = manifest.version, "model loaded");
    }
    if app.predictor().models().is_empty() {
        info!(directory = %args.state.models.display(), "no models there; train one by POST /v1/jobs or foreframe train");
    }
    say(format!("Foreframe listens on http://{address}/ — Ctrl-C stops it"))?;
    server::serve(listener, app, server::shutdown::requested())
        .await
        .map_err(CliError::failed)
}
