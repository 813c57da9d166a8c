//! The audit trail: who changed what and when.

use tracing::{info, warn};

use super::database::DatabaseRow;
use super::{Store, StoreError, unix_s};

/// Who changes something on the command line.
pub const COMMAND_LINE: &str = "command line";
/// How many rows are kept; the oldest are deleted.
const MAX_ROWS: i64 = 100_000;

/// A change of state.
#[derive(Clone, Debug, PartialEq)]
pub struct AuditRow {
    /// Its number, from 1.
    pub number: i64,
    /// When, in seconds since 1970.
    pub time_s: f64,
    /// The id of an API key, `anonymous` or [`COMMAND_LINE`].
    pub who: String,
    /// The name of that key.
    pub name: Option<String>,
    /// What was done, for example `job.create`.
    pub action: String,
    /// To what, for example `job-7`.
    pub target: String,
}

impl Store {
    /// Records a change that was made, in the log and in the database. If the database fails, the log says so.
    pub async fn record_change(&self, who: &str, action: &str, target: &str) {
        info!(
            audit.who = who,
            audit.action = action,
            audit.target = target,
            "state changed"
        );
        if let Err(error) = self.write_audit(who, action, target).await {
            warn!(%error, action, target, "could not write to the audit trail");
        }
    }

    async fn write_audit(&self, who: &str, action: &str, target: &str) -> Result<(), StoreError> {
        let mut tx = self.database.begin().await?;
        // Locked until the commit, so that the numbers are in the order of the commits.
        tx.execute("UPDATE counters SET value = value + 1 WHERE name = 'audit'", vec![])
            .await?;
        let sql = "INSERT INTO audit (number, time_s, who, action, target) \
             SELECT value, $1, $2, $3, $4 FROM counters WHERE name = 'audit'";
        let values = vec![unix_s().into(), who.into(), action.into(), target.into()];
        tx.execute(sql, values).await?;
        let sql = "DELETE FROM audit WHERE number <= (SELECT value FROM counters WHERE name = 'audit') - $1";
        tx.execute(sql, vec![MAX_ROWS.into()]).await?;
        tx.commit().await
    }

    /// The changes before a number, the newest first. Errors: `Query`.
    pub async fn audit(&self, before: Option<i64>, limit: i64) -> Result<Vec<AuditRow>, StoreError> {
        let sql = "SELECT audit.*, api_keys.name AS name FROM audit LEFT JOIN api_keys ON api_keys.id = audit.who \
             WHERE CAST($1 AS BIGINT) IS NULL OR number < $1 ORDER BY number DESC LIMIT $2";
        let rows = self.database.fetch(sql, vec![before.into(), limit.into()]).await?;
        let row = |row: &DatabaseRow| {
            Ok(AuditRow {
                number: row.get("number")?,
                time_s: row.get("time_s")?,
                who: row.get("who")?,
                name: row.get("name")?,
                action: row.get("action")?,
                target: row.get("target")?,
            })
        };
        rows.iter().map(row).collect()
    }
}
