//! How many streams there are, and a way to wait for their end: a server's graceful shutdown does not know of them.

use std::sync::Arc;

use tokio::sync::{OwnedSemaphorePermit, Semaphore, watch};

use super::error::ApiError;

/// The streams' places and their signal to stop.
#[derive(Clone)]
pub(super) struct Streams {
    places: Arc<Semaphore>,
    limit: u32,
    stop: watch::Sender<bool>,
}

impl Streams {
    pub(super) fn new(limit: usize) -> Self {
        let limit = u32::try_from(limit).unwrap_or(u32::MAX);
        Self {
            places: Arc::new(Semaphore::new(limit as usize)),
            limit,
            stop: watch::Sender::new(false),
        }
    }

    /// A place, held until the stream's task ends. Errors: `Unavailable` if all are taken.
    pub(super) fn enter(&self) -> Result<OwnedSemaphorePermit, ApiError> {
        Arc::clone(&self.places)
            .try_acquire_owned()
            .map_err(|_| ApiError::unavailable(format!("{} streams are open already; try again later", self.limit)))
    }

    /// How many are open.
    pub(super) fn count(&self) -> usize {
        (self.limit as usize).saturating_sub(self.places.available_permits())
    }

    /// Becomes true when streams shall end.
    pub(super) fn stopping(&self) -> watch::Receiver<bool> {
        self.stop.subscribe()
    }

    /// Tells every stream to end.
    pub(super) fn stop(&self) {
        self.stop.send_replace(true);
    }

    /// Waits until every stream's task has ended.
    pub(super) async fn ended(&self) {
        // All places at once can be had only when nobody holds one; an error means that none will be given any more.
        let _ = self.places.acquire_many(self.limit).await;
    }
}

/// Waits until streams shall end.
pub(super) async fn told(stopping: &mut watch::Receiver<bool>) {
    // The sender lives as long as the streams' places do.
    let _ = stopping.wait_for(|stopping| *stopping).await;
}
