//! API keys: how they are made, and who may call.

use std::collections::HashMap;
use std::convert::Infallible;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use argon2::password_hash::phc::PasswordHash;
use argon2::{Argon2, PasswordHasher as _, PasswordVerifier as _};
use axum::extract::{Request, State};
use axum::http::{HeaderMap, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use base64::Engine as _;
use base64::engine::general_purpose::URL_SAFE_NO_PAD;
use metrics::counter;
use sha2::{Digest as _, Sha256};
use tracing::warn;

use super::error::ApiError;
use super::{App, blocking};
use crate::store::{Store, StoreError};
use crate::telemetry::names;

/// What keys begin with, so that they are recognized where they should not be.
const PREFIX: &str = "ffk";
/// A browser cannot set headers of a WebSocket; it may offer the key as a sub-protocol with this before it.
const SUBPROTOCOL_PREFIX: &str = "foreframe.key.";
const ID_BYTES: usize = 6;
const SALT_BYTES: usize = 16;
const SECRET_BYTES: usize = 32;

/// Why no key could be made.
#[derive(Debug, thiserror::Error)]
pub enum KeyError {
    /// The system gave no random bytes.
    #[error("the system gave no random bytes: {0}")]
    Random(getrandom::Error),
    /// The secret could not be hashed.
    #[error("the key could not be hashed: {0}")]
    Hash(argon2::password_hash::Error),
}

/// A new key, as it is told once and as it is kept.
pub struct NewKey {
    /// Its public part.
    pub id: String,
    /// What a caller shows: `ffk_ID_SECRET`.
    pub text: String,
    /// Argon2id of the secret.
    pub hash: String,
}

impl NewKey {
    /// A random one. Takes tens of milliseconds. Errors: `Random`, `Hash`.
    pub fn generate() -> Result<Self, KeyError> {
        let mut random = [0; ID_BYTES + SALT_BYTES + SECRET_BYTES];
        getrandom::fill(&mut random).map_err(KeyError::Random)?;
        let (id, rest) = random.split_at(ID_BYTES);
        let (salt, secret) = rest.split_at(SALT_BYTES);
        let id = id.iter().fold(String::new(), |id, byte| format!("{id}{byte:02x}"));
        let secret = URL_SAFE_NO_PAD.encode(secret);
        let hash = Argon2::default()
            .hash_password_with_salt(secret.as_bytes(), salt)
            .map_err(KeyError::Hash)?;
        Ok(Self {
            text: format!("{PREFIX}_{id}_{secret}"),
            hash: hash.to_string(),
            id,
        })
    }
}

/// Who may call; clones are the same.
#[derive(Clone)]
pub struct Keys {
    shared: Arc<KeyCache>,
}

struct KeyCache {
    store: Option<Store>,
    is_required: bool,
    known: Mutex<KnownKey>,
    /// Slow hashes are computed one at a time, so that wrong keys cannot take all cores.
    verifying: tokio::sync::Mutex<()>,
}

#[derive(Default)]
struct KnownKey {
    /// Hashes of the keys that are not revoked, by id.
    hashes: HashMap<String, String>,
    /// Whether there has been any key, revoked or not.
    were_made: bool,
    /// Keys that were checked against their hash, as their SHA-256: the slow hash is computed once a key.
    verified: HashMap<[u8; 32], String>,
}

impl Keys {
    /// Everybody may.
    #[must_use]
    pub fn open() -> Self {
        Self::with(None, false)
    }

    /// Whoever has a key of the store may; everybody while none was ever made, unless `is_required`: one that is revoked
    /// opens the server to nobody. Errors: `Query`.
    pub async fn of(store: Store, is_required: bool) -> Result<Self, StoreError> {
        let keys = Self::with(Some(store), is_required);
        keys.refresh().await?;
        Ok(keys)
    }

    fn with(store: Option<Store>, is_required: bool) -> Self {
        Self {
            shared: Arc::new(KeyCache {
                store,
                is_required,
                known: Mutex::default(),
                verifying: tokio::sync::Mutex::default(),
            }),
        }
    }

    /// How many are valid.
    #[must_use]
    pub fn count(&self) -> usize {
        self.known().hashes.len()
    }

    /// Takes new keys in, and drops revoked ones. Errors: `Query`, and then those known before are still taken.
    pub async fn refresh(&self) -> Result<(), StoreError> {
        let Some(store) = &self.shared.store else { return Ok(()) };
        let rows = store.list_keys().await?;
        let were_made = !rows.is_empty() || store.keys_were_created();
        let hashes: HashMap<_, _> = rows
            .into_iter()
            .filter(|row| row.revoked_s.is_none())
            .map(|row| (row.id, row.hash))
            .collect();
        let mut known = self.known();
        known.verified.retain(|_, id| hashes.contains_key(id));
        known.hashes = hashes;
        known.were_made = were_made;
        Ok(())
    }

    /// Asks the store again and again, so that no request has to.
    pub(super) async fn keep_fresh(&self, interval: Duration) -> Infallible {
        loop {
            tokio::time::sleep(interval).await;
            if let Err(error) = self.refresh().await {
                warn!(%error, "the keys could not be read; those read before are taken");
            }
        }
    }

    /// Whether callers must show one.
    #[must_use]
    pub fn are_asked_for(&self) -> bool {
        self.shared.is_required || self.known().were_made
    }

    async fn check(&self, presented: Option<&str>) -> Result<(), ApiError> {
        const UNKNOWN: ApiError = ApiError::Unauthorized("the key is not known here, or was revoked");
        if !self.are_asked_for() {
            return Ok(());
        }
        let key = presented.ok_or(ApiError::Unauthorized(
            "this server asks for a key: send the header Authorization: Bearer KEY; foreframe keys create NAME makes one",
        ))?;
        let digest: [u8; 32] = Sha256::digest(key).into();
        if self.is_verified(&digest) {
            return Ok(());
        }
        let (id, secret) = parts(key).ok_or(UNKNOWN)?;
        let hash = self.known().hashes.get(id).cloned().ok_or(UNKNOWN)?;
        let turn = self.shared.verifying.lock().await;
        let secret = secret.to_owned();
        // Others with the same key may have waited before this one.
        if !self.is_verified(&digest) && !blocking(move || matches(&hash, &secret)).await? {
            return Err(UNKNOWN);
        }
        drop(turn);
        self.known().verified.insert(digest, id.to_owned());
        Ok(())
    }

    fn is_verified(&self, digest: &[u8; 32]) -> bool {
        self.known().verified.contains_key(digest)
    }

    fn known(&self) -> MutexGuard<'_, KnownKey> {
        self.shared.known.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

fn parts(key: &str) -> Option<(&str, &str)> {
    key.strip_prefix(PREFIX)?.strip_prefix('_')?.split_once('_')
}

fn matches(hash: &str, secret: &str) -> bool {
    let hash = PasswordHash::new(hash);
    hash.is_ok_and(|hash| Argon2::default().verify_password(secret.as_bytes(), &hash).is_ok())
}

/// Lets a request pass that shows a key, or that needs none.
pub(super) async fn check(State(app): State<App>, request: Request, next: Next) -> Response {
    let presented = presented(request.headers()).map(str::to_owned);
    match app.keys().check(presented.as_deref()).await {
        Ok(()) => next.run(request).await,
        Err(refused) => {
            counter!(names::AUTH_REFUSED).increment(1);
            refused.into_response()
        }
    }
}

/// The key that a request shows.
fn presented(headers: &HeaderMap) -> Option<&str> {
    let bearer = headers.get(header::AUTHORIZATION).and_then(|value| value.to_str().ok());
    let bearer = bearer.and_then(|value| value.split_once(' '));
    let bearer = bearer.filter(|(scheme, _)| scheme.eq_ignore_ascii_case("bearer"));
    let protocols = headers.get(header::SEC_WEBSOCKET_PROTOCOL);
    let protocols = protocols.and_then(|value| value.to_str().ok()).unwrap_or_default();
    let mut offered = protocols.split(',').map(str::trim);
    bearer
        .map(|(_, key)| key.trim())
        .or_else(|| offered.find_map(|protocol| protocol.strip_prefix(SUBPROTOCOL_PREFIX)))
}

#[cfg(test)]
mod tests {
    use axum::http::HeaderValue;

    use super::*;

    #[test]
    fn a_new_key_matches_its_hash_and_no_other() {
        let (one, other) = (NewKey::generate().unwrap(), NewKey::generate().unwrap());
        let (id, secret) = parts(&one.text).unwrap();
        assert_eq!(id, one.id);
        assert!(matches(&one.hash, secret));
        assert!(!matches(&other.hash, secret) && !matches("no hash", secret));
        assert!(!one.hash.contains(secret));
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
