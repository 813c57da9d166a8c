//! Pictures and reports: made on threads of their own, so that predictions do not wait for them, and kept in a cache of
//! bounded size.

use std::collections::{BTreeMap, HashMap};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use axum::body::Bytes;
use tokio::sync::{Semaphore, SemaphorePermit};

use super::blocking::{BlockingWork, TaskError};
use super::config::ServerConfig;

/// The threads and the cache of pictures; clones share them.
#[derive(Clone)]
pub(super) struct RenderCache {
    threads: BlockingWork,
    cache: Arc<RenderedFiles>,
    turns: Arc<Semaphore>,
}

impl RenderCache {
    pub(super) fn new(config: &ServerConfig) -> Self {
        Self {
            threads: BlockingWork::with_low_priority("pictures", config.picture_threads),
            cache: Arc::new(RenderedFiles::new(config.max_cached_bytes)),
            turns: Arc::new(Semaphore::new(config.picture_threads)),
        }
    }

    pub(super) fn threads(&self) -> &BlockingWork {
        &self.threads
    }

    /// Waits until it is this request's turn, for work that is not done on the threads, such as lists of many files.
    pub(super) async fn turn(&self) -> Option<SemaphorePermit<'_>> {
        // Never closed.
        self.turns.acquire().await.ok()
    }

    pub(super) fn cached(&self, key: &str) -> Option<Bytes> {
        self.cache.get(key)
    }

    /// The bytes of that key: from the cache, or else made on a thread. Errors: those of `make`, and of the threads.
    pub(super) async fn get_or_make<E>(
        &self,
        key: String,
        make: impl FnOnce() -> Result<Vec<u8>, E> + Send + 'static,
    ) -> Result<Bytes, E>
    where
        E: From<TaskError> + Send + 'static,
    {
        if let Some(bytes) = self.cached(&key) {
            return Ok(bytes);
        }
        let cache = Arc::clone(&self.cache);
        let made = self.threads.run(move || {
            // Another request may have asked for the same while this one waited.
            if let Some(bytes) = cache.get(&key) {
                return Ok(bytes);
            }
            let bytes = Bytes::from(make()?);
            cache.insert(key, bytes.clone());
            Ok(bytes)
        });
        made.await?
    }
}

/// Results by key. If they take more than the limit, those that were not used for the longest time are dropped.
struct RenderedFiles {
    limit: usize,
    entries: Mutex<RenderedEntries>,
}

#[derive(Default)]
struct RenderedEntries {
    by_key: HashMap<String, (Bytes, u64)>,
    /// Keys in the order of their last use.
    by_use: BTreeMap<u64, String>,
    bytes: usize,
    uses: u64,
}

impl RenderedFiles {
    fn new(limit: usize) -> Self {
        Self {
            limit,
            entries: Mutex::default(),
        }
    }

    fn get(&self, key: &str) -> Option<Bytes> {
        let mut entries = self.entries();
        let bytes = entries.remove(key)?;
        entries.add(key.to_owned(), bytes.clone());
        Some(bytes)
    }

    fn insert(&self, key: String, bytes: Bytes) {
        if size(&key, &bytes) > self.limit {
            return;
        }
        let mut entries = self.entries();
        entries.remove(&key);
        entries.add(key, bytes);
        while entries.bytes > self.limit {
            let Some(oldest) = entries.by_use.values().next().cloned() else {
                return;
            };
            entries.remove(&oldest);
        }
    }

    fn entries(&self) -> MutexGuard<'_, RenderedEntries> {
        self.entries.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl RenderedEntries {
    fn add(&mut self, key: String, bytes: Bytes) {
        self.uses += 1;
        self.bytes += size(&key, &bytes);
        self.by_use.insert(self.uses, key.clone());
        self.by_key.insert(key, (bytes, self.uses));
    }

    fn remove(&mut self, key: &str) -> Option<Bytes> {
        let (bytes, used) = self.by_key.remove(key)?;
        self.by_use.remove(&used);
        self.bytes -= size(key, &bytes);
        Some(bytes)
    }
}

fn size(key: &str, bytes: &Bytes) -> usize {
    key.len() + bytes.len()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn bytes(length: usize) -> Bytes {
        Bytes::from(vec![0; length])
    }

    #[test]
    fn the_cache_drops_what_was_not_used_for_the_longest_time() {
        let cache = RenderedFiles::new(100);
        cache.insert("a".to_owned(), bytes(40));
        cache.insert("b".to_owned(), bytes(40));
        assert!(cache.get("a").is_some());
        cache.insert("c".to_owned(), bytes(40));
        assert!(cache.get("b").is_none() && cache.get("a").is_some() && cache.get("c").is_some());
        assert_eq!(cache.entries().bytes, 82);
    }

    #[test]
    fn the_cache_keeps_nothing_that_exceeds_it() {
        let cache = RenderedFiles::new(100);
        cache.insert("a".to_owned(), bytes(50));
        cache.insert("b".to_owned(), bytes(100));
        assert!(cache.get("b").is_none() && cache.get("a").is_some());
        RenderedFiles::new(0).insert("a".to_owned(), bytes(0));
    }
}
