//! A table of environments, simulated ones or world models: bounded in number and in idle time. Time is an argument.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use tracing::info;

use super::config::ServerConfig;
use super::http::keys::Caller;
use super::http::problem::ApiError;
use super::token::Token;
use foreframe_sim::Environment;

/// An environment that one request at a time can step.
pub(super) type SharedEnvironment = Arc<Mutex<Environment>>;

struct Entry<T> {
    environment: Arc<T>,
    maker: Caller,
    used: Instant,
}

/// All environments, by id.
pub(super) struct Environments<T> {
    /// What a caller calls one of them.
    kind: &'static str,
    limit: usize,
    idle: Duration,
    /// How long an environment must have been idle to be replaced when the table is full.
    evict_after: Duration,
    table: Mutex<BTreeMap<String, Entry<T>>>,
}

impl<T> Environments<T> {
    pub(super) fn new(kind: &'static str, config: &ServerConfig) -> Self {
        Self {
            kind,
            limit: config.max_environments,
            idle: Duration::from_millis(config.environment_idle_ms),
            evict_after: Duration::from_millis(config.environment_evict_ms),
            table: Mutex::default(),
        }
    }

    /// Adds an environment and gives its random id. If the table is full, it replaces the environment that was idle the
    /// longest, if that was long enough. Errors: `Unavailable` if there is none, `Internal`.
    pub(super) fn add(&self, environment: T, maker: Caller, now: Instant) -> Result<String, ApiError> {
        let id = Token::random()?.id();
        let mut table = self.table(now);
        if table.len() >= self.limit {
            self.evict_idlest(&mut table, now)?;
        }
        let entry = Entry {
            environment: Arc::new(environment),
            maker,
            used: now,
        };
        table.insert(id.clone(), entry);
        Ok(id)
    }

    fn evict_idlest(&self, table: &mut BTreeMap<String, Entry<T>>, now: Instant) -> Result<(), ApiError> {
        let idlest = table.iter().min_by_key(|(_, entry)| entry.used);
        let idlest = idlest.map(|(id, entry)| (id.clone(), now.saturating_duration_since(entry.used)));
        let (id, idle) = idlest.filter(|(_, idle)| *idle >= self.evict_after).ok_or_else(|| {
            let (limit, kind) = (self.limit, self.kind);
            ApiError::unavailable(format!(
                "{limit} {kind}s are in use already (setting max_environments); end one, or try again later"
            ))
        })?;
        table.remove(&id);
        info!(environment.id = %id, idle_s = idle.as_secs(), "environment replaced by a new one");
        Ok(())
    }

    /// The environment; counts as use. Errors: `NotFound`, also if it is another caller's.
    pub(super) fn get(&self, id: &str, caller: Caller, now: Instant) -> Result<Arc<T>, ApiError> {
        let mut table = self.table(now);
        let entry = table.get_mut(id).filter(|entry| caller.may_use(entry.maker));
        let entry = entry.ok_or_else(|| self.unknown(id))?;
        entry.used = entry.used.max(now);
        Ok(Arc::clone(&entry.environment))
    }

    /// A new one may replace it at once, as one that was idle for long enough.
    pub(super) fn give_up_place(&self, id: &str, now: Instant) {
        let mut table = self.table(now);
        if let (Some(entry), Some(earlier)) = (table.get_mut(id), now.checked_sub(self.evict_after)) {
            entry.used = earlier;
        }
    }

    /// Errors: `NotFound`, also if it is another caller's.
    pub(super) fn remove(&self, id: &str, caller: Caller, now: Instant) -> Result<(), ApiError> {
        self.get(id, caller, now)?;
        self.table(now).remove(id);
        Ok(())
    }

    fn unknown(&self, id: &str) -> ApiError {
        ApiError::NotFound(format!(
            "there is no {} \"{}\"; one that nobody steps for {} s is dropped",
            self.kind,
            id.escape_default(),
            self.idle.as_secs()
        ))
    }

    /// The table without the environments that have been idle for too long.
    fn table(&self, now: Instant) -> MutexGuard<'_, BTreeMap<String, Entry<T>>> {
        let mut table = self.table.lock().unwrap_or_else(PoisonError::into_inner);
        table.retain(|_, entry| now.saturating_duration_since(entry.used) < self.idle);
        table
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use foreframe_sim::{Scenario, WorldConfig};

    fn environment() -> Mutex<Environment> {
        Mutex::new(Environment::new(Scenario::Crowded, WorldConfig::default()).unwrap())
    }

    fn table(limit: usize) -> Environments<Mutex<Environment>> {
        let config = ServerConfig {
            max_environments: limit,
            ..ServerConfig::default()
        };
        Environments::new("environment", &config)
    }

    #[test]
    fn a_full_table_replaces_the_idlest_environment() {
        let (table, start) = (table(2), Instant::now());
        let after = |seconds| start + Duration::from_secs(seconds);
        let first = table.add(environment(), Caller::default(), start).unwrap();
        let second = table.add(environment(), Caller::default(), start).unwrap();
        assert!(table.get(&first, Caller::default(), after(3)).is_ok());
        let third = table.add(environment(), Caller::default(), after(6)).unwrap();
        assert!(
            table.get(&second, Caller::default(), after(6)).is_err(),
            "it was idle for 6 s"
        );
        assert!(
            table.get(&first, Caller::default(), after(6)).is_ok()
                && table.get(&third, Caller::default(), after(6)).is_ok()
        );
    }

    #[test]
    fn an_environment_in_use_is_not_replaced() {
        let (table, start) = (table(1), Instant::now());
        table.add(environment(), Caller::default(), start).unwrap();
        let error = table
            .add(environment(), Caller::default(), start + Duration::from_secs(2))
            .unwrap_err();
        assert!(matches!(error, ApiError::Unavailable { .. }));
    }

    #[test]
    fn one_that_gave_up_its_place_is_replaced_at_once() {
        let (table, start) = (table(1), Instant::now() + Duration::from_mins(1));
        let first = table.add(environment(), Caller::default(), start).unwrap();
        table.give_up_place(&first, start);
        assert!(table.get(&first, Caller::default(), start).is_ok());
        table.give_up_place(&first, start);
        assert!(table.add(environment(), Caller::default(), start).is_ok());
    }

    #[test]
    fn ids_are_long_and_random() {
        let (table, now) = (table(2), Instant::now());
        let ids = [(); 2].map(|()| table.add(environment(), Caller::default(), now).unwrap());
        assert!(ids[0] != ids[1] && ids.iter().all(|id| id.len() == 32));
    }
}
