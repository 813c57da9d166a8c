//! The operating system's signals to stop.

use tracing::warn;

/// Listens for Ctrl-C and, on Unix, SIGTERM from this call on; the future completes on the first of them. If the program
/// cannot listen for signals, it never completes. To be called within a tokio runtime.
#[cfg(unix)]
pub fn requested() -> impl Future<Output = ()> {
    use tokio::signal::unix::{SignalKind, signal};
    // Signals are caught from here on, and not only when the future is first polled.
    let listen = |kind: SignalKind, name: &'static str| match signal(kind) {
        Ok(signal) => Some(signal),
        Err(error) => {
            warn!(%error, signal = name, "could not listen for a signal");
            None
        }
    };
    let (interrupt, terminate) = (
        listen(SignalKind::interrupt(), "SIGINT"),
        listen(SignalKind::terminate(), "SIGTERM"),
    );
    async move {
        tokio::select! {
            () = received(interrupt) => {}
            () = received(terminate) => {}
        }
    }
}

/// Completes when the signal arrives; never without a listener.
#[cfg(unix)]
async fn received(signal: Option<tokio::signal::unix::Signal>) {
    match signal {
        Some(mut signal) => drop(signal.recv().await),
        None => std::future::pending().await,
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
