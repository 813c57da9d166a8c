//! The API keys. Only the hash of each secret is stored.

use serde::Deserialize;

use super::audit::Author;
use super::database::{Tx, read_all, values};
use super::{Store, StoreError};
use foreframe_core::named_enum;

named_enum! {
    /// What a key allows. Each scope includes those before it.
    #[derive(PartialOrd, Ord, Deserialize)]
    #[serde(rename_all = "lowercase")]
    pub enum KeyScope {
        /// Predictions, sessions, streams and environments; reading the models.
        Predict = "predict",
        /// Also jobs and data sets.
        Jobs = "jobs",
        /// Also activating and deleting versions, deleting data sets, and the audit trail.
        Admin = "admin",
    }
    else |text| -> String { format!("there is no scope {text:?}; there are: {}", Self::ALL.map(Self::name).join(", ")) }
}

/// The row of an API key.
#[derive(Clone, Debug, PartialEq, Deserialize)]
pub struct KeyRow {
    /// Its public part.
    pub id: String,
    /// The name that its creator gave it.
    pub name: String,
    /// The hash of its secret part.
    pub hash: String,
    /// When it was created, in seconds since 1970.
    pub created_s: f64,
    /// When it was revoked, in seconds since 1970.
    pub revoked_s: Option<f64>,
    /// What it allows.
    pub scope: KeyScope,
    /// Until when it is valid, in seconds since 1970.
    pub expires_s: Option<f64>,
    /// The maximum number of requests a second.
    pub requests_per_s: Option<f64>,
}

impl KeyRow {
    /// Whether requests with it are accepted at that time.
    #[must_use]
    pub fn is_valid(&self, now_s: f64) -> bool {
        self.revoked_s.is_none() && self.expires_s.is_none_or(|expires_s| now_s < expires_s)
    }
}

impl Store {
    /// Adds a key. Errors: `Query`, also if the id exists.
    pub async fn add_key(&self, key: KeyRow, by: &Author) -> Result<(), StoreError> {
        self.insert_key(self.database.begin().await?, key, by).await
    }

    /// Adds a key if none was added before, revoked ones included. Returns whether it did: of several servers that start at once, one
    /// does. Errors: `Query`.
    pub async fn add_first_key(&self, key: KeyRow, by: &Author) -> Result<bool, StoreError> {
        let mut tx = self.database.begin().await?;
        tx.lock_numbers().await?;
        let is_first = tx.fetch("SELECT id FROM api_keys LIMIT 1", values![]).await?.is_empty();
        if is_first {
            self.insert_key(tx, key, by).await?;
        }
        Ok(is_first)
    }

    async fn insert_key(&self, mut tx: Tx, key: KeyRow, by: &Author) -> Result<(), StoreError> {
        self.mark_keys_created()?;
        let sql = "INSERT INTO api_keys (id, name, hash, created_s, scope, expires_s, requests_per_s) \
             VALUES ($1, $2, $3, $4, $5, $6, $7)";
        let change = by.change("key.create", key.id.as_str());
        let (scope, expires_s) = (key.scope.name(), key.expires_s);
        let values = values![
            key.id,
            key.name,
            key.hash,
            key.created_s,
            scope,
            expires_s,
            key.requests_per_s
        ];
        tx.execute(sql, values).await?;
        change.commit(tx).await
    }

    /// All keys, also revoked ones, the oldest first. Errors: `Query`.
    pub async fn list_keys(&self) -> Result<Vec<KeyRow>, StoreError> {
        let sql = "SELECT * FROM api_keys ORDER BY created_s, id";
        let rows = self.database.fetch(sql, values![]).await?;
        // Also of keys that another machine or an older program created.
        if !rows.is_empty() {
            self.mark_keys_created()?;
        }
        read_all(rows)
    }

    /// Revokes a key. Returns false if there is no such key or it was already revoked. Errors: `Query`.
    pub async fn revoke_key(&self, id: &str, now_s: f64, by: &Author) -> Result<bool, StoreError> {
        let sql = "UPDATE api_keys SET revoked_s = $2 WHERE id = $1 AND revoked_s IS NULL";
        let change = by.change("key.revoke", id);
        self.execute_recorded(sql, values![id, now_s], change).await
    }
}
