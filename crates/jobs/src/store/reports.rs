//! The reports of running jobs: a bounded log, and the loss curves of trainings.

use serde::{Deserialize, Serialize};

use super::database::{Tx, read_all, values};
use super::job_id::JobId;
use super::{Store, StoreError};

/// A point of the loss curves.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[schema(as = CurvePoint)]
pub struct LossRow {
    /// `pretrain` or `sequence`.
    pub stage: String,
    /// Optimizer steps in that stage.
    pub step: i64,
    /// Loss on the training windows of that step.
    pub train: Option<f64>,
    /// Loss on the validation windows, if it was computed.
    pub validation: Option<f64>,
}

/// A line of a job's log.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[schema(as = LogLine)]
pub struct LogRow {
    /// The number of the line, from 1. The oldest lines are removed.
    pub seq: i64,
    /// Time in seconds since 1970.
    #[schema(rename = "unix_s")]
    #[serde(rename(serialize = "unix_s"))]
    pub time_s: f64,
    /// What happened.
    pub line: String,
}

/// What a running job writes to the store at one time.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct JobReport {
    /// Its progress, as JSON.
    pub progress: String,
    /// New lines of its log: time in seconds since 1970, and text.
    pub lines: Vec<(f64, String)>,
    /// New points of its curves; they replace existing points of the same step.
    pub losses: Vec<LossRow>,
    /// How many lines of its log are kept.
    pub max_lines: i64,
    /// How many units of work are saved; a smaller number than before changes nothing.
    pub checkpoint: i64,
}

impl Store {
    /// The lines of a job's log after line number `after`, the oldest first. Errors: `Query`.
    pub async fn job_log(&self, id: JobId, after: i64, limit: i64) -> Result<Vec<LogRow>, StoreError> {
        let sql = "SELECT * FROM job_logs WHERE job = $1 AND seq > $2 ORDER BY seq LIMIT $3";
        read_all(self.database.fetch(sql, values![id, after, limit]).await?)
    }

    /// The points of a job's loss curves, in the order of the training. Errors: `Query`.
    pub async fn job_losses(&self, id: JobId) -> Result<Vec<LossRow>, StoreError> {
        let sql = "SELECT * FROM job_losses WHERE job = $1 ORDER BY stage, step";
        read_all(self.database.fetch(sql, values![id]).await?)
    }
}

/// Writes the report in the transaction that has checked the lease.
pub(super) async fn write_report(tx: &mut Tx, id: JobId, report: JobReport) -> Result<(), StoreError> {
    let has_lines = !report.lines.is_empty();
    for (time_s, line) in report.lines {
        let sql = "INSERT INTO job_logs (job, seq, time_s, line) \
             SELECT $1, COALESCE(MAX(seq), 0) + 1, $2, $3 FROM job_logs WHERE job = $1";
        tx.execute(sql, values![id, time_s, line]).await?;
    }
    if has_lines {
        let sql = "DELETE FROM job_logs WHERE job = $1 AND \
             seq <= (SELECT MAX(seq) FROM job_logs WHERE job = $1) - $2";
        tx.execute(sql, values![id, report.max_lines]).await?;
    }
    for point in report.losses {
        let sql = "INSERT INTO job_losses (job, stage, step, train, validation) VALUES ($1, $2, $3, $4, $5) \
             ON CONFLICT (job, stage, step) DO UPDATE SET train = excluded.train, validation = excluded.validation";
        let values = values![id, point.stage, point.step, point.train, point.validation];
        tx.execute(sql, values).await?;
    }
    Ok(())
}
