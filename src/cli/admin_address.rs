//! The address of a server or worker for health checks and metrics.

use std::net::SocketAddr;

use tokio::net::TcpListener;
use tracing::{info, warn};

use super::error::CliError;
use crate::config::LoadedConfig;

/// Where to answer health checks and metrics.
pub(super) struct AdminAddress {
    /// `None`: nowhere.
    address: Option<SocketAddr>,
    /// Whether nobody set it.
    pub(super) is_default: bool,
}

impl AdminAddress {
    pub(super) fn of(loaded: &LoadedConfig) -> Self {
        Self {
            address: loaded.config.admin_bind,
            is_default: loaded.is_default("admin_bind"),
        }
    }

    /// The listener. If the default address is in use, probably by another server of this machine, there is none.
    /// Errors: `Failed` for an address that was set.
    pub(super) async fn listen(&self) -> Result<Option<TcpListener>, CliError> {
        let Some(address) = self.address else { return Ok(None) };
        match TcpListener::bind(address).await {
            Ok(listener) => {
                let address = listener.local_addr().map_err(CliError::failed)?;
                info!("health checks and metrics are also at http://{address}/");
                Ok(Some(listener))
            }
            Err(error) if self.is_default => {
                warn!(%error, "could not listen on {address} for health checks; set admin_bind to another address or to off");
                Ok(None)
            }
            Err(error) => Err(CliError::Failed(format!(
                "could not listen on {address} for health checks: {error}; set admin_bind to another address or to off"
            ))),
        }
    }
}
