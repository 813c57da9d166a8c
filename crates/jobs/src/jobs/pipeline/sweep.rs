//! The table of a sweep: what each of its trainings made, the lowest validation error first.

use serde_json::{Map, Value, json};

use super::super::executor::{JobFailure, JobResult};
use super::super::report::JobReporter;
use super::super::retry_policy::RetryPolicy;
use super::super::{JobState, TrainSpec};
use super::Pipeline;
use crate::store::{JobRow, PublishedVersion};

impl Pipeline {
    /// Reads what the parts of a sweep made. The best version becomes active if the model was not shipped and none is.
    /// Errors: `Failed` if no training succeeded.
    pub(super) fn join_sweep(
        &self,
        spec: &TrainSpec,
        report: &JobReporter,
        retry: &RetryPolicy<'_>,
    ) -> Result<JobResult, JobFailure> {
        let parts = retry.run(async || self.store.parts(report.id()).await)?;
        let settings = spec.sweep.points();
        if parts.len() != settings.len() {
            return Err(JobFailure::Failed(format!(
                "{} of its {} trainings were deleted",
                settings.len().saturating_sub(parts.len()),
                settings.len()
            )));
        }
        let mut points: Vec<Value> = parts
            .iter()
            .zip(settings)
            .map(|(part, settings)| point(part, &settings))
            .collect();
        points.sort_by(|a, b| error_of(a).total_cmp(&error_of(b)));
        let Some(version) = points.first().and_then(version_of) else {
            let reason = parts.iter().find_map(|part| Some((part.id, part.error.as_deref()?)));
            let reason = reason.map(|(id, error)| format!("; {id}: {error}")).unwrap_or_default();
            return Err(JobFailure::Failed(format!(
                "none of the {} trainings of the sweep succeeded{reason}",
                parts.len()
            )));
        };
        let done = points.iter().filter(|point| version_of(point).is_some()).count();
        report.progress(done as u64, parts.len() as u64, "trainings succeeded");
        let published = PublishedVersion {
            model: spec.name.clone(),
            version,
            activates: self.versions.shipped(&spec.name).is_none(),
        };
        Ok(JobResult {
            published: Some(published),
            ..JobResult::of(json!({"model": spec.name, "version": version, "sweep": points}))
        })
    }
}

/// A line of the table.
fn point(part: &JobRow, settings: &Map<String, Value>) -> Value {
    let outcome = part
        .outcome
        .as_deref()
        .filter(|_| part.state == JobState::Succeeded.name());
    let outcome: Value = outcome
        .and_then(|text| serde_json::from_str(text).ok())
        .unwrap_or_default();
    let validation = &outcome["metrics"]["validation"];
    json!({
        "job": part.id,
        "state": part.state,
        "settings": settings,
        "version": outcome["version"],
        "validation_mse": validation["mse"],
        "step": validation["step"],
        "error": part.error,
    })
}

/// The error by which the lines are sorted: those without one come last.
fn error_of(point: &Value) -> f64 {
    match version_of(point) {
        Some(_) => point["validation_mse"].as_f64().unwrap_or(f64::MAX),
        None => f64::INFINITY,
    }
}

fn version_of(point: &Value) -> Option<u32> {
    u32::try_from(point["version"].as_u64()?).ok()
}
