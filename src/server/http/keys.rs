//! API keys: how they are made, and which requests they allow.

use std::collections::HashSet;
use std::convert::Infallible;
use std::sync::{Arc, PoisonError, RwLock, RwLockReadGuard};
use std::time::Duration;

use axum::extract::{Request, State};
use axum::http::{HeaderMap, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use base64::Engine as _;
use base64::engine::general_purpose::URL_SAFE_NO_PAD;
use metrics::counter;
use sha2::{Digest as _, Sha256};
use tokio::sync::watch;
use tracing::warn;

use super::problem::ApiError;
use crate::store::{KeyRow, Store, StoreError};
use crate::telemetry::names;

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
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(in crate::server) struct Caller(Option<KeyHash>);

impl Caller {
    /// Whether this caller may use what another made. What was made without a key is everybody's.
    pub(in crate::server) fn may_use(self, maker: Self) -> bool {
        maker.0.is_none() || maker == self
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
    /// The keys that are not revoked.
    valid: HashSet<KeyHash>,
    /// Whether the store has any key, revoked or not.
    exist: bool,
    /// Keys that an older version stored in a form that is no longer accepted.
    outdated: usize,
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
        let usable: Vec<&KeyRow> = rows.iter().filter(|row| row.revoked_s.is_none()).collect();
        let valid: HashSet<KeyHash> = usable.iter().filter_map(|row| KeyHash::from_row(row)).collect();
        let outdated = usable.len() - valid.len();
        let mut known = self.shared.known.write().unwrap_or_else(PoisonError::into_inner);
        if outdated > known.outdated {
            warn!(
                keys = outdated,
                "some API keys were made by an older version and are no longer accepted; create new ones with foreframe \
                 keys create, and revoke the old ones"
            );
        }
        *known = KnownKeys {
            valid,
            exist: !rows.is_empty() || store.keys_were_created(),
            outdated,
        };
        drop(known);
        self.shared.refreshed.send_replace(());
        Ok(())
    }

    /// Completes when the caller's key is no longer valid; never for a caller without a key.
    pub(in crate::server) async fn revoked(&self, caller: Caller) {
        let Caller(Some(key)) = caller else {
            return std::future::pending().await;
        };
        let mut refreshed = self.shared.refreshed.subscribe();
        // The sender lives as long as these keys.
        while self.known().valid.contains(&key) && refreshed.changed().await.is_ok() {}
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

    /// Takes the same time for every key that is not valid: the whole text is hashed, then looked up.
    fn check(&self, presented: Option<&str>) -> Result<Caller, ApiError> {
        if !self.are_required() {
            return Ok(Caller(None));
        }
        let key = presented.ok_or(ApiError::Unauthorized(
            "this server requires an API key: send the header Authorization: Bearer KEY; create a key with foreframe keys \
             create NAME",
        ))?;
        let hash = KeyHash::of(key);
        if self.known().valid.contains(&hash) {
            return Ok(Caller(Some(hash)));
        }
        Err(ApiError::Unauthorized(
            "the API key is not valid: it is unknown or was revoked",
        ))
    }

    fn known(&self) -> RwLockReadGuard<'_, KnownKeys> {
        self.shared.known.read().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Refuses a request without a valid key if authentication is on. Others get their [`Caller`] as an extension.
pub(in crate::server) async fn check(State(keys): State<Keys>, mut request: Request, next: Next) -> Response {
    match keys.check(presented(request.headers())) {
        Ok(caller) => {
            request.extensions_mut().insert(caller);
            next.run(request).await
        }
        Err(refused) => {
            counter!(names::AUTH_REFUSED).increment(1);
            refused.into_response()
        }
    }
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
