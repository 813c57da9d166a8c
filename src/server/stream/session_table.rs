//! The open sessions: a bounded number. A session expires if it is not used for the grace period. Time is an argument.

use std::collections::{BTreeMap, VecDeque};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use metrics::counter;
use tracing::info;

use super::session::Session;
use crate::server::http::keys::Caller;
use crate::server::http::problem::ApiError;
use crate::server::token::TokenHash;
use foreframe_core::metric_names;

/// All open sessions, by id.
pub(in crate::server) struct SessionTable {
    inner: Mutex<SessionTableInner>,
    limit: usize,
    pub(in crate::server) grace: Duration,
}

#[derive(Default)]
struct SessionTableInner {
    sessions: BTreeMap<String, Arc<Session>>,
    /// Ids of the last sessions that expired, so that they differ from unknown ids. At most as many as may be open.
    expired: VecDeque<String>,
}

impl SessionTable {
    pub(in crate::server) fn new(limit: usize, grace: Duration) -> Self {
        Self {
            inner: Mutex::default(),
            limit,
            grace,
        }
    }

    /// Errors: `Unavailable` if there are too many.
    pub(in crate::server) fn insert(&self, session: Session, now: Instant) -> Result<Arc<Session>, ApiError> {
        let mut inner = self.current(now);
        if inner.sessions.len() >= self.limit {
            let limit = self.limit;
            return Err(ApiError::unavailable(format!(
                "{limit} sessions are open already; try again later"
            )));
        }
        let session = Arc::new(session);
        inner.sessions.insert(session.id.clone(), Arc::clone(&session));
        Ok(session)
    }

    /// The session, if the caller may see it. Errors: `NotFound`, `Gone`.
    pub(in crate::server) fn find(&self, id: &str, caller: Caller, now: Instant) -> Result<Arc<Session>, ApiError> {
        let session = self.get(id, now)?;
        if caller.may_see(session.maker) {
            Ok(session)
        } else {
            Err(unknown(id))
        }
    }

    /// The session. Errors: `NotFound`, `Gone`.
    fn get(&self, id: &str, now: Instant) -> Result<Arc<Session>, ApiError> {
        let inner = self.current(now);
        let session = inner.sessions.get(id).cloned();
        session.ok_or_else(|| {
            if inner.expired.iter().any(|expired| expired == id) {
                return ApiError::Gone(format!(
                    "session \"{id}\" was not used for {} ms and has expired; open a new one with POST /v1/sessions",
                    self.grace.as_millis()
                ));
            }
            unknown(id)
        })
    }

    /// The session, if the token is right; counts as use. Errors: `NotFound`, `Gone`, `Forbidden`.
    pub(in crate::server) fn open(&self, id: &str, token: &str, now: Instant) -> Result<Arc<Session>, ApiError> {
        let session = self.get(id, now)?;
        if session.token_hash != TokenHash::of(token) {
            return Err(ApiError::Forbidden(
                "the session's token is missing or wrong; send it in the header x-session-token or as query parameter token"
                    .to_owned(),
            ));
        }
        session.touch(now);
        Ok(session)
    }

    pub(in crate::server) fn remove(&self, session: &Session) {
        self.inner().sessions.remove(&session.id);
        session.delete();
    }

    /// The sessions after an id that the caller may see, in the order of their ids.
    pub(in crate::server) fn page(&self, after: &str, limit: usize, caller: Caller, now: Instant) -> Vec<Arc<Session>> {
        let inner = self.current(now);
        let later = inner
            .sessions
            .range::<str, _>((std::ops::Bound::Excluded(after), std::ops::Bound::Unbounded));
        let seen = later.map(|(_, session)| session).filter(|of| caller.may_see(of.maker));
        seen.take(limit).cloned().collect()
    }

    /// How many are open.
    pub(in crate::server) fn count(&self, now: Instant) -> usize {
        self.current(now).sessions.len()
    }

    /// The table without the sessions that have expired.
    fn current(&self, now: Instant) -> MutexGuard<'_, SessionTableInner> {
        let mut inner = self.inner();
        let SessionTableInner { sessions, expired } = &mut *inner;
        sessions.retain(|id, session| {
            let is_over = session.left(self.grace, now).is_some_and(|left| left.is_zero());
            if is_over {
                info!(session.id = %id, frames = session.next_seq(), "session expired");
                counter!(metric_names::SESSIONS_EVICTED).increment(1);
                session.delete();
                expired.push_back(id.clone());
            }
            !is_over
        });
        let surplus = expired.len().saturating_sub(self.limit);
        expired.drain(..surplus);
        inner
    }

    fn inner(&self) -> MutexGuard<'_, SessionTableInner> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

fn unknown(id: &str) -> ApiError {
    ApiError::NotFound(format!("there is no session \"{id}\""))
}
