//! The work of an evaluation. A part of one saves its results in `runs/JOB`, from where the whole reads them. What a part did not
//! save is computed by the whole, so the report does not depend on who computed what.

use std::path::Path;
use std::sync::atomic::AtomicBool;

use serde_json::json;

use super::super::executor::{JobFailure, JobResult};
use super::super::report::JobReporter;
use super::super::retry_policy::RetryPolicy;
use super::super::{EvaluateSpec, JobSpec};
use super::parts::LAST_FILE;
use super::{Pipeline, failed, report_key, request_line, run_key};
use crate::store::ModelMetrics;
use foreframe_core::files::remove_dir;
use foreframe_core::types::Seed;
use foreframe_train::evaluation::figures::Figure;
use foreframe_train::evaluation::{
    self, EvaluateConfig, EvaluationError, EvaluationPart, EvaluationProgress, EvaluationReport,
};

/// The file of an evaluation's report that is written last.
const REPORT_FILE: &str = "report.json";

/// What is told of the progress of a part.
type OnProgress<'a> = &'a (dyn Fn(EvaluationProgress) + Sync);

impl Pipeline {
    pub(super) fn evaluate(
        &self,
        spec: &EvaluateSpec,
        report: &JobReporter,
        cancelled: &AtomicBool,
    ) -> Result<JobResult, JobFailure> {
        let retry = self.retry_policy(report, cancelled);
        let parts = self.ended_parts(report, &retry)?;
        let job = JobSpec::Evaluate(spec.clone());
        let version = self.used_version(&job, &spec.model, &retry)?;
        let loaded = retry.run(async || self.versions.load(&spec.model, version).await)?;
        self.with_version_written(&job, version, &retry)?;
        let twin = spec.twin.as_ref();
        let twin = twin.map(|twin| retry.run(async || self.versions.load_active(twin).await));
        let twin = twin.transpose()?;
        report.progress(0, 0, "reading the data set");
        let dataset = self.dataset(&spec.dataset, self.resources.memory.held_mib(), &retry)?;
        let config = EvaluateConfig {
            max_windows: spec.windows,
            bootstrap_samples: spec.resamples,
            seed: Seed(spec.seed),
            twins: twin.iter().collect(),
            command: request_line(&JobSpec::Evaluate(spec.undivided(version))),
            cancelled: Some(cancelled),
            saved: self.fetch_parts(&parts, LAST_FILE, &retry)?,
            ..EvaluateConfig::default()
        };
        if let Some(index) = spec.part {
            let part = EvaluationPart {
                dir: self.store.objects().data_dir().join(run_key(report.id())),
                index,
                count: spec.parts,
            };
            let compute =
                |on_progress: OnProgress| evaluation::run_part(&loaded, &dataset, &config, &part, on_progress);
            return self.evaluate_part(&part, &retry, compute);
        }
        let found = evaluation::run(&loaded, &dataset, &config, &|now| show(report, now));
        let mut found = found.map_err(|error| failed(&error))?;
        let figures = evaluation::draw_figures(&loaded, &dataset, &found).map_err(|error| failed(&error))?;
        let files = self.write_report(&mut found, &figures, &retry)?;
        self.delete_parts(&parts, &retry)?;
        let scores = found.headline();
        // What models are compared by: the score on other data says something about that data.
        let is_own = loaded.manifest.dataset.includes(&dataset.info().content_hash);
        let has_score = loaded.manifest.metrics.get("test").is_some();
        let is_of_training = found.has_frames_of_training();
        if is_of_training {
            report.line(
                "frames of this data set were in the model's training, so models are not compared by this score"
                    .to_owned(),
            );
        }
        let counts = (is_own || !has_score) && !is_of_training;
        Ok(JobResult {
            measured: counts.then(|| ModelMetrics {
                model: spec.model.clone(),
                version,
                weights_sha256: loaded.manifest.weights_sha256.clone(),
                metrics: scores.to_string(),
            }),
            ..JobResult::of(json!({"model": spec.model, "version": version, "scores": scores, "files": files}))
        })
    }

    /// Computes a part's share of the windows, by `compute`.
    fn evaluate_part(
        &self,
        part: &EvaluationPart,
        retry: &RetryPolicy<'_>,
        compute: impl Fn(OnProgress) -> Result<(), EvaluationError>,
    ) -> Result<JobResult, JobFailure> {
        let report = retry.report;
        self.prepare_part(report, retry)?;
        report.checkpoint(saved_files(&part.dir));
        let on_progress = |now: EvaluationProgress| {
            show(report, now);
            // Whole passes are saved; a new attempt continues after them.
            report.checkpoint(saved_files(&part.dir));
        };
        // Passes that are saved are read again, so a full disk costs one pass.
        retry.repeat(|| compute(&on_progress))?;
        self.finish_part((part.index, part.count), report, retry)
    }

    /// Writes the report and copies it to the object store, if there is a shared one; returns the names of its files.
    fn write_report(
        &self,
        found: &mut EvaluationReport,
        figures: &[Figure],
        retry: &RetryPolicy<'_>,
    ) -> Result<Vec<String>, JobFailure> {
        let dir = report_key(retry.report.id());
        // An earlier attempt may have left an incomplete report.
        retry.run(async || self.store.objects().delete(&dir).await)?;
        let out = self.store.objects().data_dir().join(&dir);
        retry.repeat(|| {
            // So may a write that failed.
            let path = out.clone();
            remove_dir(&out).map_err(|source| EvaluationError::Io { path, source })?;
            evaluation::prepare(&out)?;
            evaluation::write(&out, found, figures)
        })?;
        retry.run(async || self.store.objects().push(&dir, REPORT_FILE).await)?;
        let mut files: Vec<String> = std::fs::read_dir(&out)
            .map_err(|error| failed(&error))?
            .filter_map(|entry| entry.ok()?.file_name().into_string().ok())
            .collect();
        files.sort();
        Ok(files)
    }
}

fn show(report: &JobReporter, now: EvaluationProgress) {
    let message = format!("{} {}", now.split, now.stage.name());
    report.progress(now.done as u64, now.total as u64, &message);
}

/// How many files a part has saved.
fn saved_files(dir: &Path) -> u64 {
    std::fs::read_dir(dir).map_or(0, Iterator::count) as u64
}
