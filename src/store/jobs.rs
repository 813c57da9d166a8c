//! Jobs as rows: enqueued, taken up under a lease, reported on and ended by whoever holds the lease's token.
//!
//! A lease runs out unless renewed. Each taking up raises the row's token, and every write of a job's work names the
//! token it was given, so that one who was thought dead and comes back writes nothing.

use super::accounts::{JobUpdate, write_account};
use super::database::{DatabaseRow, DatabaseValue, Tx};
use super::{Store, StoreError};

/// A job as it is kept. Structured values are JSON of the one who wrote them.
#[derive(Clone, Debug, PartialEq)]
pub struct JobRow {
    /// Counts the jobs, from 1.
    pub number: i64,
    /// `collect`, `train`, …
    pub kind: String,
    /// `queued`, `running`, `succeeded`, `failed` or `cancelled`.
    pub state: String,
    /// What is to be done.
    pub spec: String,
    /// How far it is.
    pub progress: String,
    /// What came of it.
    pub outcome: Option<String>,
    /// Why it failed.
    pub error: Option<String>,
    /// Whether it was asked to stop and has not yet.
    pub cancelling: bool,
    /// When it was asked for, in seconds since 1970.
    pub queued_s: f64,
    /// When it was taken up first, in seconds since 1970.
    pub started_s: Option<f64>,
    /// When it ended, in seconds since 1970.
    pub ended_s: Option<f64>,
    /// How often it was taken up.
    pub token: i64,
}

impl JobRow {
    fn of(row: &DatabaseRow) -> Result<Self, StoreError> {
        Ok(Self {
            number: row.get("number")?,
            kind: row.get("kind")?,
            state: row.get("state")?,
            spec: row.get("spec")?,
            progress: row.get("progress")?,
            outcome: row.get("outcome")?,
            error: row.get("error")?,
            cancelling: row.get::<i64>("cancelling")? != 0,
            queued_s: row.get("queued_s")?,
            started_s: row.get("started_s")?,
            ended_s: row.get("ended_s")?,
            token: row.get("token")?,
        })
    }
}

/// A job to enqueue.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NewJob {
    /// `collect`, `train`, …
    pub kind: String,
    /// What no other job that has not ended may make.
    pub makes: Option<String>,
    /// What is to be done.
    pub spec: String,
    /// How far a job is that has not begun.
    pub progress: String,
    /// The caller's own name for it: the same key never makes two jobs.
    pub idempotency_key: Option<String>,
}

/// What came of enqueueing.
#[derive(Clone, Debug, PartialEq)]
pub enum EnqueueResult {
    /// It waits.
    New(JobRow),
    /// A job of that idempotency key is there.
    Same(JobRow),
    /// As many wait as may.
    Full,
    /// Another that has not ended makes the same.
    Taken,
}

/// The right to work on a job: its number, and how often it had been taken up then.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Lease {
    /// The job.
    pub number: i64,
    /// The fencing token.
    pub token: i64,
}

/// How a job's work ended.
#[derive(Clone, Debug, PartialEq)]
pub struct JobOutcome {
    /// The state that follows.
    pub state: &'static str,
    /// Why it failed.
    pub error: Option<String>,
    /// What came of it.
    pub outcome: Option<String>,
    /// When, in seconds since 1970; none if it goes back to wait.
    pub ended_s: Option<f64>,
    /// The model's name, version, and whether that serves unless another does already.
    pub published: Option<(String, u32, bool)>,
}

/// Which jobs to list: the newest below a number first.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct JobPage {
    /// Only of that kind.
    pub kind: Option<String>,
    /// Only in that state.
    pub state: Option<String>,
    /// Only below that number.
    pub before: Option<i64>,
    /// At most so many.
    pub limit: i64,
}

/// Takes the lock under which jobs are enqueued.
async fn lock(tx: &mut Tx) -> Result<(), StoreError> {
    let sql = "UPDATE counters SET value = value WHERE name = 'job'";
    tx.execute(sql, vec![]).await.map(drop)
}

/// Whether one more may wait, and none that has not ended makes the same.
async fn has_place(tx: &mut Tx, makes: Option<&str>, max_queued: i64) -> Result<Option<EnqueueResult>, StoreError> {
    // Nothing equals NULL, so that a job that makes nothing of its own is never in another's way.
    let sql = "SELECT number FROM jobs WHERE makes = $1 AND state IN ('queued', 'running')";
    if !tx.fetch(sql, vec![makes.into()]).await?.is_empty() {
        return Ok(Some(EnqueueResult::Taken));
    }
    let queued = tx
        .fetch("SELECT number FROM jobs WHERE state = 'queued'", vec![])
        .await?
        .len();
    Ok((queued as i64 >= max_queued).then_some(EnqueueResult::Full))
}

fn first(rows: &[DatabaseRow]) -> Result<Option<JobRow>, StoreError> {
    rows.first().map(JobRow::of).transpose()
}

impl Store {
    /// Enqueues a job unless as many wait as may. Errors: `Query`.
    pub async fn enqueue(&self, new: NewJob, max_queued: i64, now_s: f64) -> Result<EnqueueResult, StoreError> {
        let mut tx = self.database.begin().await?;
        lock(&mut tx).await?;
        if let Some(key) = &new.idempotency_key {
            let sql = "SELECT * FROM jobs WHERE idempotency_key = $1";
            if let Some(row) = first(&tx.fetch(sql, vec![key.as_str().into()]).await?)? {
                return Ok(EnqueueResult::Same(row));
            }
        }
        if let Some(refused) = has_place(&mut tx, new.makes.as_deref(), max_queued).await? {
            return Ok(refused);
        }
        tx.execute("UPDATE counters SET value = value + 1 WHERE name = 'job'", vec![])
            .await?;
        let sql = "INSERT INTO jobs (number, kind, makes, state, spec, progress, idempotency_key, queued_s) \
             SELECT value, $1, $2, 'queued', $3, $4, $5, $6 FROM counters WHERE name = 'job' RETURNING *";
        let values: Vec<DatabaseValue> = vec![
            new.kind.into(),
            new.makes.into(),
            new.spec.into(),
            new.progress.into(),
            new.idempotency_key.into(),
            now_s.into(),
        ];
        let row = first(&tx.fetch(sql, values).await?)?;
        tx.commit().await?;
        row.map(EnqueueResult::New)
            .ok_or(StoreError::Query(sqlx::Error::RowNotFound))
    }

    /// Puts a job that failed or was cancelled back among those that wait. Errors: `Query`.
    pub async fn requeue(&self, number: i64, max_queued: i64) -> Result<Option<EnqueueResult>, StoreError> {
        let mut tx = self.database.begin().await?;
        lock(&mut tx).await?;
        let sql = "SELECT makes FROM jobs WHERE number = $1 AND state IN ('failed', 'cancelled')";
        let rows = tx.fetch(sql, vec![number.into()]).await?;
        let Some(row) = rows.first() else { return Ok(None) };
        let makes: Option<String> = row.get("makes")?;
        if let Some(refused) = has_place(&mut tx, makes.as_deref(), max_queued).await? {
            return Ok(Some(refused));
        }
        let sql = "UPDATE jobs SET state = 'queued', error = NULL, ended_s = NULL, cancelling = 0, owner = NULL, \
             lease_until_s = NULL WHERE number = $1 RETURNING *";
        let row = first(&tx.fetch(sql, vec![number.into()]).await?)?;
        tx.commit().await?;
        Ok(row.map(EnqueueResult::New))
    }

    /// Forgets ended jobs but the latest `kept`; returns their numbers. Errors: `Query`.
    pub async fn forget_ended(&self, kept: i64) -> Result<Vec<i64>, StoreError> {
        // Both look at the state: one may be resumed between them.
        let sql = "DELETE FROM jobs WHERE state IN ('succeeded', 'failed', 'cancelled') AND number IN (SELECT number \
             FROM jobs WHERE state IN ('succeeded', 'failed', 'cancelled') ORDER BY ended_s DESC, number DESC \
             LIMIT 1000000 OFFSET $1) RETURNING number";
        let rows = self.database.fetch(sql, vec![kept.into()]).await?;
        rows.iter().map(|row| row.get("number")).collect()
    }

    /// One job. Errors: `Query`.
    pub async fn job(&self, number: i64) -> Result<Option<JobRow>, StoreError> {
        let sql = "SELECT * FROM jobs WHERE number = $1";
        first(&self.database.fetch(sql, vec![number.into()]).await?)
    }

    /// The job that was enqueued with that idempotency key. Errors: `Query`.
    pub async fn job_of_key(&self, key: &str) -> Result<Option<JobRow>, StoreError> {
        let sql = "SELECT * FROM jobs WHERE idempotency_key = $1";
        first(&self.database.fetch(sql, vec![key.into()]).await?)
    }

    /// Jobs, the newest first. Errors: `Query`.
    pub async fn jobs(&self, page: JobPage) -> Result<Vec<JobRow>, StoreError> {
        let sql = "SELECT * FROM jobs WHERE (CAST($1 AS TEXT) IS NULL OR kind = $1) \
             AND (CAST($2 AS TEXT) IS NULL OR state = $2) AND (CAST($3 AS BIGINT) IS NULL OR number < $3) \
             ORDER BY number DESC LIMIT $4";
        let values = vec![
            page.kind.into(),
            page.state.into(),
            page.before.into(),
            page.limit.into(),
        ];
        let rows = self.database.fetch(sql, values).await?;
        rows.iter().map(JobRow::of).collect()
    }

    /// How many jobs there are of each kind and state, where there are any. Errors: `Query`.
    pub async fn count_jobs(&self) -> Result<Vec<(String, String, i64)>, StoreError> {
        let sql = "SELECT kind, state, COUNT(*) AS jobs FROM jobs GROUP BY kind, state";
        let rows = self.database.fetch(sql, vec![]).await?;
        rows.iter()
            .map(|row| Ok((row.get("kind")?, row.get("state")?, row.get("jobs")?)))
            .collect()
    }

    /// Takes up the job that has waited longest, or one whose lease has run out. Errors: `Query`.
    pub async fn claim(&self, owner: &str, now_s: f64, until_s: f64) -> Result<Option<(JobRow, Lease)>, StoreError> {
        let mut tx = self.database.begin().await?;
        let sql = "SELECT number FROM jobs WHERE state = 'queued' OR (state = 'running' AND lease_until_s < $1) \
             ORDER BY number LIMIT 1";
        let rows = tx.fetch_free(sql, vec![now_s.into()]).await?;
        let Some(row) = rows.first() else { return Ok(None) };
        let number: i64 = row.get("number")?;
        let sql = "UPDATE jobs SET state = 'running', owner = $2, lease_until_s = $3, token = token + 1, \
             started_s = COALESCE(started_s, $4) WHERE number = $1 RETURNING *";
        let values = vec![number.into(), owner.into(), until_s.into(), now_s.into()];
        let row = first(&tx.fetch(sql, values).await?)?;
        tx.commit().await?;
        Ok(row.map(|row| {
            let lease = Lease {
                number: row.number,
                token: row.token,
            };
            (row, lease)
        }))
    }

    /// Lets every lease of that owner run out now: to be called by one who knows that the owner is dead. Errors: `Query`.
    pub async fn release_leases(&self, owner: &str) -> Result<u64, StoreError> {
        let sql = "UPDATE jobs SET lease_until_s = 0 WHERE state = 'running' AND owner = $1";
        self.database.execute(sql, vec![owner.into()]).await
    }

    /// Renews a lease and writes what happened since; says whether the job was asked to stop, or `None` if the lease is
    /// lost, and then nothing is written. Errors: `Query`.
    pub async fn renew(&self, lease: Lease, until_s: f64, account: JobUpdate) -> Result<Option<bool>, StoreError> {
        let mut tx = self.database.begin().await?;
        let sql = "UPDATE jobs SET lease_until_s = $3, progress = $4 \
             WHERE number = $1 AND token = $2 AND state = 'running' RETURNING cancelling";
        let values = vec![
            lease.number.into(),
            lease.token.into(),
            until_s.into(),
            account.progress.as_str().into(),
        ];
        let rows = tx.fetch(sql, values).await?;
        let Some(row) = rows.first() else { return Ok(None) };
        let cancelling = row.get::<i64>("cancelling")? != 0;
        write_account(&mut tx, lease.number, account).await?;
        tx.commit().await?;
        Ok(Some(cancelling))
    }

    /// Ends a job's work; says whether the lease still held, and writes nothing if not. Errors: `Query`.
    pub async fn end(&self, lease: Lease, ending: JobOutcome, account: JobUpdate) -> Result<bool, StoreError> {
        let mut tx = self.database.begin().await?;
        let sql = "UPDATE jobs SET state = $3, error = $4, outcome = $5, ended_s = $6, progress = $7, \
             cancelling = CASE WHEN $3 = 'queued' THEN cancelling ELSE 0 END, \
             owner = NULL, lease_until_s = NULL WHERE number = $1 AND token = $2 AND state = 'running'";
        let values = vec![
            lease.number.into(),
            lease.token.into(),
            ending.state.into(),
            ending.error.into(),
            ending.outcome.into(),
            ending.ended_s.into(),
            account.progress.as_str().into(),
        ];
        if tx.execute(sql, values).await? == 0 {
            return Ok(false);
        }
        if let Some((model, version, activates)) = ending.published {
            let now_s = ending.ended_s.unwrap_or_default();
            super::models::write_published(&mut tx, (&model, version), activates, now_s).await?;
        }
        write_account(&mut tx, lease.number, account).await?;
        tx.commit().await?;
        Ok(true)
    }

    /// Ends a job that waits. Says whether it did. Errors: `Query`.
    pub async fn cancel_queued(&self, number: i64, now_s: f64) -> Result<bool, StoreError> {
        let sql = "UPDATE jobs SET state = 'cancelled', ended_s = $2 WHERE number = $1 AND state = 'queued'";
        Ok(self.database.execute(sql, vec![number.into(), now_s.into()]).await? > 0)
    }

    /// Asks a job that runs to stop. Says whether it runs. Errors: `Query`.
    pub async fn ask_to_cancel(&self, number: i64) -> Result<bool, StoreError> {
        let sql = "UPDATE jobs SET cancelling = 1 WHERE number = $1 AND state = 'running'";
        Ok(self.database.execute(sql, vec![number.into()]).await? > 0)
    }
}
