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
mod config;
mod error;
pub mod figures;
mod file;
mod forecast;
pub mod inference;
mod markdown;
pub mod method;
pub mod metrics;
mod output;
pub mod plans;
mod progress;
pub mod report;
mod samples;
pub mod score;
pub mod skill;
pub mod uncertainty;
mod windows;

use std::time::Instant;

pub use self::calibrate::{calibrate, calibrate_trained};
pub use self::config::{EvaluateConfig, NEAREST_WINDOWS, ScoredSplit};
pub use self::error::EvaluationError;
pub use self::output::{prepare, write};
pub use self::progress::{EvaluationContext, EvaluationProgress, EvaluationStage};
pub use self::report::EvaluationReport;
pub use self::samples::figure_inputs;

use self::baselines::Baselines;
use self::method::Method;
use self::report::{ModelSummary, ReportStamp, SetOutcome, SetReport, SetScores};
use self::uncertainty::NoveltyScores;
use self::windows::{evenly, window_shape};
use foreframe_core::registry::Model;
use foreframe_data::dataset::Dataset;
use foreframe_data::dataset::moving_mnist::MOVING_MNIST;
use foreframe_data::dataset::sampler::{Split, Splits};

/// Scores the model on the splits that [`EvaluateConfig::split`] names: the validation split, the three test sets
/// (trials, start/goal pairs and gains that training never saw), or the whole data set. Errors: model and data set that
/// don't fit together, settings out of range, nothing held out, `TrainedOn`, `Cancelled`, those of the network.
pub fn run(
    loaded: &Model,
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
    if config.split == ScoredSplit::WholeSet {
        compatible::check_untrained(loaded, dataset)?;
    }
    let splits = config.split.divide(dataset, split_seed);
    let tests = config.split.splits();
    if tests.iter().all(|&split| splits.episodes(split).is_empty()) {
        return Err(EvaluationError::NothingHeldOut {
            dataset: dataset.info().name.clone(),
            split_seed: split_seed.0,
        });
    }
    let spec = loaded.spec();
    let mut baselines = fitted_baselines(loaded, dataset, &splits, config)?;
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
    loaded: &Model,
    dataset: &Dataset,
    splits: &Splits,
    config: &EvaluateConfig,
) -> Result<Baselines, EvaluationError> {
    let shape = window_shape(loaded.spec());
    let mut baselines = match config.split {
        ScoredSplit::WholeSet => {
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
    loaded: &Model,
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

/// Scores one set; also gives the novelty of its windows, if the model is calibrated.
fn score_split(
    loaded: &Model,
    (dataset, splits): (&Dataset, &Splits),
    config: &EvaluateConfig,
    baselines: &Baselines,
    watched: &EvaluationContext,
) -> Result<(SetOutcome, Vec<f64>), EvaluationError> {
    let spec = loaded.spec();
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
    let windows = evenly(&available, config.max_windows);
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
        let (measured, found) = uncertainty::measure(loaded, calibration, dataset, &windows, watched)?;
        scores.uncertainty = Some(measured);
        novelty = found;
    }
    Ok((SetOutcome::Scored(Box::new(scores)), novelty))
}
