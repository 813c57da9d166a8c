//! Pictures and reports: made on threads of their own, so that predictions do not wait for them, and kept in a cache of
//! bounded size. It drops what was not used for the longest time; `quick_cache` does that only approximately. `hashlink` comes with
//! sqlx anyway.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use axum::body::Bytes;
use hashlink::LruCache;
use tokio::sync::{Semaphore, SemaphorePermit};

use super::blocking::{BlockingWork, TaskError};
use super::config::ServerConfig;

/// The threads and the cache of pictures; clones share them.
#[derive(Clone)]
pub(super) struct RenderCache {
    threads: BlockingWork,
    cache: Arc<Mutex<RenderedFiles>>,
    turns: Arc<Semaphore>,
}

impl RenderCache {
    pub(super) fn new(config: &ServerConfig) -> Self {
        Self {
            threads: BlockingWork::new("pictures", config.picture_threads, true),
            cache: Arc::new(Mutex::new(RenderedFiles::new(config.max_cached_bytes))),
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
        lock(&self.cache).get(key)
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
            if let Some(bytes) = lock(&cache).get(&key) {
                return Ok(bytes);
            }
            let bytes = Bytes::from(make()?);
            lock(&cache).insert(key, bytes.clone());
            Ok(bytes)
        });
        made.await?
    }
}

fn lock(cache: &Mutex<RenderedFiles>) -> MutexGuard<'_, RenderedFiles> {
    cache.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Results by key. If they take more than the limit, those that were not used for the longest time are dropped.
struct RenderedFiles {
    limit: usize,
    /// The size of all files and their keys.
    bytes: usize,
    by_use: LruCache<String, Bytes>,
}

impl RenderedFiles {
    fn new(limit: usize) -> Self {
        Self {
            limit,
            bytes: 0,
            by_use: LruCache::new_unbounded(),
        }
    }

    fn get(&mut self, key: &str) -> Option<Bytes> {
        self.by_use.get(key).cloned()
    }

    fn insert(&mut self, key: String, file: Bytes) {
        let added = size(&key, &file);
        if added > self.limit {
            return;
        }
        if let Some(replaced) = self.by_use.remove(&key) {
            self.bytes -= size(&key, &replaced);
        }
        self.bytes += added;
        self.by_use.insert(key, file);
        while self.bytes > self.limit
            && let Some((key, file)) = self.by_use.remove_lru()
        {
            self.bytes -= size(&key, &file);
        }
    }
}

fn size(key: &str, file: &Bytes) -> usize {
    key.len() + file.len()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn bytes(length: usize) -> Bytes {
        Bytes::from(vec![0; length])
    }

    #[test]
    fn the_cache_drops_what_was_not_used_for_the_longest_time() {
        let mut cache = RenderedFiles::new(100);
        cache.insert("a".to_owned(), bytes(40));
        cache.insert("b".to_owned(), bytes(40));
        assert!(cache.get("a").is_some());
        cache.insert("c".to_owned(), bytes(40));
        assert!(cache.get("b").is_none() && cache.get("a").is_some() && cache.get("c").is_some());
        assert_eq!(cache.bytes, 82);
    }

    #[test]
    fn the_cache_keeps_nothing_that_exceeds_it() {
        let mut cache = RenderedFiles::new(100);
        cache.insert("a".to_owned(), bytes(50));
        cache.insert("b".to_owned(), bytes(100));
        assert!(cache.get("b").is_none() && cache.get("a").is_some());
        RenderedFiles::new(0).insert("a".to_owned(), bytes(0));
    }
}
