//! The address of a server or worker for health checks and metrics.

use tokio::net::TcpListener;
use tracing::{info, warn};

use super::error::CliError;
use crate::config::Config;

/// The setting of that address.
pub(super) const ADMIN_BIND: &str = "admin_bind";

/// The listener for health checks and metrics, if there is an address for them. `is_default`: nobody set it; then there is no
/// listener if it is in use, probably by another server of this machine. Errors: `Failed` for an address that was set.
pub(super) async fn listen(config: &Config, is_default: bool) -> Result<Option<TcpListener>, CliError> {
    let Some(address) = config.admin_bind else {
        return Ok(None);
    };
    match TcpListener::bind(address).await {
        Ok(listener) => {
            let address = listener.local_addr().map_err(CliError::failed)?;
            info!("health checks and metrics are also at http://{address}/");
            Ok(Some(listener))
        }
        Err(error) if is_default => {
            warn!(%error, "could not listen on {address} for health checks; set admin_bind to another address or to off");
            Ok(None)
        }
        Err(error) => Err(CliError::Failed(format!(
            "could not listen on {address} for health checks: {error}; set admin_bind to another address or to off"
        ))),
    }
}
