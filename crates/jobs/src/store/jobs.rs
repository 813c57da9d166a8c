//! The rows of jobs: enqueue, claim under a lease, report, end.
//!
//! A lease expires unless it is renewed. Each claim increments the row's fencing token, and every write names the token of
//! its claim. So a worker whose lease expired cannot write any more.

use super::audit::Author;
use super::database::{DatabaseRow, Tx, read_all, values};
use super::job_id::JobId;
use super::job_rows::{EnqueueResult, JobCount, JobOutcome, JobPage, JobRow, NewJob};
use super::lease::Lease;
use super::models::{PublishedVersion, version_id};
use super::parts;
use super::reports::{JobReport, write_report};
use super::{Store, StoreError};

/// All columns of jobs, with the number of their parts in each state.
macro_rules! select_jobs {
    ($condition:literal) => {
        concat!(
            "SELECT jobs.*, (SELECT COUNT(*) FROM jobs AS part WHERE part.parent = jobs.number) AS parts, \
             (SELECT COUNT(*) FROM jobs AS part WHERE part.parent = jobs.number AND part.state = 'succeeded') AS parts_done, \
             (SELECT COUNT(*) FROM jobs AS part WHERE part.parent = jobs.number AND part.state = 'running') AS parts_running, \
             (SELECT COUNT(*) FROM jobs AS part WHERE part.parent = jobs.number \
             AND part.state IN ('failed', 'cancelled')) AS parts_failed FROM jobs WHERE ",
            $condition
        )
    };
}

fn id_of(row: &DatabaseRow) -> Result<JobId, StoreError> {
    row.get("number").map(JobId::new)
}

/// Checks that the queue and the submitter's share of it have room, and that no queued or running job has the same output. A job
/// counts once, however many parts it has.
async fn check_capacity(
    tx: &mut Tx,
    makes: Option<String>,
    submitter: &str,
    max_queued: i64,
    now_s: f64,
) -> Result<Option<EnqueueResult>, StoreError> {
    // In SQL nothing equals NULL, so a job without an exclusive output never conflicts.
    let sql = "SELECT number FROM jobs WHERE makes = $1 AND state IN ('queued', 'running')";
    if tx.first(sql, values![makes]).await?.is_some() {
        return Ok(Some(EnqueueResult::Taken));
    }
    let sql = "SELECT number FROM jobs WHERE state = 'queued' AND parent IS NULL";
    if tx.fetch(sql, values![]).await?.len() as i64 >= max_queued {
        return Ok(Some(EnqueueResult::Full));
    }
    if submitter.is_empty() {
        return Ok(None);
    }
    let sql = "SELECT COUNT(*) AS keys, (SELECT COUNT(*) FROM jobs WHERE submitter = $1 AND state = 'queued' AND parent IS NULL) AS queued \
         FROM api_keys WHERE revoked_s IS NULL AND scope <> 'predict' AND (expires_s IS NULL OR expires_s > $2)";
    let Some(row) = tx.first(sql, values![submitter, now_s]).await? else {
        return Ok(None);
    };
    let (keys, queued): (i64, i64) = (row.get("keys")?, row.get("queued")?);
    // Equal shares of all keys that can submit jobs, rounded up.
    let share = (max_queued + keys - 1) / keys.max(1);
    Ok((queued >= share.max(1)).then_some(EnqueueResult::ShareFull(share.max(1))))
}

impl Store {
    /// Enqueues a job with its parts unless the queue is full. `now_s`: see [`Store::now_s`]. Errors: `Query`.
    pub async fn enqueue(&self, new: NewJob, max_queued: i64, now_s: f64) -> Result<EnqueueResult, StoreError> {
        let mut tx = self.database.begin().await?;
        tx.lock_numbers().await?;
        if let Some(key) = &new.idempotency_key {
            let sql = "SELECT * FROM jobs WHERE idempotency_key = $1";
            if let Some(row) = tx.first(sql, values![key.as_str()]).await? {
                return row.read().map(EnqueueResult::Same);
            }
        }
        let output = new.exclusive_output.clone();
        if let Some(refused) = check_capacity(&mut tx, output, &new.submitter, max_queued, now_s).await? {
            return Ok(refused);
        }
        let sql = "UPDATE counters SET value = value + 1 WHERE name = 'job'";
        tx.execute(sql, values![]).await?;
        let sql = "INSERT INTO jobs (number, kind, makes, state, spec, progress, idempotency_key, queued_s, submitter, after_job) \
             SELECT value, $1, $2, 'queued', $3, $4, $5, $6, $7, $8 FROM counters WHERE name = 'job' RETURNING *";
        let (output, key) = (new.exclusive_output, new.idempotency_key);
        let after = new.after.map(JobId::number);
        let values = values![
            new.kind,
            output,
            new.spec,
            new.progress,
            key,
            now_s,
            new.submitter,
            after
        ];
        let row = tx.first(sql, values).await?;
        let row: JobRow = row.ok_or(StoreError::Query(sqlx::Error::RowNotFound))?.read()?;
        parts::enqueue(&mut tx, row.id, new.parts).await?;
        let change = Author::of_key(&row.submitter).change("job.create", row.id);
        change.commit(tx).await?;
        Ok(EnqueueResult::New(row))
    }

    /// Enqueues a failed or cancelled job again, with those of its parts that failed or were cancelled; `None` if it is neither.
    /// Errors: `Query`.
    pub async fn requeue(&self, id: JobId, max_queued: i64, by: &Author) -> Result<Option<EnqueueResult>, StoreError> {
        let now_s = self.database.now_s().await?;
        let mut tx = self.database.begin().await?;
        tx.lock_numbers().await?;
        let sql = "SELECT makes, submitter FROM jobs WHERE number = $1 AND state IN ('failed', 'cancelled')";
        let Some(row) = tx.first(sql, values![id]).await? else {
            return Ok(None);
        };
        if parts::are_stopping(&mut tx, id).await? {
            return Ok(Some(EnqueueResult::PartsStopping));
        }
        let submitter: String = row.get("submitter")?;
        if let Some(refused) = check_capacity(&mut tx, row.get("makes")?, &submitter, max_queued, now_s).await? {
            return Ok(Some(refused));
        }
        let sql = "UPDATE jobs SET state = 'queued', error = NULL, ended_s = NULL, cancelling = 0, owner = NULL, \
             stalled_attempts = 0, lease_until_s = NULL WHERE number = $1 RETURNING *";
        let row = tx.first(sql, values![id]).await?.map(DatabaseRow::read).transpose()?;
        parts::requeue(&mut tx, id).await?;
        by.change("job.resume", id).commit(tx).await?;
        Ok(row.map(EnqueueResult::New))
    }

    /// Deletes all ended jobs except the latest `keep`, with their parts; returns the ids of all. A job stays as long as one that waited
    /// for it has not succeeded, since that one asks how it ended. Errors: `Query`.
    pub async fn forget_ended(&self, keep: i64) -> Result<Vec<JobId>, StoreError> {
        let mut tx = self.database.begin().await?;
        // No job is resumed meanwhile.
        tx.lock_numbers().await?;
        let sql = "WITH old AS (SELECT number FROM jobs WHERE state IN ('succeeded', 'failed', 'cancelled') \
             AND parent IS NULL ORDER BY ended_s DESC, number DESC LIMIT 1000000 OFFSET $1), \
             busy AS (SELECT parent AS number FROM jobs WHERE parent IS NOT NULL AND state IN ('queued', 'running') \
             UNION SELECT after_job FROM jobs WHERE after_job IS NOT NULL AND state <> 'succeeded') \
             DELETE FROM jobs WHERE state IN ('succeeded', 'failed', 'cancelled') \
             AND (number IN (SELECT number FROM old) OR parent IN (SELECT number FROM old)) \
             AND COALESCE(parent, number) NOT IN (SELECT number FROM busy) RETURNING number";
        let rows = tx.fetch(sql, values![keep]).await?;
        let forgotten = rows.iter().map(id_of).collect::<Result<_, _>>()?;
        tx.commit().await?;
        Ok(forgotten)
    }

    /// One job. Errors: `Query`.
    pub async fn job(&self, id: JobId) -> Result<Option<JobRow>, StoreError> {
        let sql = select_jobs!("number = $1");
        self.database.read_first(sql, values![id]).await
    }

    /// The job that was enqueued with that idempotency key. Errors: `Query`.
    pub async fn job_of_key(&self, key: &str) -> Result<Option<JobRow>, StoreError> {
        let sql = select_jobs!("idempotency_key = $1");
        self.database.read_first(sql, values![key]).await
    }

    /// Jobs, the newest first. Errors: `Query`.
    pub async fn jobs(&self, page: JobPage) -> Result<Vec<JobRow>, StoreError> {
        let sql = select_jobs!(
            "(CAST($1 AS TEXT) IS NULL OR kind = $1) \
             AND (CAST($2 AS TEXT) IS NULL OR state = $2) AND (CAST($3 AS BIGINT) IS NULL OR number < $3) \
             AND (parent = $5 OR (CAST($5 AS BIGINT) IS NULL AND parent IS NULL)) ORDER BY number DESC LIMIT $4"
        );
        let (before, part_of) = (page.before.map(JobId::number), page.part_of.map(JobId::number));
        let values = values![page.kind, page.state, before, page.limit, part_of];
        read_all(self.database.fetch(sql, values).await?)
    }

    /// The parts of a job, in their order. Errors: `Query`.
    pub async fn parts(&self, of: JobId) -> Result<Vec<JobRow>, StoreError> {
        let sql = "SELECT * FROM jobs WHERE parent = $1 ORDER BY number";
        read_all(self.database.fetch(sql, values![of]).await?)
    }

    /// All queued and running jobs and parts. Errors: `Query`.
    pub async fn open_jobs(&self) -> Result<Vec<JobRow>, StoreError> {
        let sql = "SELECT * FROM jobs WHERE state IN ('queued', 'running') ORDER BY number";
        read_all(self.database.fetch(sql, values![]).await?)
    }

    /// The number of jobs of each kind and state, without zeros. Errors: `Query`.
    pub async fn count_jobs(&self) -> Result<Vec<JobCount>, StoreError> {
        let sql = "SELECT kind, state, COUNT(*) AS jobs FROM jobs GROUP BY kind, state";
        read_all(self.database.fetch(sql, values![]).await?)
    }

    /// Claims a job that is queued, and waits neither for another nor for its parts, or whose lease has expired, by the
    /// database's clock, for `lease_s` seconds. It is the oldest job of the submitter with the fewest running jobs; of several,
    /// of the one whose last job was claimed longest ago.
    /// Errors: `Query`.
    pub async fn claim(&self, owner: &str, lease_s: f64) -> Result<Option<(JobRow, Lease)>, StoreError> {
        let now_s = self.database.now_s().await?;
        self.claim_at(owner, now_s, now_s + lease_s).await
    }

    /// As [`Self::claim`], at a given time. Errors: `Query`.
    pub async fn claim_at(&self, owner: &str, now_s: f64, until_s: f64) -> Result<Option<(JobRow, Lease)>, StoreError> {
        let mut tx = self.database.begin().await?;
        let sql = "SELECT number FROM jobs WHERE (state = 'queued' AND NOT EXISTS (SELECT 1 FROM jobs AS earlier \
             WHERE earlier.number = jobs.after_job AND earlier.state IN ('queued', 'running')) \
             AND NOT EXISTS (SELECT 1 FROM jobs AS part \
             WHERE part.parent = jobs.number AND part.state IN ('queued', 'running'))) \
             OR (state = 'running' AND lease_until_s < $1) ORDER BY \
             (SELECT COUNT(*) FROM jobs AS other WHERE other.submitter = jobs.submitter \
             AND other.state = 'running' AND other.lease_until_s >= $1), \
             (SELECT COALESCE(MAX(other.claimed_s), 0) FROM jobs AS other WHERE other.submitter = jobs.submitter), \
             number LIMIT 1";
        let Some(row) = tx.first_free(sql, values![now_s]).await? else {
            return Ok(None);
        };
        let sql = "UPDATE jobs SET state = 'running', owner = $2, lease_until_s = $3, token = token + 1, \
             claimed_checkpoint = checkpoint, stalled_attempts = CASE \
             WHEN state = 'queued' OR claimed_checkpoint < 0 THEN stalled_attempts WHEN checkpoint > claimed_checkpoint THEN 0 ELSE stalled_attempts + 1 END, \
             started_s = COALESCE(started_s, $4), claimed_s = $4 WHERE number = $1 RETURNING *";
        let row = tx.first(sql, values![id_of(&row)?, owner, until_s, now_s]).await?;
        let row = row.map(DatabaseRow::read::<JobRow>).transpose()?;
        tx.commit().await?;
        Ok(row.map(|row| {
            let (job, token) = (row.id, row.token);
            (row, Lease { job, token })
        }))
    }

    /// Expires all leases of an owner. The caller must know that the owner has ended. Errors: `Query`.
    pub async fn release_leases(&self, owner: &str) -> Result<u64, StoreError> {
        let sql = "UPDATE jobs SET lease_until_s = 0 WHERE state = 'running' AND owner = $1";
        self.database.execute(sql, values![owner]).await
    }

    /// Renews a lease and writes the report. Returns whether the job was asked to stop; if the lease is lost, writes nothing
    /// and returns `None`. Errors: `Query`.
    pub async fn renew(&self, lease: Lease, lease_s: f64, report: JobReport) -> Result<Option<bool>, StoreError> {
        let now_s = self.database.now_s().await?;
        self.renew_at(lease, now_s + lease_s, report).await
    }

    /// As [`Self::renew`], until a given time. Errors: `Query`.
    pub async fn renew_at(&self, lease: Lease, until_s: f64, report: JobReport) -> Result<Option<bool>, StoreError> {
        let mut tx = self.database.begin().await?;
        let sql = "UPDATE jobs SET lease_until_s = $3, progress = $4, \
             checkpoint = CASE WHEN $5 > checkpoint THEN $5 ELSE checkpoint END \
             WHERE number = $1 AND token = $2 AND state = 'running' RETURNING cancelling";
        let progress = report.progress.as_str();
        let values = values![lease.job, lease.token, until_s, progress, report.checkpoint];
        let Some(row) = tx.first(sql, values).await? else {
            return Ok(None);
        };
        let cancelling = row.get::<i64>("cancelling")? != 0;
        write_report(&mut tx, lease.job, report).await?;
        tx.commit().await?;
        Ok(Some(cancelling))
    }

    /// Replaces the specification of a running job. If the lease is lost, writes nothing and returns false. Errors: `Query`.
    pub(crate) async fn set_spec(&self, lease: Lease, spec: &str) -> Result<bool, StoreError> {
        let sql = "UPDATE jobs SET spec = $3 WHERE number = $1 AND token = $2 AND state = 'running'";
        let values = values![lease.job, lease.token, spec];
        Ok(self.database.execute(sql, values).await? > 0)
    }

    /// Does not count the current attempt as one without progress, because its worker is stopping. Errors: `Query`.
    pub async fn excuse_attempt(&self, lease: Lease) -> Result<(), StoreError> {
        let sql = "UPDATE jobs SET claimed_checkpoint = -1 WHERE number = $1 AND token = $2 AND state = 'running'";
        self.database
            .execute(sql, values![lease.job, lease.token])
            .await
            .map(drop)
    }

    /// Writes the outcome of an attempt. If the lease is lost, writes nothing and returns false. Errors: `Query`.
    pub async fn end(&self, lease: Lease, outcome: JobOutcome, report: JobReport) -> Result<bool, StoreError> {
        let mut tx = self.database.begin().await?;
        let sql = "UPDATE jobs SET state = $3, error = $4, outcome = $5, ended_s = $6, progress = $7, \
             cancelling = CASE WHEN $3 = 'queued' THEN cancelling ELSE 0 END, \
             checkpoint = CASE WHEN $8 > checkpoint THEN $8 ELSE checkpoint END, \
             stalled_attempts = CASE WHEN claimed_checkpoint < 0 THEN stalled_attempts \
             WHEN $8 > claimed_checkpoint OR checkpoint > claimed_checkpoint THEN 0 ELSE stalled_attempts + $9 END, \
             owner = NULL, lease_until_s = NULL WHERE number = $1 AND token = $2 AND state = 'running' RETURNING submitter, parent";
        let values = values![
            lease.job,
            lease.token,
            outcome.state,
            outcome.error,
            outcome.outcome,
            outcome.ended_s,
            report.progress.as_str(),
            report.checkpoint,
            i64::from(outcome.crashed)
        ];
        let Some(row) = tx.first(sql, values).await? else {
            return Ok(false);
        };
        let now_s = outcome.ended_s.unwrap_or_default();
        if let Some(measured) = outcome.measured {
            super::models::write_metrics(&mut tx, measured, now_s).await?;
        }
        write_report(&mut tx, lease.job, report).await?;
        let Some(published) = outcome.published else {
            tx.commit().await?;
            return Ok(true);
        };
        // Which version of a sweep becomes active is known when all its parts have ended.
        let published = PublishedVersion {
            activates: published.activates && row.get::<Option<i64>>("parent")?.is_none(),
            ..published
        };
        let is_new = super::models::write_published(&mut tx, &published, now_s).await?;
        if !is_new {
            tx.commit().await?;
            return Ok(true);
        }
        let by = Author::of_key(&row.get::<String>("submitter")?);
        let change = by.change("version.publish", version_id(&published.model, published.version));
        change.commit(tx).await?;
        Ok(true)
    }

    /// Cancels a queued job with its parts. Returns whether it was queued. Errors: `Query`.
    pub async fn cancel_queued(&self, id: JobId, now_s: f64, by: &Author) -> Result<bool, StoreError> {
        let mut tx = self.database.begin().await?;
        let sql = "UPDATE jobs SET state = 'cancelled', ended_s = $2 WHERE number = $1 AND state = 'queued'";
        if tx.execute(sql, values![id, now_s]).await? == 0 {
            return Ok(false);
        }
        parts::cancel(&mut tx, id, now_s).await?;
        by.change("job.cancel", id).commit(tx).await?;
        Ok(true)
    }

    /// Asks a running job to stop, if it was not asked before. Returns whether it is running. Errors: `Query`.
    pub async fn ask_to_cancel(&self, id: JobId, by: &Author) -> Result<bool, StoreError> {
        let sql = "UPDATE jobs SET cancelling = 1 WHERE number = $1 AND state = 'running' AND cancelling = 0";
        let change = by.change("job.cancel", id);
        if self.execute_recorded(sql, values![id], change).await? {
            return Ok(true);
        }
        let sql = "SELECT number FROM jobs WHERE number = $1 AND state = 'running'";
        Ok(self.database.first(sql, values![id]).await?.is_some())
    }
}
