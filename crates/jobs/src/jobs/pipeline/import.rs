//! The work of an import.

use std::sync::atomic::AtomicBool;

use serde_json::json;

use super::super::datasets;
use super::super::report::JobReporter;
use super::super::retry_policy::retry_while_busy;
use super::super::spec::ImportSpec;
use super::{Pipeline, failed};
use crate::jobs::executor::{JobFailure, JobResult};
use foreframe_data::dataset::DatasetError;
use foreframe_data::dataset::import::{ImportConfig, ImportError, ImportProgress, Imported, import, saved_shards};

/// How many left-out items are written to the job's log; `meta/skipped.json` lists up to 10,000.
const LOGGED_ITEMS: usize = 200;

impl Pipeline {
    pub(super) fn import(
        &self,
        spec: &ImportSpec,
        report: &JobReporter,
        cancelled: &AtomicBool,
    ) -> Result<JobResult, JobFailure> {
        let data_dir = self.store.objects().data_dir();
        let config = spec
            .config(data_dir, self.import_dir.as_deref())
            .map_err(|error| failed(&error))?;
        let config = ImportConfig {
            disk_mib: self.import_disk_mib,
            ..config
        };
        report.progress(0, 0, "reading the recording");
        let retry = self.retry_policy(report, cancelled);
        retry.run(async || datasets::clear_stale_import(self.store.objects(), &spec.name, &config).await)?;
        // Whole shards are saved; a new attempt continues after them.
        report.checkpoint(saved_shards(&config.out) as u64);
        let on_progress = |now: ImportProgress| report.progress(now.done, now.total, "importing");
        let work = || import(&config, &on_progress, cancelled);
        let is_busy = |error: &ImportError| matches!(error, ImportError::Dataset(DatasetError::Busy { .. }));
        // After an error it continues with the shards that are finished.
        let imported = retry.repeat(|| retry_while_busy(work, is_busy, cancelled))?;
        log_skipped(&imported, report);
        self.push_dataset(&spec.name, &retry)?;
        let info = &imported.info;
        Ok(JobResult {
            result: json!({
                "dataset": spec.name, "episodes": info.episode_count, "frames": info.frame_count,
                "content_hash": info.content_hash, "skipped": imported.skipped_count(),
            }),
            published: None,
            measured: None,
        })
    }
}

fn log_skipped(imported: &Imported, report: &JobReporter) {
    for item in imported.skipped.iter().take(LOGGED_ITEMS) {
        report.line(format!("left out {}: {}", item.place, item.reason));
    }
    if imported.skipped.len() > LOGGED_ITEMS {
        let count = imported.skipped_count();
        report.line(format!(
            "left out {count} items in all; the data set's meta/skipped.json lists them, up to 10,000"
        ));
    }
}
