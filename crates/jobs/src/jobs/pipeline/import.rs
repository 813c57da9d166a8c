//! The work of an import. A part of one saves its shards in `runs/JOB`, from where the whole takes them. What a part did not save
//! is imported by the whole.

use std::path::Path;
use std::sync::atomic::AtomicBool;

use super::super::datasets;
use super::super::report::JobReporter;
use super::super::retry_policy::RetryPolicy;
use super::super::spec::ImportSpec;
use super::parts::LAST_FILE;
use super::{Pipeline, failed, run_key};
use crate::jobs::executor::{JobFailure, JobResult};
use foreframe_data::dataset::IMPORT_ARGUMENTS;
use foreframe_data::dataset::import::{
    ImportConfig, ImportError, ImportPart, ImportProgress, Imported, check_out, import_part, import_parts,
    saved_part_shards, saved_shards,
};

/// How many left-out items are written to the job's log; `meta/skipped.json` lists up to 10,000.
const LOGGED_ITEMS: usize = 200;

impl Pipeline {
    pub(super) fn import(
        &self,
        spec: &ImportSpec,
        report: &JobReporter,
        cancelled: &AtomicBool,
    ) -> Result<JobResult, JobFailure> {
        let objects = self.store.objects();
        let Some(upload) = spec.upload().map_err(|error| failed(&error))? else {
            return self.import_here(spec, report, cancelled);
        };
        let retry = self.retry_policy(report, cancelled);
        retry.run(async || upload.fetch(objects).await)?;
        let place = upload.existing(objects.data_dir());
        let result = self.import_here(spec, report, cancelled);
        upload.forget_copy(objects);
        result.map_err(|failure| match (failure, place.as_deref().map(Path::parent)) {
            // Who uploaded the file knows it by its name, not by where it lies here.
            (JobFailure::Failed(reason), Ok(Some(dir))) => {
                JobFailure::Failed(reason.replace(&format!("{}/", dir.display()), ""))
            }
            (failure, _) => failure,
        })
    }

    /// Imports what is on this machine.
    fn import_here(
        &self,
        spec: &ImportSpec,
        report: &JobReporter,
        cancelled: &AtomicBool,
    ) -> Result<JobResult, JobFailure> {
        let data_dir = self.store.objects().data_dir();
        let mut config = spec
            .config(data_dir, self.resources.import_dir.as_deref())
            .map_err(|error| failed(&error))?;
        config.disk_mib = self.resources.import_disk_mib;
        config.max_files = self.resources.max_import_files;
        report.progress(0, 0, "reading the recording");
        let retry = self.retry_policy(report, cancelled);
        if let Some(index) = spec.part {
            let part = ImportPart {
                dir: data_dir.join(run_key(report.id())),
                index,
                count: spec.parts,
            };
            return self.import_part(&config, &part, &retry);
        }
        let parts = self.ended_parts(report, &retry)?;
        let is_stale = |was_deleted| {
            let is_of_another_import = config.out.join(IMPORT_ARGUMENTS).is_file();
            matches!(check_out(&config), Err(ImportError::OutExists { .. })) && (was_deleted || is_of_another_import)
        };
        retry.run(async || datasets::clear_stale(self.store.objects(), &spec.name, is_stale).await)?;
        // Whole shards are saved; a new attempt continues after them.
        report.checkpoint(saved_shards(&config.out) as u64);
        let on_progress = |now: ImportProgress| report.progress(now.done, now.total, "importing");
        // After an error it continues with the shards that are finished.
        let dirs = self.fetch_parts(&parts, LAST_FILE, &retry)?;
        let imported = retry.repeat_once_free(|| import_parts(&config, &dirs, &on_progress, cancelled))?;
        imported.notes.iter().for_each(|note| report.line(note.clone()));
        log_skipped(&imported, report);
        let mut result = self.finish_dataset(&spec.name, &imported.info, &retry)?;
        result["skipped"] = imported.skipped_count().into();
        self.delete_parts(&parts, &retry)?;
        Ok(JobResult::of(result))
    }

    /// Imports a part's share of the shards.
    fn import_part(
        &self,
        config: &ImportConfig,
        part: &ImportPart,
        retry: &RetryPolicy<'_>,
    ) -> Result<JobResult, JobFailure> {
        let report = retry.report;
        self.prepare_part(report, retry)?;
        report.checkpoint(saved_part_shards(&part.dir) as u64);
        let on_progress = |now: ImportProgress| {
            report.progress(now.done, now.total, "importing");
            report.checkpoint(saved_part_shards(&part.dir) as u64);
        };
        retry.repeat_once_free(|| import_part(config, part, &on_progress, retry.cancelled))?;
        self.finish_part((part.index, part.count), report, retry)
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
