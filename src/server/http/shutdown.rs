//! The operating system's signals to stop.

use tracing::warn;

/// Listens for Ctrl-C and, on Unix, SIGTERM from this call on; the future completes on the first of them. If the program
/// cannot listen for signals, it never completes. To be called within a tokio runtime.
#[cfg(unix)]
pub fn requested() -> impl Future<Output = ()> {
    use futures_util::future::select_all;
    use tokio::signal::unix::{SignalKind, signal};
    let kinds = [SignalKind::interrupt(), SignalKind::terminate()];
    // Signals are caught from here on, and not only when the future is first polled.
    let listeners = kinds.map(|kind| {
        let listener = signal(kind);
        listener.inspect_err(|error| warn!(%error, signal = ?kind, "could not listen for a signal"))
    });
    async move {
        let received = listeners.map(|listener| {
            Box::pin(async {
                match listener {
                    Ok(mut listener) => drop(listener.recv().await),
                    Err(_) => std::future::pending().await,
                }
            })
        });
        select_all(received).await;
    }
}

/// Completes on Ctrl-C. If the program cannot listen for it, it never completes.
#[cfg(not(unix))]
pub async fn requested() {
    if let Err(error) = tokio::signal::ctrl_c().await {
        warn!(%error, "could not listen for Ctrl-C");
        std::future::pending::<()>().await;
    }
}
