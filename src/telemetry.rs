//! Logs: to standard error, `info` and above unless `RUST_LOG` says otherwise.

use tracing_subscriber::EnvFilter;

/// Installs the subscriber for the process. A second call changes nothing.
pub fn init() {
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new("info"));
    // Only fails if one is installed already, as in tests.
    let _ = tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_writer(std::io::stderr)
        .try_init();
}
