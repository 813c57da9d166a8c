//! API keys: how they are made, and which requests they allow.

use std::collections::HashMap;
use std::convert::Infallible;
use std::sync::{Arc, PoisonError, RwLock, RwLockReadGuard};
use std::time::{Duration, Instant};

use axum::extract::{MatchedPath, Request, State};
use axum::http::{HeaderMap, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use base64::Engine as _;
use base64::engine::general_purpose::URL_SAFE_NO_PAD;
use metrics::counter;
use sha2::{Digest as _, Sha256};
use tokio::sync::watch;
use tracing::warn;

use super::access::required_scope;
use super::problem::ApiError;
use super::rate::RateLimit;
use foreframe_core::metric_names;
use foreframe_jobs::store::{Author, KeyRow, KeyScope, Store, StoreError};

/// The beginning of every key, so that leaked keys are easy to find.
const PREFIX: &str = "ffk";
/// A browser cannot set headers of a WebSocket. It can offer the key as a sub-protocol with this prefix.
const SUBPROTOCOL_PREFIX: &str = "foreframe.key.";
const ID_BYTES: usize = 6;
const SECRET_BYTES: usize = 32;

/// Why no key could be made.
#[derive(Debug, thiserror::Error)]
pub enum KeyError {
    /// The system gave no random bytes.
    #[error("the system gave no random bytes: {0}")]
    Random(getrandom::Error),
}

/// A new key: its text for the caller, its hash for the store.
pub struct NewKey {
    /// Its public part.
    pub id: String,
    /// What a caller sends: `ffk_ID_SECRET`.
    pub text: String,
    /// SHA-256 of the text, hexadecimal. A slow hash would protect weak passwords; a key has 256 random bits.
    pub hash: String,
}

impl NewKey {
    /// A random key. Errors: `Random`.
    pub fn generate() -> Result<Self, KeyError> {
        let mut random = [0; ID_BYTES + SECRET_BYTES];
        getrandom::fill(&mut random).map_err(KeyError::Random)?;
        let (id, secret) = random.split_at(ID_BYTES);
        let id = hex::encode(id);
        let text = format!("{PREFIX}_{id}_{}", URL_SAFE_NO_PAD.encode(secret));
        Ok(Self {
            hash: hex::encode(KeyHash::of(&text).0),
            text,
            id,
        })
    }
}

/// SHA-256 of a key's whole text.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
struct KeyHash([u8; 32]);

impl KeyHash {
    fn of(text: &str) -> Self {
        Self(Sha256::digest(text).into())
    }

    /// `None` for a hash that an older version stored in another form.
    fn from_row(row: &KeyRow) -> Option<Self> {
        let mut hash = [0; 32];
        hex::decode_to_slice(&row.hash, &mut hash).ok()?;
        Some(Self(hash))
    }
}

/// Who sent a request: the key that it presented, or nobody if authentication was off.
#[derive(Clone, Copy, Debug, Default)]
pub(in crate::server) struct Caller {
    key: Option<KeyHash>,
    is_admin: bool,
}

impl Caller {
    /// Whether this caller may use what another made. What was made without a key is everybody's.
    pub(in crate::server) fn may_use(self, maker: Self) -> bool {
        maker.key.is_none() || maker.key == self.key
    }

    /// Whether this caller may see what another made: its own, and with the scope `admin` everything.
    pub(in crate::server) fn may_see(self, maker: Self) -> bool {
        self.is_admin || self.may_use(maker)
    }
}

/// Who may call; clones share it.
#[derive(Clone)]
pub struct Keys {
    shared: Arc<KeyCache>,
}

struct KeyCache {
    store: Option<Store>,
    is_required: bool,
    known: RwLock<KnownKeys>,
    /// Notified when the keys were read.
    refreshed: watch::Sender<()>,
}

#[derive(Default)]
struct KnownKeys {
    /// The keys that were not revoked or expired when they were read.
    valid: HashMap<KeyHash, Arc<KnownKey>>,
    /// Whether the store has any key, revoked or not.
    exist: bool,
    /// Keys that an older version stored in a form that is no longer accepted.
    outdated: usize,
    clock: StoreClock,
}

/// The store's clock since it was read: this machine's clock can be wrong, and can jump.
#[derive(Clone, Copy)]
struct StoreClock {
    read_s: f64,
    read_at: Instant,
}

impl StoreClock {
    fn at(read_s: f64) -> Self {
        let read_at = Instant::now();
        Self { read_s, read_at }
    }

    fn now_s(self) -> f64 {
        self.read_s + self.read_at.elapsed().as_secs_f64()
    }
}

impl Default for StoreClock {
    fn default() -> Self {
        Self::at(0.0)
    }
}

/// A key and what was used of its rate.
struct KnownKey {
    row: KeyRow,
    rate: Option<RateLimit>,
}

impl KnownKey {
    fn new(row: KeyRow) -> Self {
        let rate = row.requests_per_s.map(|per_s| RateLimit::new(per_s, Instant::now()));
        Self { row, rate }
    }

    /// Errors: `Unauthorized` if it has expired, `Forbidden` if its scope is too small, `TooMany`.
    fn check(&self, needed: KeyScope, now_s: f64) -> Result<(), ApiError> {
        if !self.row.is_valid(now_s) {
            return Err(ApiError::Unauthorized("the API key has expired; create a new one"));
        }
        if self.row.scope < needed {
            return Err(ApiError::Forbidden(format!(
                "this needs an API key with scope {needed}, but the scope of key {} is {}",
                self.row.id, self.row.scope
            )));
        }
        let taken = self.rate.as_ref().map_or(Ok(()), |rate| rate.take(Instant::now()));
        taken.map_err(|wait_s| ApiError::TooMany {
            detail: format!(
                "key {} may send {} requests a second",
                self.row.id,
                self.row.requests_per_s.unwrap_or_default()
            ),
            retry_after_s: wait_s.ceil().max(1.0) as u64,
        })
    }
}

impl Keys {
    /// Authentication is off.
    #[must_use]
    pub fn none() -> Self {
        Self::with(None, false)
    }

    /// The keys of this store. If the store has none, not even a revoked one, authentication is off unless `is_required`.
    /// Errors: `Query`.
    pub async fn open(store: Store, is_required: bool) -> Result<Self, StoreError> {
        let keys = Self::with(Some(store), is_required);
        keys.refresh().await?;
        Ok(keys)
    }

    fn with(store: Option<Store>, is_required: bool) -> Self {
        Self {
            shared: Arc::new(KeyCache {
                store,
                is_required,
                known: RwLock::default(),
                refreshed: watch::Sender::new(()),
            }),
        }
    }

    /// How many are valid.
    #[must_use]
    pub fn count(&self) -> usize {
        self.known().valid.len()
    }

    /// Reads the keys again: adds new ones and drops revoked ones. Errors: `Query`; then the keys stay as they were.
    pub async fn refresh(&self) -> Result<(), StoreError> {
        let Some(store) = &self.shared.store else { return Ok(()) };
        let rows = store.list_keys().await?;
        let exist = !rows.is_empty() || store.keys_were_created();
        let clock = StoreClock::at(store.now_s().await?);
        let now_s = clock.now_s();
        let usable: Vec<KeyRow> = rows.into_iter().filter(|row| row.is_valid(now_s)).collect();
        let mut known = self.shared.known.write().unwrap_or_else(PoisonError::into_inner);
        let (count, mut valid) = (usable.len(), HashMap::new());
        for row in usable {
            let Some(hash) = KeyHash::from_row(&row) else { continue };
            // A key that has not changed keeps what was used of its rate.
            let before = known.valid.get(&hash).filter(|before| before.row == row).cloned();
            valid.insert(hash, before.unwrap_or_else(|| Arc::new(KnownKey::new(row))));
        }
        let outdated = count - valid.len();
        if outdated > known.outdated {
            warn!(
                keys = outdated,
                "some API keys were made by an older version and are no longer accepted; create new ones with foreframe \
                 keys create, and revoke the old ones"
            );
        }
        *known = KnownKeys {
            valid,
            exist,
            outdated,
            clock,
        };
        drop(known);
        self.shared.refreshed.send_replace(());
        Ok(())
    }

    /// Completes when the caller's key is no longer valid; never for a caller without a key.
    pub(in crate::server) async fn revoked(&self, caller: Caller) {
        let Some(key) = caller.key else {
            return std::future::pending().await;
        };
        let mut refreshed = self.shared.refreshed.subscribe();
        // The sender lives as long as these keys.
        while self.known().valid.contains_key(&key) && refreshed.changed().await.is_ok() {}
    }

    /// Reads the keys again and again, so that no request has to wait for the store.
    pub(in crate::server) async fn keep_fresh(&self, interval: Duration) -> Infallible {
        loop {
            tokio::time::sleep(interval).await;
            if let Err(error) = self.refresh().await {
                warn!(%error, "could not read the API keys; the keys read before stay valid");
            }
        }
    }

    /// Whether a request needs a key.
    #[must_use]
    pub fn are_required(&self) -> bool {
        self.shared.is_required || self.known().exist
    }

    /// Who calls, with a key of the needed scope, and the author of what the request changes. Takes the same time for every unknown
    /// key: the whole text is hashed, then looked up.
    fn check(&self, presented: Option<&str>, needed: KeyScope) -> Result<(Caller, Author), ApiError> {
        if !self.are_required() {
            return Ok((Caller::default(), Author::Anonymous));
        }
        let key = presented.ok_or(ApiError::Unauthorized(
            "this server requires an API key: send the header Authorization: Bearer KEY; create a key with foreframe keys \
             create NAME",
        ))?;
        let hash = KeyHash::of(key);
        let (known, clock) = {
            let keys = self.known();
            (keys.valid.get(&hash).cloned(), keys.clock)
        };
        let known = known.ok_or(ApiError::Unauthorized(
            "the API key is not valid: it is unknown, was revoked or has expired",
        ))?;
        known.check(needed, clock.now_s())?;
        let caller = Caller {
            key: Some(hash),
            is_admin: known.row.scope == KeyScope::Admin,
        };
        Ok((caller, Author::of_key(&known.row.id)))
    }

    fn known(&self) -> RwLockReadGuard<'_, KnownKeys> {
        self.shared.known.read().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Refuses a request without a key that allows it, if authentication is on. Others get their [`Caller`] and [`Author`] as
/// extensions.
pub(in crate::server) async fn check(State(keys): State<Keys>, mut request: Request, next: Next) -> Response {
    let route = request.extensions().get::<MatchedPath>().cloned();
    let route = route.as_ref().map_or("", MatchedPath::as_str);
    let needed = required_scope(request.method(), route);
    let (caller, author) = match keys.check(presented(request.headers()), needed) {
        Ok(caller) => caller,
        Err(refused) => {
            counter!(metric_names::AUTH_REFUSED).increment(1);
            return refused.into_response();
        }
    };
    request.extensions_mut().insert(caller);
    request.extensions_mut().insert(author);
    next.run(request).await
}

/// The key that a request presents.
fn presented(headers: &HeaderMap) -> Option<&str> {
    let bearer = headers.get(header::AUTHORIZATION).and_then(|value| value.to_str().ok());
    let bearer = bearer.and_then(|value| value.split_once(' '));
    let bearer = bearer.filter(|(scheme, _)| scheme.eq_ignore_ascii_case("bearer"));
    let protocols = headers.get(header::SEC_WEBSOCKET_PROTOCOL);
    let protocols = protocols.and_then(|value| value.to_str().ok()).unwrap_or("");
    let mut offered = protocols.split(',').map(str::trim);
    bearer
        .map(|(_, key)| key.trim())
        .or_else(|| offered.find_map(|protocol| protocol.strip_prefix(SUBPROTOCOL_PREFIX)))
}

#[cfg(test)]
mod tests {
    use axum::http::HeaderValue;

    use super::*;

    fn row(hash: &str) -> KeyRow {
        KeyRow {
            id: String::new(),
            name: String::new(),
            hash: hash.to_owned(),
            created_s: 0.0,
            revoked_s: None,
            scope: KeyScope::Admin,
            expires_s: None,
            requests_per_s: None,
        }
    }

    #[test]
    fn a_new_key_matches_its_hash_and_no_other() {
        let (one, other) = (NewKey::generate().unwrap(), NewKey::generate().unwrap());
        assert!(one.text.starts_with(&format!("ffk_{}_", one.id)));
        assert!(KeyHash::from_row(&row(&one.hash)) == Some(KeyHash::of(&one.text)));
        assert!(KeyHash::from_row(&row(&other.hash)) != Some(KeyHash::of(&one.text)));
    }

    #[test]
    fn a_hash_of_an_older_version_is_not_accepted() {
        assert!(KeyHash::from_row(&row("$argon2id$v=19$m=19456,t=2,p=1$c2FsdA$aGFzaA")).is_none());
    }

    #[test]
    fn a_key_is_found_in_either_header() {
        let with = |name, value| HeaderMap::from_iter([(name, HeaderValue::from_static(value))]);
        assert_eq!(presented(&with(header::AUTHORIZATION, "bearer abc")), Some("abc"));
        assert_eq!(presented(&with(header::AUTHORIZATION, "Basic abc")), None);
        let offered = "foreframe.v1.json, foreframe.key.abc";
        assert_eq!(presented(&with(header::SEC_WEBSOCKET_PROTOCOL, offered)), Some("abc"));
        assert_eq!(presented(&HeaderMap::new()), None);
    }
}
