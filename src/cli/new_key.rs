//! Makes an API key.

use super::error::CliError;
use crate::server::keys::NewKey;
use foreframe_jobs::store::{Author, KeyRow, KeyScope, Store};

/// What a new key is for, and its limits.
pub(super) struct KeyOrder<'a> {
    pub(super) name: &'a str,
    pub(super) scope: KeyScope,
    /// Seconds for which it is valid; without them, until it is revoked.
    pub(super) valid_s: Option<f64>,
    pub(super) requests_per_s: Option<f64>,
}

/// Stores a new key and returns its text, of which only the hash is kept. Errors: `Failed`.
pub(super) async fn create_key(store: &Store, order: KeyOrder<'_>) -> Result<String, CliError> {
    let (row, text) = new_row(store, order).await?;
    store.add_key(row, &Author::CommandLine).await?;
    Ok(text)
}

/// The same for the first key, which may do everything; `None` if another server was faster. Errors: `Failed`.
pub(super) async fn create_first_key(store: &Store) -> Result<Option<String>, CliError> {
    let order = KeyOrder {
        name: "first",
        scope: KeyScope::Admin,
        valid_s: None,
        requests_per_s: None,
    };
    let (row, text) = new_row(store, order).await?;
    let is_first = store.add_first_key(row, &Author::CommandLine).await?;
    Ok(is_first.then_some(text))
}

/// A key that is not stored yet, and its text.
async fn new_row(store: &Store, order: KeyOrder<'_>) -> Result<(KeyRow, String), CliError> {
    let key = NewKey::generate().map_err(CliError::failed)?;
    let now_s = store.now_s().await?;
    let row = KeyRow {
        id: key.id.clone(),
        name: order.name.to_owned(),
        hash: key.hash,
        created_s: now_s,
        revoked_s: None,
        scope: order.scope,
        expires_s: order.valid_s.map(|seconds| now_s + seconds),
        requests_per_s: order.requests_per_s,
    };
    Ok((row, key.text))
}
