//! From a model and a data set to a report that can be trusted: [`run`] scores the model against trivial [`baselines`] on
//! trials it never saw, [`write()`] leaves report, figures and animation in a directory.
//!
//! Frames are compared as the camera saw them: intensities 0…1, neither inverted nor smoothed.

pub mod actions;
pub mod baselines;
pub mod bootstrap;
pub mod compatible;
mod error;
pub mod figures;
pub mod inference;
mod markdown;
pub mod metrics;
pub mod motion;
mod output;
pub mod report;
mod samples;
pub mod score;
pub mod skill;

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

pub use self::error::EvaluationError;
pub use self::output::{prepare, write};
pub use self::report::EvaluationReport;
pub use self::samples::figure_inputs;

use self::bootstrap::Bootstrap;
use self::report::{ModelSummary, ReportStamp, SetOutcome, SetReport, SetScores};
use crate::dataset::sampler::{Split, Splits, WindowShape};
use crate::dataset::{Dataset, Window};
use crate::registry::LoadedModel;
use crate::types::Seed;

/// What to test on, and how closely.
#[derive(Clone)]
pub struct EvaluateConfig<'a> {
    /// Seed of the split into trials; that of the model's training where none is given.
    pub split_seed: Option<Seed>,
    /// Frames from the start of one window to that of the next.
    pub stride: usize,
    /// Windows of each test set at most, evenly spread over its trials.
    pub max_windows: usize,
    /// Resamples for the intervals.
    pub bootstrap_samples: usize,
    /// Seed of the resamples and of the shuffled actions.
    pub seed: Seed,
    /// Windows that go through the model at once.
    pub batch: usize,
    /// A model without conditioning, trained with the same budget, for the action table.
    pub twin: Option<&'a LoadedModel>,
    /// The command line, for the stamp.
    pub command: String,
    /// Where it is looked whether to stop.
    pub cancelled: Option<&'a AtomicBool>,
}

impl Default for EvaluateConfig<'_> {
    fn default() -> Self {
        Self {
            split_seed: None,
            stride: 1,
            max_windows: 2000,
            bootstrap_samples: 1000,
            seed: Seed(0),
            batch: 64,
            twin: None,
            command: String::new(),
            cancelled: None,
        }
    }
}

impl EvaluateConfig<'_> {
    /// Errors: `Setting` where a number is too small.
    pub fn validate(&self) -> Result<(), EvaluationError> {
        for (setting, value, least) in [
            ("the stride of windows", self.stride, 1),
            ("the number of windows", self.max_windows, 1),
            ("the number of bootstrap samples", self.bootstrap_samples, 100),
            ("the batch size", self.batch, 1),
        ] {
            if value < least {
                return Err(EvaluationError::Setting { setting, value, least });
            }
        }
        Ok(())
    }
}

/// What is being computed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum EvaluationStage {
    /// Model and baselines, frame by frame.
    Scores,
    /// The action table.
    Actions,
}

/// How far the evaluation is.
#[derive(Clone, Copy, Debug)]
pub struct EvaluationProgress {
    /// The test set.
    pub split: Split,
    /// What is being computed.
    pub stage: EvaluationStage,
    /// Windows done.
    pub done: usize,
    /// Windows in all.
    pub total: usize,
}

/// What every pass over a test set needs besides its windows.
pub struct EvaluationContext<'a> {
    split: Split,
    batch: usize,
    bootstrap: Bootstrap,
    on_progress: &'a (dyn Fn(EvaluationProgress) + Sync),
    cancelled: Option<&'a AtomicBool>,
}

impl EvaluationContext<'_> {
    /// Errors: `Cancelled` if it is to stop.
    fn tell(&self, stage: EvaluationStage, done: usize, total: usize) -> Result<(), EvaluationError> {
        (self.on_progress)(EvaluationProgress {
            split: self.split,
            stage,
            done,
            total,
        });
        match self.cancelled {
            Some(cancelled) if cancelled.load(Ordering::Acquire) => Err(EvaluationError::Cancelled),
            _ => Ok(()),
        }
    }
}

/// Scores the model on both held-out parts of the data set: trials never seen, and start/goal pairs and gains never seen.
/// Errors: model and data set that don't fit together, settings out of range, nothing held out, `Cancelled`, those of the
/// network.
pub fn run(
    loaded: &LoadedModel,
    dataset: &Dataset,
    config: &EvaluateConfig,
    on_progress: &(dyn Fn(EvaluationProgress) + Sync),
) -> Result<EvaluationReport, EvaluationError> {
    let started = Instant::now();
    config.validate()?;
    compatible::check(loaded, dataset)?;
    let split_seed = compatible::split_seed(loaded, dataset, config.split_seed)?;
    if let Some(twin) = config.twin {
        compatible::check_twin(loaded, twin)?;
        compatible::check(twin, dataset)?;
        compatible::split_seed(twin, dataset, Some(split_seed))?;
    }
    let splits = Splits::new(dataset, split_seed);
    let tests = [Split::Test, Split::TestUnseen];
    if tests.iter().all(|&split| splits.episodes(split).is_empty()) {
        return Err(EvaluationError::NothingHeldOut {
            dataset: dataset.info().name.clone(),
            split_seed: split_seed.0,
        });
    }
    let training_mean = score::training_mean(dataset, &splits)?;
    let mut sets = Vec::new();
    for split in tests {
        let watched = EvaluationContext {
            split,
            batch: config.batch,
            bootstrap: Bootstrap {
                samples: config.bootstrap_samples,
                seed: config.seed,
            },
            on_progress,
            cancelled: config.cancelled,
        };
        let outcome = score_split(loaded, (dataset, &splits), config, &training_mean, &watched)?;
        sets.push(SetReport {
            split: split.name().to_owned(),
            outcome,
        });
    }
    Ok(EvaluationReport {
        stamp: ReportStamp::new(loaded, dataset, split_seed, config, started.elapsed()),
        model: ModelSummary::of(loaded),
        sets,
        figures: Vec::new(),
    })
}

fn score_split(
    loaded: &LoadedModel,
    (dataset, splits): (&Dataset, &Splits),
    config: &EvaluateConfig,
    training_mean: &[f32],
    watched: &EvaluationContext,
) -> Result<SetOutcome, EvaluationError> {
    let spec = loaded.model.spec();
    let shape = WindowShape {
        context: spec.context,
        horizon: spec.horizon,
    };
    let available = splits.windows(dataset, watched.split, shape, config.stride)?;
    if available.is_empty() {
        let reason = match watched.split {
            Split::TestUnseen => "the data set holds no trials of start/goal pairs or gains kept apart",
            _ => "the split leaves it without trials; collect more",
        };
        return Ok(SetOutcome::Skipped {
            reason: reason.to_owned(),
        });
    }
    let windows = score::evenly(&available, config.max_windows);
    let scores = score::score(loaded, dataset, &windows, training_mean, watched)?;
    let actions = if spec.action_inputs().is_some() {
        let errors = actions::compare(loaded, config.twin, dataset, &windows, watched)?;
        let trial_of: Vec<usize> = windows.iter().map(|window: &Window| window.episode).collect();
        Some(actions::table(&errors, &trial_of, &watched.bootstrap))
    } else {
        None
    };
    let scores = SetScores::new(&scores, available.len(), actions, &watched.bootstrap);
    Ok(SetOutcome::Scored(Box::new(scores)))
}
