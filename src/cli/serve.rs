//! `foreframe serve`

use tokio::net::TcpListener;
use tracing::{info, warn};

use super::admin_address::{self, ADMIN_BIND};
use super::error::CliError;
use super::new_key::create_first_key;
use super::process::print_line;
use super::settings::{ServerArgs, open_store_waiting, with_checked_directories};
use crate::config::Config;
use crate::server::keys::Keys;
use crate::server::{self, App, ServerListeners, ServerTls};
use crate::telemetry;
use foreframe_jobs::store::Store;

/// Serve models over HTTP and WebSocket (the default command).
///
/// Loads the active version of every model in the models directory and the data directory, prints its address, and serves until
/// Ctrl-C or SIGTERM. `foreframe config` lists all settings.
#[derive(clap::Args, Default)]
#[command(after_help = "Examples:
  foreframe serve
  foreframe serve --port 9000
  foreframe serve --bind localhost:8642 --data-dir /var/lib/foreframe --set drain_ms=5000

Then open http://127.0.0.1:8642/ in a browser, or ask on the command line:
  curl http://127.0.0.1:8642/v1/models")]
pub(super) struct ServeArgs {
    #[command(flatten)]
    settings: ServerArgs,
}

pub(super) fn run(args: &ServeArgs) -> Result<(), CliError> {
    let loaded = args.settings.load()?;
    let has_default_admin = loaded.is_default(ADMIN_BIND);
    let mut config = with_checked_directories(loaded)?;
    config.server.job_program = Some(std::env::current_exe().map_err(CliError::failed)?);
    let _telemetry = telemetry::init(config.log_format, config.otlp_endpoint.as_deref())?;
    telemetry::install_recorder();
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        // For files; the threads of `App` decode images. Every such thread uses memory.
        .max_blocking_threads(config.server.request_threads)
        .build()
        .map_err(CliError::failed)?;
    let result = runtime.block_on(listen(config, has_default_admin));
    // Tasks that did not end by the deadline are dropped.
    runtime.shutdown_background();
    result
}

async fn listen(config: Config, has_default_admin: bool) -> Result<(), CliError> {
    // From the beginning: as the first process of a container, the program would otherwise get no signal before it has started.
    let mut shutdown = Box::pin(server::shutdown::requested());
    let (listeners, app) = tokio::select! {
        started = start(config, has_default_admin) => started?,
        () = &mut shutdown => return Ok(()),
    };
    let store = app.store().clone();
    server::serve(listeners, app, shutdown).await;
    // From now on the database file alone is complete.
    if let Err(error) = store.close().await {
        warn!(%error, "could not close the store");
    }
    Ok(())
}

/// What is served, and where; prints the address.
async fn start(config: Config, has_default_admin: bool) -> Result<(ServerListeners, App), CliError> {
    let tls = ServerTls::open(&config.server).map_err(|error| CliError::Usage(error.to_string()))?;
    let scheme = if tls.is_some() { "https" } else { "http" };
    let store = open_store_waiting(&config).await?;
    let keys = keys(&config, store.clone()).await?;
    let listener = TcpListener::bind(config.bind).await.map_err(|error| {
        CliError::Failed(format!(
            "could not listen on {}: {error}; choose another address or port with --bind or --port",
            config.bind
        ))
    })?;
    let address = listener.local_addr().map_err(CliError::failed)?;
    let admin = admin_address::listen(&config, has_default_admin).await?;
    let app = Box::pin(App::with_store(config.server, store))
        .await
        .map_err(|error| CliError::failed(&*error))?
        .with_keys(keys)
        .with_tls(tls);
    report_models(&app);
    print_line(format!(
        "Foreframe listens on {scheme}://{address}/ — press Ctrl-C to stop"
    ))?;
    let listeners = ServerListeners {
        public: listener,
        admin,
    };
    Ok((listeners, app))
}

/// Logs the models that are served, or what to do if there are none.
fn report_models(app: &App) {
    let models = app.predictor().models();
    for manifest in &models {
        info!(model.id = %manifest.name, model.version = manifest.version, "model loaded");
    }
    if let Some(advice) = app.no_model_advice() {
        warn!("{advice}");
    }
}

/// Creates a key and prints it; to standard output only, not to the log. Another server that starts now may have done it.
async fn print_first_key(store: &Store) -> Result<(), CliError> {
    let Some(key) = create_first_key(store).await? else {
        info!("another server made the first API key, and printed it");
        return Ok(());
    };
    print_line(format!(
        "API key, printed this once: {key} — create others with foreframe keys create NAME, and then revoke this one"
    ))
}

/// The API keys. Errors: `Usage` if other machines can reach the server and there is no key.
async fn keys(config: &Config, store: Store) -> Result<Keys, CliError> {
    let is_required = config.is_exposed() && !config.insecure;
    let mut keys = Keys::open(store.clone(), is_required).await?;
    if is_required && keys.count() == 0 {
        let had_keys = store.keys_were_created() || !store.list_keys().await?.is_empty();
        if had_keys && config.first_key {
            return Err(CliError::Usage(
                "no API key is valid: keys were created here before, and first_key makes one only where there was none; create one with \
                 foreframe keys create NAME and this data directory or database"
                    .to_owned(),
            ));
        }
        if !config.first_key || had_keys {
            return Err(CliError::Usage(format!(
                "other machines can reach {}, but no valid API key exists; create one with foreframe keys create NAME, start with \
                 --set first_key=true to get a first one, bind a loopback address, or use --insecure",
                config.bind
            )));
        }
        print_first_key(&store).await?;
        keys = Keys::open(store, is_required).await?;
    }
    match keys.count() {
        0 if keys.are_required() => {
            warn!("no valid API key exists: every request is refused until foreframe keys create makes one");
        }
        0 => info!("authentication is off: no API keys exist"),
        count => info!(keys = count, "authentication is on"),
    }
    Ok(keys)
}
