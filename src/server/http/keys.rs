//! API keys: how they are made, and which requests they allow.

use std::borrow::Cow;
use std::collections::HashMap;
use std::convert::Infallible;
use std::sync::Arc;
use std::time::{Duration, Instant};

use axum::extract::{Request, State};
use axum::http::{HeaderMap, header};
use axum::middleware::Next;
use axum::response::Response;
use base64::Engine as _;
use base64::engine::general_purpose::{STANDARD, URL_SAFE_NO_PAD};
use metrics::counter;
use tokio::sync::watch;
use tracing::warn;

use super::access::{required_scope, route};
use super::problem::ApiError;
use super::rate::RateLimit;
use crate::server::token::{RandomError, TokenHash};
use foreframe_core::files::hex;
use foreframe_core::metric_names;
use foreframe_jobs::store::{Author, KeyRow, KeyScope, Store, StoreError};

/// The beginning of every key, so that leaked keys are easy to find.
const PREFIX: &str = "ffk";
/// A browser cannot set headers of a WebSocket. It can offer the key as a sub-protocol with this prefix.
const SUBPROTOCOL_PREFIX: &str = "foreframe.key.";
/// `Api-Key` is what openpi's clients send.
const SCHEMES: [&str; 2] = ["bearer", "api-key"];
/// The scheme of an address with a password, which is the key: for clients that cannot set headers.
const BASIC: &str = "basic";
const ID_BYTES: usize = 6;
const SECRET_BYTES: usize = 32;

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
    /// A random key. Errors: the system gave no random bytes.
    pub fn generate() -> Result<Self, RandomError> {
        let (mut id, mut secret) = ([0; ID_BYTES], [0; SECRET_BYTES]);
        getrandom::fill(&mut id)?;
        getrandom::fill(&mut secret)?;
        let id = hex(&id);
        let text = format!("{PREFIX}_{id}_{}", URL_SAFE_NO_PAD.encode(secret));
        let hash = TokenHash::of(&text).to_hex();
        Ok(Self { id, text, hash })
    }
}

/// Who sent a request: the key that it presented, or nobody if authentication was off.
#[derive(Clone, Copy, Debug, Default)]
pub(in crate::server) struct Caller {
    key: Option<TokenHash>,
    is_admin: bool,
}

impl Caller {
    /// Whether this caller may use what another caller created. Anyone may use what was created without a key.
    pub(in crate::server) fn may_use(self, maker: Self) -> bool {
        maker.key.is_none() || maker.key == self.key
    }

    /// Whether this caller has the same key as another one; never without a key.
    pub(in crate::server) fn has_key_of(self, other: Self) -> bool {
        self.key.is_some() && self.key == other.key
    }

    /// Whether this caller may see what another caller created: its own, and with the scope `admin` everything.
    pub(in crate::server) fn may_see(self, maker: Self) -> bool {
        self.is_admin || self.may_use(maker)
    }
}

/// Who may call; clones share it.
#[derive(Clone)]
pub struct Keys {
    store: Option<Store>,
    is_required: bool,
    known: watch::Sender<KnownKeys>,
}

struct KnownKeys {
    /// The keys that were not revoked or expired when they were read.
    valid: HashMap<TokenHash, Arc<KnownKey>>,
    /// Whether the store has any key, revoked or not.
    exist: bool,
    /// The store's clock when they were read, and when that was: this machine's clock can be wrong, and can jump.
    read_s: f64,
    read_at: Instant,
}

/// A key and what was used of its rate.
struct KnownKey {
    row: KeyRow,
    rate: Option<RateLimit>,
}

impl KnownKey {
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
        let known = KnownKeys {
            valid: HashMap::new(),
            exist: false,
            read_s: 0.0,
            read_at: Instant::now(),
        };
        Self {
            store,
            is_required,
            known: watch::Sender::new(known),
        }
    }

    /// How many are valid.
    #[must_use]
    pub fn count(&self) -> usize {
        self.known.borrow().valid.len()
    }

    /// Reads the keys again: adds new ones and drops revoked ones. Errors: `Query`; then the keys stay as they were.
    pub async fn refresh(&self) -> Result<(), StoreError> {
        let Some(store) = &self.store else { return Ok(()) };
        let mut rows = store.list_keys().await?;
        let exist = !rows.is_empty() || store.keys_were_created();
        let (read_s, read_at) = (store.now_s().await?, Instant::now());
        rows.retain(|row| row.is_valid(read_s));
        self.known.send_modify(|known| {
            let mut valid = HashMap::new();
            for row in rows {
                let Some(hash) = TokenHash::from_hex(&row.hash) else {
                    continue;
                };
                // A key that has not changed keeps what was used of its rate.
                let before = known.valid.get(&hash).filter(|before| before.row == row).cloned();
                let fresh = || {
                    let rate = row.requests_per_s.map(|per_s| RateLimit::new(per_s, read_at));
                    Arc::new(KnownKey { row, rate })
                };
                valid.insert(hash, before.unwrap_or_else(fresh));
            }
            *known = KnownKeys {
                valid,
                exist,
                read_s,
                read_at,
            };
        });
        Ok(())
    }

    /// Completes when the caller's key is no longer valid; never for a caller without a key.
    pub(in crate::server) async fn revoked(&self, caller: Caller) {
        let Some(key) = caller.key else {
            return std::future::pending().await;
        };
        // The sender lives as long as these keys.
        let _ = self
            .known
            .subscribe()
            .wait_for(|known| !known.valid.contains_key(&key))
            .await;
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
        self.is_required || self.known.borrow().exist
    }

    /// As [`Keys::check`], with the key that a request presents; counts those without a valid one.
    pub(in crate::server) fn admit(&self, headers: &HeaderMap, needed: KeyScope) -> Result<(Caller, Author), ApiError> {
        let checked = self.check(presented(headers).as_deref(), needed);
        checked.inspect_err(|error| {
            if let ApiError::Unauthorized(_) = error {
                counter!(metric_names::AUTH_REFUSED).increment(1);
            }
        })
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
        let (keys, hash) = (self.known.borrow(), TokenHash::of(key));
        let known = keys.valid.get(&hash).ok_or(ApiError::Unauthorized(
            "the API key is not valid: it is unknown, was revoked or has expired",
        ))?;
        known.check(needed, keys.read_s + keys.read_at.elapsed().as_secs_f64())?;
        let caller = Caller {
            key: Some(hash),
            is_admin: known.row.scope == KeyScope::Admin,
        };
        Ok((caller, Author::of_key(&known.row.id)))
    }
}

/// Refuses a request without a key that allows it, if authentication is on. Others get their [`Caller`] and [`Author`] as
/// extensions.
pub(in crate::server) async fn check(
    State(keys): State<Keys>,
    mut request: Request,
    next: Next,
) -> Result<Response, ApiError> {
    let needed = required_scope(request.method(), route(&request));
    let (caller, author) = keys.admit(request.headers(), needed)?;
    request.extensions_mut().insert(caller);
    request.extensions_mut().insert(author);
    Ok(next.run(request).await)
}

/// The key that a request presents.
fn presented(headers: &HeaderMap) -> Option<Cow<'_, str>> {
    let authorization = headers.get(header::AUTHORIZATION).and_then(|value| value.to_str().ok());
    let (scheme, value) = authorization
        .and_then(|value| value.split_once(' '))
        .unwrap_or_default();
    let is = |known: &&str| scheme.eq_ignore_ascii_case(known);
    if SCHEMES.iter().any(is) {
        return Some(Cow::Borrowed(value.trim()));
    }
    if is(&BASIC) {
        let credentials = String::from_utf8(STANDARD.decode(value.trim()).ok()?).ok()?;
        let (_, password) = credentials.split_once(':')?;
        return Some(Cow::Owned(password.to_owned()));
    }
    let protocols = headers.get(header::SEC_WEBSOCKET_PROTOCOL);
    let protocols = protocols.and_then(|value| value.to_str().ok()).unwrap_or("");
    let mut offered = protocols.split(',').map(str::trim);
    offered
        .find_map(|protocol| protocol.strip_prefix(SUBPROTOCOL_PREFIX))
        .map(Cow::Borrowed)
}

#[cfg(test)]
mod tests {
    use axum::http::HeaderValue;

    use super::*;

    #[test]
    fn a_new_key_matches_its_hash_and_no_other() {
        let (one, other) = (NewKey::generate().unwrap(), NewKey::generate().unwrap());
        assert!(one.text.starts_with(&format!("ffk_{}_", one.id)));
        assert!(TokenHash::from_hex(&one.hash) == Some(TokenHash::of(&one.text)));
        assert!(TokenHash::from_hex(&other.hash) != Some(TokenHash::of(&one.text)));
    }

    #[test]
    fn a_hash_of_an_older_version_is_not_accepted() {
        assert!(TokenHash::from_hex("$argon2id$v=19$m=19456,t=2,p=1$c2FsdA$aGFzaA").is_none());
    }

    #[test]
    fn a_key_is_found_in_either_header() {
        let with = |name, value| HeaderMap::from_iter([(name, HeaderValue::from_static(value))]);
        for authorization in ["bearer abc", "Api-Key abc", "Basic cm9ib3Q6YWJj"] {
            assert_eq!(
                presented(&with(header::AUTHORIZATION, authorization)).as_deref(),
                Some("abc")
            );
        }
        assert_eq!(presented(&with(header::AUTHORIZATION, "Basic abc")), None);
        let offered = "foreframe.v1.json, foreframe.key.abc";
        assert_eq!(
            presented(&with(header::SEC_WEBSOCKET_PROTOCOL, offered)).as_deref(),
            Some("abc")
        );
        assert_eq!(presented(&HeaderMap::new()), None);
    }
}
