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
    store.add_key(row, &Author::CommandLine).await?;
    Ok(key.text)
}
