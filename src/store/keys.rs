//! The API keys. Only the hash of each secret is stored.

use super::database::DatabaseRow;
use super::{Store, StoreError};

/// The row of an API key.
#[derive(Clone, Debug, PartialEq)]
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
}

impl KeyRow {
    fn of(row: &DatabaseRow) -> Result<Self, StoreError> {
        Ok(Self {
            id: row.get("id")?,
            name: row.get("name")?,
            hash: row.get("hash")?,
            created_s: row.get("created_s")?,
            revoked_s: row.get("revoked_s")?,
        })
    }
}

impl Store {
    /// Adds a key. Errors: `Query`, also if the id exists.
    pub async fn create_key(&self, id: &str, name: &str, hash: &str, created_s: f64) -> Result<(), StoreError> {
        self.mark_keys_created()?;
        let sql = "INSERT INTO api_keys (id, name, hash, created_s) VALUES ($1, $2, $3, $4)";
        let values = vec![id.into(), name.into(), hash.into(), created_s.into()];
        self.database.execute(sql, values).await.map(drop)
    }

    /// All keys, also revoked ones, the oldest first. Errors: `Query`.
    pub async fn list_keys(&self) -> Result<Vec<KeyRow>, StoreError> {
        let sql = "SELECT * FROM api_keys ORDER BY created_s, id";
        let rows = self.database.fetch(sql, vec![]).await?;
        // Also of keys that another machine or an older program created.
        if !rows.is_empty() {
            self.mark_keys_created()?;
        }
        rows.iter().map(KeyRow::of).collect()
    }

    /// A key, revoked or not. Errors: `Query`.
    pub async fn find_key(&self, id: &str) -> Result<Option<KeyRow>, StoreError> {
        let sql = "SELECT * FROM api_keys WHERE id = $1";
        let rows = self.database.fetch(sql, vec![id.into()]).await?;
        rows.first().map(KeyRow::of).transpose()
    }

    /// Revokes a key. Returns false if there is no such key or it was already revoked. Errors: `Query`.
    pub async fn revoke_key(&self, id: &str, now_s: f64) -> Result<bool, StoreError> {
        let sql = "UPDATE api_keys SET revoked_s = $2 WHERE id = $1 AND revoked_s IS NULL";
        let changed = self.database.execute(sql, vec![id.into(), now_s.into()]).await?;
        Ok(changed > 0)
    }
}
