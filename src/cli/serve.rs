//! `foreframe serve`

use std::net::SocketAddr;
use std::path::PathBuf;

use tokio::net::TcpListener;
use tracing::info;

use super::{CliError, say};
use crate::registry::LoadedModel;
use crate::server::{self, App, ServerConfig};
use crate::serving;

const DEFAULT_ADDRESS: &str = "127.0.0.1:8642";

/// Serve models over HTTP and WebSocket.
///
/// Loads the models in --models and those that its own training jobs published in --data-dir, prints its address, and
/// answers until Ctrl-C or SIGTERM.
#[derive(clap::Args)]
#[command(after_help = "Then look at http://127.0.0.1:8642/ or ask it:
  curl http://127.0.0.1:8642/v1/models")]
pub(super) struct Args {
    /// Where to listen
    #[arg(long, value_name = "ADDRESS:PORT", default_value = DEFAULT_ADDRESS)]
    bind: SocketAddr,
    /// The directory of the models to serve
    #[arg(long, value_name = "DIR", default_value = "models")]
    models: PathBuf,
    /// Where jobs keep data sets, runs and the models they train
    #[arg(long, value_name = "DIR", default_value = "data")]
    data_dir: PathBuf,
    /// Listen on other than a loopback address although nobody is asked who they are
    #[arg(long)]
    insecure: bool,
}

impl Default for Args {
    fn default() -> Self {
        Self {
            bind: SocketAddr::from(([127, 0, 0, 1], 8642)),
            models: PathBuf::from("models"),
            data_dir: PathBuf::from("data"),
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
    let published = args.data_dir.join("models");
    let models = serving::load_models(&[args.models.as_path(), published.as_path()])?;
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build()
        .map_err(CliError::failed)?;
    runtime.block_on(listen(args, models))
}

async fn listen(args: &Args, models: Vec<LoadedModel>) -> Result<(), CliError> {
    let listener = TcpListener::bind(args.bind).await.map_err(|error| {
        CliError::Failed(format!(
            "could not listen on {}: {error}; try another --bind",
            args.bind
        ))
    })?;
    let address = listener.local_addr().map_err(CliError::failed)?;
    for model in &models {
        info!(
            model = model.manifest.name,
            version = model.manifest.version,
            "model loaded"
        );
    }
    if models.is_empty() {
        info!(directory = %args.models.display(), "no models there; train one by POST /v1/jobs or foreframe train");
    }
    let config = ServerConfig {
        data_dir: args.data_dir.clone(),
        ..ServerConfig::default()
    };
    let app = App::start(config, models).map_err(CliError::failed)?;
    say(format!("Foreframe listens on http://{address}/ — Ctrl-C stops it"))?;
    server::serve(listener, app, server::shutdown::requested())
        .await
        .map_err(CliError::failed)
}
