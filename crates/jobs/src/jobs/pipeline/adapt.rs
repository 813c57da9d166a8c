//! The work of an adaptation: a training that starts from another model's weights. A model that became no better is not published.

use std::sync::atomic::AtomicBool;

use serde_json::json;

use super::super::executor::{JobFailure, JobResult};
use super::super::report::JobReporter;
use super::super::{AdaptSpec, JobError, JobSpec};
use super::base::{check_starts, described};
use super::train::TrainingWork;
use super::{Pipeline, failed};
use foreframe_core::error_kind::{ErrorKind, HasErrorKind as _};
use foreframe_core::error_text;
use foreframe_core::registry;
use foreframe_train::adaptation::{AdaptError, Adaptation};

impl Pipeline {
    pub(super) fn adapt(
        &self,
        spec: &AdaptSpec,
        report: &JobReporter,
        cancelled: &AtomicBool,
    ) -> Result<JobResult, JobFailure> {
        let settings = spec.settings().map_err(|error| failed(&error))?;
        report.progress(0, 0, "reading the data set");
        let retry = self.retry_policy(report, cancelled);
        let dataset = self.dataset(&spec.dataset, self.resources.memory.held_mib(), &retry)?;
        self.prepare_run(&retry)?;
        let base = self.base(&JobSpec::Adapt(spec.clone()), &spec.from, &retry)?;
        let model = retry.repeat(|| registry::load_as(&base.dir, &spec.from))?;
        report.progress(0, 0, "looking at the recording");
        let adaptation = retry.repeat(|| Adaptation::of(&model, dataset.clone(), &settings, cancelled))?;
        if let Some(camera) = &adaptation.camera {
            report.line(format!("camera, {camera}"));
        }
        let work = TrainingWork {
            spec: &base.spec,
            config: &adaptation.config,
            dataset: &adaptation.dataset,
            start: Some(&base),
        };
        let (model_dir, manifest) = self.trained(&work, &retry)?;
        let steps = u64::from(spec.steps);
        report.progress(steps, steps, "comparing");
        let adapted = retry.repeat(|| registry::load(&model_dir))?;
        let scores = retry.repeat(|| adaptation.judge(&adapted, cancelled))?;
        let table = scores.table(spec.from.as_str(), spec.name.as_str());
        table.lines().for_each(|line| report.line(line.to_owned()));
        if !scores.is_better() {
            return Err(JobFailure::Failed(format!(
                "{} became no better than {} (MSE {:.6} and {:.6} on {} validation windows), so it is not published; record more, or try \
                 other steps",
                spec.name, spec.from, scores.after, scores.before, scores.windows
            )));
        }
        report.progress(steps, steps, "publishing");
        let mut metrics = manifest.metrics;
        metrics["adaptation"] = json!(scores);
        self.published(&spec.name, &model_dir, &metrics, &retry)
    }

    /// Errors: `Invalid` if the model cannot be adapted, or not with these settings, or that needs too much memory.
    pub(super) async fn check_adaptation(&self, spec: &AdaptSpec) -> Result<(), JobError> {
        // The job before it may make the version that is meant.
        if spec.from_version.is_none() && spec.after.is_some() {
            return Ok(());
        }
        let base = match self.versions.manifest(&spec.from, spec.from_version).await {
            Ok(base) => base,
            Err(error) if error.kind() == ErrorKind::Away => return Err(error.into()),
            // What cannot be read says so when the job runs.
            Err(_) => return Ok(()),
        };
        let info = described(self.store.objects(), &spec.dataset).await?;
        let config = spec.settings()?.training(&base, &info).map_err(|error| {
            let field = match error {
                AdaptError::NotAdaptable(_) => "from",
                AdaptError::NoChannel { .. } | AdaptError::Fixed("mirror", _) => "mirror",
                AdaptError::NoPose(_) => "remember",
                AdaptError::Evaluation(_) => "dataset",
                _ => "settings",
            };
            JobError::invalid(field, error_text::with_causes(&error))
        })?;
        self.resources.memory.check_training(&config, &info)?;
        check_starts(vec![config], Some(&base), info).await
    }
}
