//! The work itself: collections and trainings below the data directory. A finished training's model is published under
//! `models/NAME` there and serves at once.

use std::error::Error;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

use super::runner::{Execute, Failure, Report};
use super::{CollectSpec, JobError, JobSpec, Losses, TrainSpec};
use crate::dataset::{self, Dataset};
use crate::files::write_atomically;
use crate::registry;
use crate::serving::Predictor;
use crate::training::{self, Event, Outcome, Stage, Training};
use crate::wording;

/// Collects and trains below `data_dir`: `datasets/NAME`, `runs/NAME`, `models/NAME`.
pub struct Pipeline {
    /// Where everything is written.
    pub data_dir: PathBuf,
    /// Where trained models serve.
    pub predictor: Predictor,
}

impl Execute for Pipeline {
    fn check(&self, spec: &JobSpec) -> Result<(), JobError> {
        let models: Vec<String> = self
            .predictor
            .models()
            .iter()
            .map(|manifest| manifest.name.clone())
            .collect();
        spec.check(&self.data_dir, &models)
    }

    fn execute(&self, spec: &JobSpec, report: &Report<'_>, cancelled: &AtomicBool) -> Result<(), Failure> {
        let result = match spec {
            JobSpec::Collect(spec) => self.collect(spec, report, cancelled),
            JobSpec::Train(spec) => self.train(spec, report, cancelled),
        };
        match result {
            Err(Failure::Failed(_)) if cancelled.load(Ordering::Acquire) => Err(Failure::Cancelled),
            other => other,
        }
    }
}

impl Pipeline {
    fn collect(&self, spec: &CollectSpec, report: &Report<'_>, cancelled: &AtomicBool) -> Result<(), Failure> {
        let config = spec
            .config(&self.make_dir("datasets")?)
            .map_err(|error| failed(&error))?;
        let on_progress = |progress: dataset::Progress| report.progress(progress.done, progress.total, "simulating");
        dataset::collect(&config, &on_progress, cancelled).map_err(|error| failed(&error))?;
        Ok(())
    }

    fn train(&self, spec: &TrainSpec, report: &Report<'_>, cancelled: &AtomicBool) -> Result<(), Failure> {
        let config = spec.config().map_err(|error| failed(&error))?;
        let run_dir = self.make_dir("runs")?.join(&spec.name);
        report.progress(0, 0, "reading the data set");
        let dataset_dir = self.data_dir.join("datasets").join(&spec.dataset);
        let dataset = Dataset::open(&dataset_dir).map_err(|error| failed(&error))?;
        let training = Training {
            config: &config,
            dataset: &dataset,
            run_dir: &run_dir,
            command: &command(spec),
        };
        let steps = (config.pretrain.steps as u64, config.fit.steps as u64);
        let mut observer = |event: Event| tell(event, steps, report);
        match training::run(&training, &mut observer, cancelled).map_err(|error| failed(&error))? {
            Outcome::Interrupted { .. } => Err(Failure::Cancelled),
            Outcome::Finished { model_dir, .. } => self.publish(&model_dir, &spec.name),
        }
    }

    /// Copies a run's model to where models are loaded from and has it serve.
    fn publish(&self, model_dir: &Path, name: &str) -> Result<(), Failure> {
        let published = self.make_dir("models")?.join(name);
        std::fs::create_dir_all(&published).map_err(|error| failed(&error))?;
        // The manifest last: a directory without one is no model.
        for file in [registry::WEIGHTS_FILE, registry::MANIFEST_FILE] {
            let bytes = std::fs::read(model_dir.join(file)).map_err(|error| failed(&error))?;
            write_atomically(&published.join(file), &bytes).map_err(|error| failed(&error))?;
        }
        let loaded = registry::load(&published).map_err(|error| failed(&error))?;
        self.predictor.load(loaded).map_err(|error| failed(&error))
    }

    fn make_dir(&self, name: &str) -> Result<PathBuf, Failure> {
        let dir = self.data_dir.join(name);
        std::fs::create_dir_all(&dir)
            .map_err(|error| Failure::Failed(format!("could not make {}: {error}", dir.display())))?;
        Ok(dir)
    }
}

fn tell(event: Event, (pretrain_steps, fit_steps): (u64, u64), report: &Report<'_>) {
    let total = pretrain_steps + fit_steps;
    let done = |stage: Stage, step: usize| match stage {
        Stage::Pretrain => step as u64,
        Stage::Fit => pretrain_steps + step as u64,
    };
    match event {
        Event::Started { stage, step, .. } => report.progress(done(stage, step), total, &stage.to_string()),
        Event::Step { stage, step, loss, .. } => {
            if step == 1 {
                report.stage();
            }
            report.progress(done(stage, step), total, &stage.to_string());
            report.losses(Losses {
                train: Some(loss),
                validation: None,
            });
        }
        Event::Validated { loss, .. } => report.losses(Losses {
            train: None,
            validation: Some(loss),
        }),
        Event::Checkpointed { .. } => {}
    }
}

/// What the manifest tells of how the model was made.
fn command(spec: &TrainSpec) -> String {
    let body = JobSpec::Train(spec.clone());
    format!("POST /v1/jobs {}", serde_json::to_string(&body).unwrap_or_default())
}

fn failed(error: &dyn Error) -> Failure {
    Failure::Failed(wording::sentence(error))
}
