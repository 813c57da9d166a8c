//! Ctrl-C as a flag that long work checks; a second Ctrl-C ends the process at once.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use super::error::CliError;

/// A flag that the first Ctrl-C (or SIGTERM) sets.
pub(super) fn flag() -> Result<Arc<AtomicBool>, CliError> {
    let cancelled = Arc::new(AtomicBool::new(false));
    let shared = Arc::clone(&cancelled);
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_io()
        .build()
        .map_err(CliError::failed)?;
    std::thread::Builder::new()
        .name("interrupt".to_owned())
        .spawn(move || {
            runtime.block_on(async {
                crate::server::shutdown::requested().await;
                shared.store(true, Ordering::Relaxed);
                tracing::info!("stopping; press Ctrl-C again to stop without saving");
                crate::server::shutdown::requested().await;
                std::process::exit(130);
            });
        })
        .map_err(CliError::failed)?;
    Ok(cancelled)
}
