//! The environments that run, bounded in number and in the time that nobody steps them.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use crate::server::error::ApiError;
use crate::sim::Environment;

/// An environment, stepped by one at a time.
pub(super) type SharedEnvironment = Arc<Mutex<Environment>>;

struct Entry {
    environment: SharedEnvironment,
    used: Instant,
}

#[derive(Default)]
struct EnvironmentTable {
    next: u64,
    entries: BTreeMap<String, Entry>,
}

/// All of them.
pub(in crate::server) struct Environments {
    limit: usize,
    idle: Duration,
    table: Mutex<EnvironmentTable>,
}

impl Environments {
    pub(in crate::server) fn new(limit: usize, idle: Duration) -> Self {
        Self {
            limit,
            idle,
            table: Mutex::default(),
        }
    }

    /// Takes one in and gives its id. Errors: `Unavailable` where there are as many as may be.
    pub(super) fn add(&self, environment: Environment) -> Result<String, ApiError> {
        let mut table = self.table();
        if table.entries.len() >= self.limit {
            return Err(ApiError::unavailable(format!(
                "{} environments run already; delete one, or try again later",
                self.limit
            )));
        }
        table.next += 1;
        let id = format!("env-{}", table.next);
        let entry = Entry {
            environment: Arc::new(Mutex::new(environment)),
            used: Instant::now(),
        };
        table.entries.insert(id.clone(), entry);
        Ok(id)
    }

    /// Errors: `NotFound`.
    pub(super) fn get(&self, id: &str) -> Result<SharedEnvironment, ApiError> {
        let mut table = self.table();
        let entry = table.entries.get_mut(id).ok_or_else(|| self.unknown(id))?;
        entry.used = Instant::now();
        Ok(Arc::clone(&entry.environment))
    }

    /// Errors: `NotFound`.
    pub(super) fn remove(&self, id: &str) -> Result<(), ApiError> {
        let removed = self.table().entries.remove(id);
        removed.map(drop).ok_or_else(|| self.unknown(id))
    }

    fn unknown(&self, id: &str) -> ApiError {
        ApiError::NotFound(format!(
            "there is no environment \"{}\"; one that nobody steps for {} s is dropped",
            id.escape_default(),
            self.idle.as_secs()
        ))
    }

    /// The table, without those that have been idle too long.
    fn table(&self) -> MutexGuard<'_, EnvironmentTable> {
        let mut table = lock(&self.table);
        table.entries.retain(|_, entry| entry.used.elapsed() < self.idle);
        table
    }
}

pub(super) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
