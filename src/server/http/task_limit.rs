//! A limit of tasks (streams, requests), the signal that they shall stop, and a way to wait for their end. An HTTP server's own
//! graceful shutdown does not wait for tasks that outlive their connection.

use std::sync::Arc;

use tokio::sync::{OwnedSemaphorePermit, Semaphore, watch};

use super::problem::ApiError;

/// The places of tasks of one kind, and their stop signal; clones share them.
#[derive(Clone)]
pub(in crate::server) struct TaskLimit {
    places: Arc<Semaphore>,
    /// What they are and do, for error messages.
    kind: &'static str,
    limit: u32,
    stop: watch::Sender<bool>,
}

impl TaskLimit {
    pub(in crate::server) fn new(kind: &'static str, limit: usize) -> Self {
        let limit = u32::try_from(limit).unwrap_or(u32::MAX);
        Self {
            places: Arc::new(Semaphore::new(limit as usize)),
            kind,
            limit,
            stop: watch::Sender::new(false),
        }
    }

    /// A place, held until the task ends. Errors: `Unavailable` if all are taken.
    pub(in crate::server) fn enter(&self) -> Result<OwnedSemaphorePermit, ApiError> {
        let (limit, kind) = (self.limit, self.kind);
        Arc::clone(&self.places)
            .try_acquire_owned()
            .map_err(|_| ApiError::unavailable(format!("{limit} {kind} already; try again later")))
    }

    /// How many are open.
    pub(in crate::server) fn count(&self) -> usize {
        (self.limit as usize).saturating_sub(self.places.available_permits())
    }

    /// Becomes true when the tasks shall stop.
    pub(in crate::server) fn stopping(&self) -> watch::Receiver<bool> {
        self.stop.subscribe()
    }

    /// Signals every task to stop.
    pub(in crate::server) fn stop(&self) {
        self.stop.send_replace(true);
    }

    /// Waits until every task has ended.
    pub(in crate::server) async fn ended(&self) {
        // All places are free only if no task runs. An error means that the places are closed for good.
        let _ = self.places.acquire_many(self.limit).await;
    }
}

/// Waits until the tasks shall stop.
pub(in crate::server) async fn stop_requested(stopping: &mut watch::Receiver<bool>) {
    // An error means that the sender is gone, and with it the server.
    let _ = stopping.wait_for(|stopping| *stopping).await;
}
