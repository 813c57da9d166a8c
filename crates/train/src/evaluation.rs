//! From a model and a data set to a report that can be trusted: [`run`] scores the model against simple [`baselines`] on
//! trials that training never saw, [`write()`] writes report, figures and animation into a directory.
//!
//! Frames are compared as the camera saw them: intensities 0…1, neither inverted nor smoothed.

pub mod actions;
pub mod baselines;
pub mod bootstrap;
mod calibrate;
mod cholesky;
pub mod compatible;
mod error;
pub mod figures;
mod forecast;
pub mod inference;
mod markdown;
pub mod metrics;
mod output;
pub mod plans;
pub mod report;
mod samples;
pub mod score;
pub mod skill;
pub mod uncertainty;

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use serde::{Deserialize, Serialize};

pub use self::calibrate::{calibrate, calibrate_trained};
pub use self::error::EvaluationError;
pub use self::output::{prepare, write};
pub use self::report::EvaluationReport;
pub use self::samples::figure_inputs;

use self::baselines::{Baselines, Method};
use self::bootstrap::Bootstrap;
use self::report::{ModelSummary, ReportStamp, SetOutcome, SetReport, SetScores};
use self::uncertainty::NoveltyScores;
use foreframe_core::nn::ModelSpec;
use foreframe_core::registry::LoadedModel;
use foreframe_core::types::Seed;
use foreframe_data::dataset::Dataset;
use foreframe_data::dataset::moving_mnist::MOVING_MNIST;
use foreframe_data::dataset::sampler::{Split, Splits, WindowShape};

/// What a model is scored on.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Purpose {
    /// To choose between models and settings: the validation split.
    Validation,
    /// To publish: the three held-out test sets. Choosing by them would make their scores too good.
    #[default]
    Test,
    /// To publish: all of a data set that holds nothing but test data, as the files of published benchmarks do.
    WholeSet,
}

impl Purpose {
    /// The splits that are scored, in the order of the report.
    #[must_use]
    pub fn splits(self) -> &'static [Split] {
        match self {
            Self::Validation => &[Split::Validation],
            Self::Test => &[Split::Test, Split::UnseenPairs, Split::UnseenGains],
            Self::WholeSet => &[Split::Test],
        }
    }

    /// How the data set is split for it.
    fn divide(self, dataset: &Dataset, seed: Seed) -> Splits {
        match self {
            Self::WholeSet => Splits::all_for_test(dataset),
            Self::Validation | Self::Test => Splits::new(dataset, seed),
        }
    }
}

/// Training windows among which the nearest-window baseline looks, unless other numbers are asked for.
pub const NEAREST_WINDOWS: usize = 15_000;

/// What to test on, and how closely.
#[derive(Clone)]
pub struct EvaluateConfig<'a> {
    /// Which part of the data set.
    pub purpose: Purpose,
    /// Seed of the split; that of the model's training if none is given.
    pub split_seed: Option<Seed>,
    /// Frames from the start of one window to that of the next.
    pub stride: usize,
    /// Windows of each set at most, evenly spread over its trials.
    pub max_windows: usize,
    /// Training windows among which the baseline looks for the nearest one, at most, evenly spread.
    pub nearest_windows: usize,
    /// Resamples for the intervals.
    pub bootstrap_samples: usize,
    /// Seed of the resamples and of the shuffled actions.
    pub seed: Seed,
    /// Windows that go through the model at once.
    pub batch: usize,
    /// Models trained with the same budget without the action, without the state or without both, for the action table.
    pub twins: Vec<&'a LoadedModel>,
    /// Other data sets, which the model's novelty must tell from the scored windows.
    pub novel: Vec<&'a Dataset>,
    /// The command line, for the stamp.
    pub command: String,
    /// Set by another thread to stop the evaluation.
    pub cancelled: Option<&'a AtomicBool>,
}

impl Default for EvaluateConfig<'_> {
    fn default() -> Self {
        Self {
            purpose: Purpose::default(),
            split_seed: None,
            stride: 1,
            max_windows: 2000,
            nearest_windows: NEAREST_WINDOWS,
            bootstrap_samples: 1000,
            seed: Seed(0),
            batch: 64,
            twins: Vec::new(),
            novel: Vec::new(),
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
            ("the number of training windows to search", self.nearest_windows, 1),
            ("the number of bootstrap samples", self.bootstrap_samples, 100),
            ("the batch size", self.batch, 1),
        ] {
            if value < least {
                return Err(EvaluationError::Setting { setting, value, least });
            }
        }
        Ok(())
    }

    /// What a pass over this split needs besides its windows.
    fn watched<'a>(
        &'a self,
        split: Split,
        on_progress: &'a (dyn Fn(EvaluationProgress) + Sync),
    ) -> EvaluationContext<'a> {
        EvaluationContext {
            split,
            batch: self.batch,
            bootstrap: Bootstrap {
                samples: self.bootstrap_samples,
                seed: self.seed,
            },
            on_progress,
            cancelled: self.cancelled,
        }
    }
}

/// What is being computed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum EvaluationStage {
    /// Model and baselines, frame by frame.
    Scores,
    /// The action table.
    Actions,
    /// Plan identification.
    Plans,
    /// Expected errors and novelty.
    Calibration,
}

impl EvaluationStage {
    /// The stage in a word.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Scores => "scores",
            Self::Actions => "actions",
            Self::Plans => "plans",
            Self::Calibration => "calibration",
        }
    }
}

/// Progress of the evaluation.
#[derive(Clone, Copy, Debug)]
pub struct EvaluationProgress {
    /// The set.
    pub split: Split,
    /// What is being computed.
    pub stage: EvaluationStage,
    /// Windows done.
    pub done: usize,
    /// Windows in all.
    pub total: usize,
}

/// What every pass over a set needs besides its windows.
pub struct EvaluationContext<'a> {
    split: Split,
    batch: usize,
    bootstrap: Bootstrap,
    on_progress: &'a (dyn Fn(EvaluationProgress) + Sync),
    cancelled: Option<&'a AtomicBool>,
}

impl EvaluationContext<'_> {
    /// Reports progress. Errors: `Cancelled` if the evaluation is to stop.
    fn report(&self, stage: EvaluationStage, done: usize, total: usize) -> Result<(), EvaluationError> {
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

/// Scores the model on the splits that [`EvaluateConfig::purpose`] names: the validation split, the three test sets
/// (trials, start/goal pairs and gains that training never saw), or the whole data set. Errors: model and data set that
/// don't fit together, settings out of range, nothing held out, `TrainedOn`, `Cancelled`, those of the network.
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
    for twin in &config.twins {
        actions::twin_variant(loaded, twin)?;
        compatible::check(twin, dataset)?;
        compatible::split_seed(twin, dataset, Some(split_seed))?;
    }
    if config.purpose == Purpose::WholeSet {
        compatible::check_untrained(loaded, dataset)?;
    }
    let splits = config.purpose.divide(dataset, split_seed);
    let tests = config.purpose.splits();
    if tests.iter().all(|&split| splits.episodes(split).is_empty()) {
        return Err(EvaluationError::NothingHeldOut {
            dataset: dataset.info().name.clone(),
            split_seed: split_seed.0,
        });
    }
    let spec = loaded.model.spec();
    let mut baselines = fitted_baselines(loaded, (dataset, &splits), config)?;
    if spec.flow().is_some() {
        // Its codes are the frames themselves, so there is no codec to measure.
        baselines = baselines.without(Method::CodecOnly);
    }
    let (mut sets, mut own_novelty) = (Vec::new(), Vec::new());
    for &split in tests {
        let watched = config.watched(split, on_progress);
        let (outcome, novelty) = score_split(loaded, (dataset, &splits), config, &baselines, &watched)?;
        sets.push(SetReport {
            split: split.name().to_owned(),
            outcome,
        });
        // Other data sets are compared with the first set that was scored.
        if own_novelty.is_empty() {
            own_novelty = novelty;
        }
    }
    Ok(EvaluationReport {
        novelty: compare_novelty(loaded, config, &own_novelty, on_progress)?,
        stamp: ReportStamp::new(loaded, dataset, split_seed, config, started.elapsed()),
        model: ModelSummary::of(loaded),
        sets,
        figures: Vec::new(),
    })
}

/// The baselines for this data set. Where all of it is for testing, they are fitted to its own frames, and there is no
/// training window to find. Errors: those of [`Splits::windows`].
fn fitted_baselines(
    loaded: &LoadedModel,
    (dataset, splits): (&Dataset, &Splits),
    config: &EvaluateConfig,
) -> Result<Baselines, EvaluationError> {
    let shape = window_shape(loaded.model.spec());
    let mut baselines = match config.purpose {
        Purpose::WholeSet => {
            let own = Splits::new(dataset, loaded.manifest.dataset.split_seed);
            Baselines::fit(dataset, &own, shape, config.nearest_windows)?.without(Method::NearestWindow)
        }
        _ => Baselines::fit(dataset, splits, shape, config.nearest_windows)?,
    };
    let of = |scenario: &Option<String>| scenario.as_deref() == Some(MOVING_MNIST);
    if of(&loaded.manifest.dataset.scenario) || of(&dataset.info().scenario) {
        baselines = baselines.for_benchmark();
    }
    Ok(baselines)
}

/// How well novelty tells the other data sets from the windows with the novelty `own`.
fn compare_novelty(
    loaded: &LoadedModel,
    config: &EvaluateConfig,
    own: &[f64],
    on_progress: &(dyn Fn(EvaluationProgress) + Sync),
) -> Result<Vec<NoveltyScores>, EvaluationError> {
    let Some(calibration) = &loaded.manifest.calibration else {
        return match config.novel.first() {
            Some(_) => Err(EvaluationError::NotCalibrated {
                model: loaded.manifest.name.clone(),
            }),
            None => Ok(Vec::new()),
        };
    };
    let watched = config.watched(Split::Test, on_progress);
    let compare =
        |other: &&Dataset| uncertainty::compare(loaded, calibration, (other, own, config.max_windows), &watched);
    config.novel.iter().map(compare).collect()
}

/// The windows that a model of that specification takes.
fn window_shape(spec: &ModelSpec) -> WindowShape {
    WindowShape {
        context: spec.context,
        horizon: spec.horizon,
    }
}

/// Scores one set; also gives the novelty of its windows, if the model is calibrated.
fn score_split(
    loaded: &LoadedModel,
    (dataset, splits): (&Dataset, &Splits),
    config: &EvaluateConfig,
    baselines: &Baselines,
    watched: &EvaluationContext,
) -> Result<(SetOutcome, Vec<f64>), EvaluationError> {
    let spec = loaded.model.spec();
    let available = splits.windows(dataset, watched.split, window_shape(spec), config.stride)?;
    if available.is_empty() {
        let reason = match watched.split {
            Split::UnseenPairs => "the data set has no trials with held-out start/goal pairs",
            Split::UnseenGains => "the data set has no trials with held-out gains",
            _ => "the split has no trials; collect more",
        };
        let reason = reason.to_owned();
        return Ok((SetOutcome::Skipped { reason }, Vec::new()));
    }
    let windows = score::evenly(&available, config.max_windows);
    let windows_scored = score::score(loaded, dataset, &windows, baselines, watched)?;
    let mut scores = SetScores::new(baselines.methods(), &windows_scored, &watched.bootstrap);
    if baselines.are_of_benchmark() {
        metrics::add_benchmark(&mut scores.methods, &windows_scored, spec.pixels());
    }
    scores.windows_available = available.len();
    if spec.action_inputs().is_some() {
        let errors = actions::compare(loaded, &config.twins, dataset, &windows, watched)?;
        let frames = window_shape(spec).frames();
        let group_of: Vec<usize> = windows
            .iter()
            .map(|&window| bootstrap::resampled_with(dataset, window, frames))
            .collect();
        scores.actions = Some(actions::table(&errors, &group_of, &watched.bootstrap));
        scores.plans = Some(plans::identify(loaded, dataset, &windows, watched)?);
    }
    let mut novelty = Vec::new();
    if let Some(calibration) = &loaded.manifest.calibration {
        let (measured, found) = uncertainty::measure(loaded, calibration, (dataset, &windows), watched)?;
        scores.uncertainty = Some(measured);
        novelty = found;
    }
    Ok((SetOutcome::Scored(Box::new(scores)), novelty))
}
