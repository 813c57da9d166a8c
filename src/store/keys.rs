//! The API keys: who may call. What is kept of a secret is its hash; this module knows only texts and times.

use super::database::DatabaseRow;
use super::{Store, StoreError};

/// A key as it is kept.
#[derive(Clone, Debug, PartialEq)]
pub struct KeyRow {
    /// Its public part.
    pub id: String,
    /// What a person called it.
    pub name: String,
    /// The hash of its secret part.
    pub hash: String,
    /// When it was made, in seconds since 1970.
    pub created_s: f64,
    /// Since when it is not taken any more, in seconds since 1970.
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
    /// Adds a key. Errors: `Query`, also if the id is taken.
    pub async fn create_key(&self, id: &str, name: &str, hash: &str, created_s: f64) -> Result<(), StoreError> {
        let sql = "INSERT INTO api_keys (id, name, hash, created_s) VALUES ($1, $2, $3, $4)";
        let values = vec![id.into(), name.into(), hash.into(), created_s.into()];
        self.database.execute(sql, values).await.map(drop)
    }

    /// Every key, revoked ones too, the oldest first. Errors: `Query`.
    pub async fn list_keys(&self) -> Result<Vec<KeyRow>, StoreError> {
        let sql = "SELECT * FROM api_keys ORDER BY created_s, id";
        let rows = self.database.fetch(sql, vec![]).await?;
        rows.iter().map(KeyRow::of).collect()
    }

    /// A key, revoked or not, if it is there. Errors: `Query`.
    pub async fn find_key(&self, id: &str) -> Result<Option<KeyRow>, StoreError> {
        let sql = "SELECT * FROM api_keys WHERE id = $1";
        let rows = self.database.fetch(sql, vec![id.into()]).await?;
        rows.first().map(KeyRow::of).transpose()
    }

    /// Revokes a key; says whether there was one that was not revoked. Errors: `Query`.
    pub async fn revoke_key(&self, id: &str, now_s: f64) -> Result<bool, StoreError> {
        let sql = "UPDATE api_keys SET revoked_s = $2 WHERE id = $1 AND revoked_s IS NULL";
        let changed = self.database.execute(sql, vec![id.into(), now_s.into()]).await?;
        Ok(changed > 0)
    }
}
