//! The audit trail: who changed what and when.

use serde::{Deserialize, Serialize};
use tracing::info;

use super::database::{Tx, Values, read_all, values};
use super::{Store, StoreError, unix_s};
use foreframe_core::types::DatasetName;

/// How many rows are kept; the oldest are deleted.
const MAX_ROWS: i64 = 100_000;

/// A change of state.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[schema(as = AuditEntry)]
pub struct AuditRow {
    /// Its number, from 1. The oldest are deleted.
    pub number: i64,
    /// When, in seconds since 1970.
    #[schema(rename = "unix_s")]
    #[serde(rename(serialize = "unix_s"))]
    pub time_s: f64,
    /// The id of an API key, `anonymous` (authentication is off) or `command line`.
    pub who: String,
    /// The name of that key.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub name: Option<String>,
    /// `job.create`, `job.cancel`, `job.resume`, `version.publish`, `version.activate`, `version.delete`, `dataset.delete`,
    /// `key.create` or `key.revoke`. The entry of `dataset.delete` is written before the files are deleted; if that fails,
    /// `dataset.delete.failed` follows.
    pub action: String,
    /// The job, the version (`NAME@VERSION`), the data set or the key.
    pub target: String,
}

/// Who makes a change.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Author {
    /// The user of the API key with this id.
    Key(String),
    /// A client of a server without authentication.
    Anonymous,
    /// The user of the command line.
    CommandLine,
}

impl Author {
    /// The user of an API key; without an id, there is no authentication.
    #[must_use]
    pub fn of_key(id: &str) -> Self {
        if id.is_empty() {
            Self::Anonymous
        } else {
            Self::Key(id.to_owned())
        }
    }

    /// The id of the API key; empty without one.
    #[must_use]
    pub fn key_id(&self) -> &str {
        match self {
            Self::Key(id) => id,
            Self::Anonymous | Self::CommandLine => "",
        }
    }

    /// The value of the entry's `who`.
    fn who(&self) -> &str {
        match self {
            Self::Key(id) => id,
            Self::Anonymous => "anonymous",
            Self::CommandLine => "command line",
        }
    }

    pub(super) fn change(&self, action: &'static str, target: impl Into<String>) -> Change {
        Change {
            who: self.who().to_owned(),
            action,
            target: target.into(),
        }
    }
}

/// A change of state, before it is made. It is recorded in the transaction that makes it.
pub(super) struct Change {
    who: String,
    action: &'static str,
    target: String,
}

impl Change {
    /// Adds the change to the audit trail, commits the transaction that makes it, and logs it. Errors: `Query`.
    pub(super) async fn commit(self, mut tx: Tx) -> Result<(), StoreError> {
        let Self { who, action, target } = self;
        // Locked until the commit, so that the numbers are in the order of the commits.
        let sql = "UPDATE counters SET value = value + 1 WHERE name = 'audit'";
        tx.execute(sql, values![]).await?;
        let sql = "INSERT INTO audit (number, time_s, who, action, target) \
             SELECT value, $1, $2, $3, $4 FROM counters WHERE name = 'audit'";
        tx.execute(sql, values![unix_s(), who.as_str(), action, target.as_str()])
            .await?;
        let sql = "DELETE FROM audit WHERE number <= (SELECT value FROM counters WHERE name = 'audit') - $1";
        tx.execute(sql, values![MAX_ROWS]).await?;
        tx.commit().await?;
        info!(
            audit.who = who,
            audit.action = action,
            audit.target = target,
            "state changed"
        );
        Ok(())
    }
}

impl Store {
    /// Executes a statement and, if it changes a row, records the change with it. Returns whether it does. Errors: `Query`.
    pub(super) async fn execute_recorded(
        &self,
        sql: &'static str,
        values: Values,
        change: Change,
    ) -> Result<bool, StoreError> {
        let mut tx = self.database.begin().await?;
        if tx.execute(sql, values).await? == 0 {
            return Ok(false);
        }
        change.commit(tx).await?;
        Ok(true)
    }

    /// Records a deletion of a data set, before its files are deleted: so none is deleted without an entry. Errors: `Query`.
    pub async fn record_dataset_deletion(&self, dataset: &DatasetName, by: &Author) -> Result<(), StoreError> {
        let change = by.change("dataset.delete", dataset.to_string());
        change.commit(self.database.begin().await?).await
    }

    /// Records that the files of a data set could not be deleted, after all. Errors: `Query`.
    pub async fn record_failed_deletion(&self, dataset: &DatasetName, by: &Author) -> Result<(), StoreError> {
        let change = by.change("dataset.delete.failed", dataset.to_string());
        change.commit(self.database.begin().await?).await
    }

    /// The changes before a number, the newest first. Errors: `Query`.
    pub async fn audit(&self, before: Option<i64>, limit: i64) -> Result<Vec<AuditRow>, StoreError> {
        let sql = "SELECT audit.*, api_keys.name AS name FROM audit LEFT JOIN api_keys ON api_keys.id = audit.who \
             WHERE CAST($1 AS BIGINT) IS NULL OR number < $1 ORDER BY number DESC LIMIT $2";
        read_all(self.database.fetch(sql, values![before, limit]).await?)
    }
}
