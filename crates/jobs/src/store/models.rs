//! The published versions of the models, and which version is active. Their files are in the object store.

use serde::{Deserialize, Serialize};

use super::audit::Author;
use super::database::{DatabaseRow, Tx, read_all, values};
use super::job_id::JobId;
use super::lease::Lease;
use super::{Store, StoreError};
use foreframe_core::types::ModelName;

/// A version that a job published.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct PublishedVersion {
    /// The model's name.
    pub model: ModelName,
    /// The version's number.
    pub version: u32,
    /// Whether it becomes active if no version is.
    pub activates: bool,
}

/// What an evaluation measured of a version.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ModelMetrics {
    /// The model's name.
    pub model: ModelName,
    /// Its version.
    pub version: u32,
    /// The hash of the weights that were measured.
    pub weights_sha256: String,
    /// The metrics, as JSON.
    pub metrics: String,
}

fn version_of(row: &DatabaseRow) -> Result<(ModelName, u32), StoreError> {
    Ok((row.get("model")?, row.get("version")?))
}

impl Store {
    /// Reserves the version that a job publishes: the next number above `shipped`. A second call of the same job returns the
    /// same number. `None` if the lease is lost. Errors: `Query`.
    pub async fn reserve_version(
        &self,
        lease: Lease,
        model: &ModelName,
        shipped: u32,
    ) -> Result<Option<u32>, StoreError> {
        let mut tx = self.database.begin().await?;
        // Held until the commit, so that two jobs never reserve one number.
        let sql = "UPDATE counters SET value = value WHERE name = 'job' \
             AND EXISTS (SELECT 1 FROM jobs WHERE number = $1 AND token = $2 AND state = 'running')";
        if tx.execute(sql, values![lease.job, lease.token]).await? == 0 {
            return Ok(None);
        }
        let sql = "SELECT version FROM model_versions WHERE job = $1";
        if let Some(row) = tx.first(sql, values![lease.job]).await? {
            return row.get("version").map(Some);
        }
        insert_next_version(tx, model, shipped, Some(lease.job)).await.map(Some)
    }

    /// The next version of a name, above `shipped`, for a model that no job trained. Errors: `Query`.
    pub async fn reserve_next_version(&self, model: &ModelName, shipped: u32) -> Result<u32, StoreError> {
        let mut tx = self.database.begin().await?;
        // The row is locked until the commit, so that a number is never given twice.
        tx.lock_numbers().await?;
        insert_next_version(tx, model, shipped, None).await
    }

    /// Records that the files of a reserved version are there. Errors: `Query`.
    pub async fn publish_version(
        &self,
        model: &ModelName,
        version: u32,
        now_s: f64,
        by: &Author,
    ) -> Result<(), StoreError> {
        let sql = "UPDATE model_versions SET published_s = $3 WHERE model = $1 AND version = $2";
        let values = values![model, version, now_s];
        let change = by.change("version.publish", version_id(model, version));
        self.execute_recorded(sql, values, change).await.map(drop)
    }

    /// Forgets which version of a model was chosen to serve. Errors: `Query`.
    pub async fn clear_active(&self, model: &ModelName) -> Result<(), StoreError> {
        let sql = "DELETE FROM active_versions WHERE model = $1";
        self.database.execute(sql, values![model]).await.map(drop)
    }

    /// All published versions that are not deleted, by name and number. Errors: `Query`.
    pub async fn published_versions(&self) -> Result<Vec<(ModelName, u32)>, StoreError> {
        let sql = "SELECT model, version FROM model_versions \
             WHERE published_s IS NOT NULL AND deleted_s IS NULL ORDER BY model, version";
        let rows = self.database.fetch(sql, values![]).await?;
        rows.iter().map(version_of).collect()
    }

    /// All versions that no job made and that were never published, by name and number: a publication of them runs, or did not
    /// finish. Errors: `Query`.
    pub async fn unpublished_versions(&self) -> Result<Vec<(ModelName, u32)>, StoreError> {
        let sql = "SELECT model, version FROM model_versions \
             WHERE published_s IS NULL AND job IS NULL ORDER BY model, version";
        let rows = self.database.fetch(sql, values![]).await?;
        rows.iter().map(version_of).collect()
    }

    /// All versions that were deleted, by name and number. Errors: `Query`.
    pub async fn deleted_versions(&self) -> Result<Vec<(ModelName, u32)>, StoreError> {
        let sql = "SELECT model, version FROM model_versions WHERE deleted_s IS NOT NULL ORDER BY model, version";
        let rows = self.database.fetch(sql, values![]).await?;
        rows.iter().map(version_of).collect()
    }

    /// The active version of each model that has one. Errors: `Query`.
    pub async fn active_versions(&self) -> Result<Vec<(ModelName, u32)>, StoreError> {
        let rows = self.database.fetch("SELECT * FROM active_versions", values![]).await?;
        rows.iter().map(version_of).collect()
    }

    /// The latest metrics of all versions that were evaluated. Errors: `Query`.
    pub async fn model_metrics(&self) -> Result<Vec<ModelMetrics>, StoreError> {
        read_all(self.database.fetch("SELECT * FROM model_metrics", values![]).await?)
    }

    /// Makes a version active, if it is not. Errors: `Query`.
    pub async fn set_active(&self, model: &ModelName, version: u32, now_s: f64, by: &Author) -> Result<(), StoreError> {
        let sql = "INSERT INTO active_versions (model, version, since_s) VALUES ($1, $2, $3) \
             ON CONFLICT (model) DO UPDATE SET version = excluded.version, since_s = excluded.since_s \
             WHERE active_versions.version <> excluded.version";
        let values = values![model, version, now_s];
        let change = by.change("version.activate", version_id(model, version));
        self.execute_recorded(sql, values, change).await.map(drop)
    }

    /// Marks a version as deleted unless it is active. Returns whether it did. Errors: `Query`.
    pub async fn delete_version(
        &self,
        model: &ModelName,
        version: u32,
        now_s: f64,
        by: &Author,
    ) -> Result<bool, StoreError> {
        let sql = "UPDATE model_versions SET deleted_s = $3 WHERE model = $1 AND version = $2 \
             AND published_s IS NOT NULL AND deleted_s IS NULL \
             AND NOT EXISTS (SELECT 1 FROM active_versions WHERE model = $1 AND version = $2)";
        let values = values![model, version, now_s];
        let change = by.change("version.delete", version_id(model, version));
        self.execute_recorded(sql, values, change).await
    }
}

/// Adds the next version of a model, above `shipped`, and commits the transaction, which holds the lock of the numbers.
async fn insert_next_version(
    mut tx: Tx,
    model: &ModelName,
    shipped: u32,
    job: Option<JobId>,
) -> Result<u32, StoreError> {
    let sql = "INSERT INTO model_versions (model, version, job) \
         SELECT $1, CASE WHEN COALESCE(MAX(version), 0) < $2 THEN $2 ELSE COALESCE(MAX(version), 0) END + 1, $3 \
         FROM model_versions WHERE model = $1 RETURNING version";
    let row = tx.first(sql, values![model, shipped, job.map(JobId::number)]).await?;
    tx.commit().await?;
    row.ok_or(StoreError::Query(sqlx::Error::RowNotFound))?.get("version")
}

/// A version in the audit trail.
pub(super) fn version_id(model: &ModelName, version: u32) -> String {
    format!("{model}@{version}")
}

/// Publishes a version, and makes it active if it activates and none is. Returns whether it was not published before.
pub(super) async fn write_published(tx: &mut Tx, published: &PublishedVersion, now_s: f64) -> Result<bool, StoreError> {
    let sql = "UPDATE model_versions SET published_s = $3 WHERE model = $1 AND version = $2 AND published_s IS NULL";
    let values = values![&published.model, published.version, now_s];
    let is_new = tx.execute(sql, values.clone()).await? > 0;
    if published.activates {
        // A sweep activates a version that was published before, and may have been deleted since.
        let sql = "INSERT INTO active_versions (model, version, since_s) SELECT model, version, $3 FROM model_versions \
             WHERE model = $1 AND version = $2 AND deleted_s IS NULL ON CONFLICT DO NOTHING";
        tx.execute(sql, values).await?;
    }
    Ok(is_new)
}

/// Replaces the metrics of a version.
pub(super) async fn write_metrics(tx: &mut Tx, measured: ModelMetrics, now_s: f64) -> Result<(), StoreError> {
    let sql = "INSERT INTO model_metrics (model, version, weights_sha256, metrics, measured_s) \
         VALUES ($1, $2, $3, $4, $5) ON CONFLICT (model, version) DO UPDATE SET \
         weights_sha256 = excluded.weights_sha256, metrics = excluded.metrics, measured_s = excluded.measured_s";
    let ModelMetrics {
        model,
        version,
        weights_sha256,
        metrics,
    } = measured;
    tx.execute(sql, values![&model, version, weights_sha256, metrics, now_s])
        .await
        .map(drop)
}
