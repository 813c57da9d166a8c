//! From a model and a data set to a report that can be trusted: [`run`] scores the model against simple baselines on
//! trials that training never saw, [`draw_figures`] draws what the report shows, [`write()`] writes both into a directory.
//!
//! Frames are compared as the camera saw them: intensities 0…1, neither inverted nor smoothed.

pub mod actions;
mod baselines;
pub mod bootstrap;
mod calibrate;
mod camera_estimate;
mod compatible;
mod config;
mod division;
pub mod drive;
mod error;
pub mod figures;
mod forecast;
mod html;
mod inference;
mod least_squares;
mod markdown;
mod measurements;
pub mod method;
pub mod metrics;
mod novelty_scale;
mod output;
pub mod pixel_class;
pub mod plans;
mod progress;
pub mod ranking;
mod replay;
pub mod report;
mod score;
pub mod skill;
mod statistics;
pub mod surroundings;
pub mod uncertainty;
mod unseen;
mod verdict;
mod visibility;
mod window_errors;
mod windows;

use std::time::Instant;

pub use self::calibrate::{calibrate, calibrate_trained};
#[doc(hidden)]
pub use self::camera_estimate::{CameraEstimate, estimate_camera};
pub use self::compatible::check_fit;
#[doc(hidden)]
pub use self::compatible::check_saving;
#[doc(hidden)]
pub use self::config::MIN_RESAMPLES;
pub use self::config::{EvaluateConfig, NEAREST_WINDOWS, ScoredSplit};
#[doc(hidden)]
pub use self::division::EvaluationPart;
pub use self::error::EvaluationError;
pub use self::figures::draw_figures;
pub use self::html::html_page;
pub use self::output::{prepare, write};
pub use self::progress::{EvaluationProgress, EvaluationStage};
pub use self::report::EvaluationReport;
#[doc(hidden)]
pub use self::unseen::{widen_for_unseen, widen_like};
#[doc(hidden)]
pub use self::window_errors::{copied_errors, window_errors, windows_of};

use self::baselines::Baselines;
use self::bootstrap::is_recording;
use self::division::Division;
use self::inference::Inference;
use self::measurements::Measurements;
use self::method::Method;
use self::progress::EvaluationContext;
use self::report::{ModelSummary, NearestSummary, ReportStamp, SetOutcome, SetReport};
use self::windows::{evenly, window_shape};
use foreframe_core::registry::Model;
use foreframe_core::types::Seed;
use foreframe_data::dataset::moving_mnist::MOVING_MNIST;
use foreframe_data::dataset::sampler::{Split, Splits};
use foreframe_data::dataset::{Dataset, Window};

/// What a part saves of how the nearest windows are weighed, which takes as long as scoring hundreds of windows.
const NEAREST: &str = "nearest-windows";

/// Scores the model on the splits that [`EvaluateConfig::split`] names: the validation split, the three test sets
/// (trials, start/goal pairs and gains that training never saw), or the whole data set. Rooms that are only for tests are
/// scored as a whole. Errors: model and data set that don't fit together, settings out of range, nothing held out,
/// `TrainedOn`, `TrainedOnFrames`, `Cancelled`, those of the network.
pub fn run(
    loaded: &Model,
    dataset: &Dataset,
    config: &EvaluateConfig,
    on_progress: &(dyn Fn(EvaluationProgress) + Sync),
) -> Result<EvaluationReport, EvaluationError> {
    let started = Instant::now();
    let held_out = HeldOut::of(loaded, dataset, config)?;
    let HeldOut {
        config, splits, tests, ..
    } = &held_out;
    let division = Division::joined(held_out.inputs(loaded, dataset), &config.saved);
    let mut evaluation = held_out.context(Inference { loaded, dataset }, &division, on_progress);
    let baselines = fitted_baselines(&evaluation, splits)?;
    let (mut sets, mut own_novelty) = (Vec::new(), Vec::new());
    for &split in *tests {
        evaluation.split = split;
        let (outcome, novelty) = score_split(&evaluation, splits, &baselines)?;
        sets.push(SetReport {
            split: config.split.set_name(dataset, split).to_owned(),
            outcome,
        });
        // Other data sets are compared with the first set that was scored.
        if own_novelty.is_empty() {
            own_novelty = novelty;
        }
    }
    let undivided = Division::default();
    let compare = |&novel: &&Dataset| {
        let Some(calibration) = &loaded.manifest.calibration else {
            let model = loaded.manifest.name.clone();
            return Err(EvaluationError::NotCalibrated { model });
        };
        let novel = EvaluationContext {
            inference: Inference { loaded, dataset: novel },
            split: Split::Test,
            division: &undivided,
            ..evaluation
        };
        uncertainty::compare(&novel, calibration, &own_novelty)
    };
    Ok(EvaluationReport {
        novelty: config.novel.iter().map(compare).collect::<Result<_, _>>()?,
        stamp: ReportStamp::new(&evaluation, held_out.split_seed, started.elapsed()),
        model: ModelSummary::of(loaded),
        nearest_windows: baselines.nearest_summary(),
        sets,
        figures: Vec::new(),
    })
}

/// Computes a part of an evaluation, or continues it: its share of what [`run`] computes with the same `config`, in its directory.
/// [`EvaluateConfig::saved`] then names the directories of all parts. What is missing there is computed by [`run`], so the report
/// is the same in every case. Errors: as [`run`], and `Io`.
#[doc(hidden)]
pub fn run_part(
    loaded: &Model,
    dataset: &Dataset,
    config: &EvaluateConfig,
    part: &EvaluationPart,
    on_progress: &(dyn Fn(EvaluationProgress) + Sync),
) -> Result<(), EvaluationError> {
    let held_out = HeldOut::of(loaded, dataset, config)?;
    let division = Division::of_part(held_out.inputs(loaded, dataset), part);
    let mut evaluation = held_out.context(Inference { loaded, dataset }, &division, on_progress);
    let baselines = fitted_baselines(&evaluation, &held_out.splits)?;
    for &split in held_out.tests {
        evaluation.split = split;
        let available = available_windows(&evaluation, &held_out.splits)?;
        if why_skipped(dataset, split, &available).is_none() {
            Measurements::of(&evaluation, &evenly(&available, config.max_windows), &baselines)?;
        }
    }
    Ok(())
}

/// What is scored: the splits that training did not see.
struct HeldOut<'a> {
    config: EvaluateConfig<'a>,
    split_seed: Seed,
    splits: Splits,
    tests: &'static [Split],
}

impl<'a> HeldOut<'a> {
    /// Errors: model, twins and data set that don't fit together, settings out of range, nothing held out, `TrainedOn`,
    /// `TrainedOnFrames`.
    fn of(loaded: &Model, dataset: &Dataset, config: &EvaluateConfig<'a>) -> Result<Self, EvaluationError> {
        config.validate()?;
        compatible::check(loaded, dataset)?;
        let split_seed = compatible::split_seed(loaded, dataset, config.split_seed)?;
        for twin in &config.twins {
            actions::twin_variant(loaded, twin)?;
            compatible::check(twin, dataset)?;
            compatible::split_seed(twin, dataset, Some(split_seed))?;
        }
        let config = EvaluateConfig {
            split: config.split.of(loaded, dataset),
            ..config.clone()
        };
        let splits = config.split.divide(dataset, split_seed);
        let mut tests = config.split.splits();
        if is_recording(dataset) {
            // A recording has no starts, goals or gains that could be held out.
            tests = tests.get(..1).unwrap_or(tests);
        }
        if tests.iter().all(|&split| splits.episodes(split).is_empty()) {
            return Err(EvaluationError::NothingHeldOut {
                dataset: dataset.info().name.clone(),
                split_seed: split_seed.0,
            });
        }
        if config.split == ScoredSplit::WholeSet {
            let windows = splits.windows(dataset, Split::Test, window_shape(loaded.spec()), config.stride)?;
            let scored = evenly(&windows, config.max_windows);
            compatible::check_untrained(loaded, dataset, &scored)?;
        }
        Ok(Self {
            config,
            split_seed,
            splits,
            tests,
        })
    }

    /// The hash of all that decides what is measured.
    fn inputs(&self, loaded: &Model, dataset: &Dataset) -> String {
        division::inputs(Inference { loaded, dataset }, &self.config, self.split_seed)
    }

    /// What the passes need; the split is set for each set.
    fn context<'b>(
        &'b self,
        inference: Inference<'b>,
        division: &'b Division<'b>,
        on_progress: &'b (dyn Fn(EvaluationProgress) + Sync),
    ) -> EvaluationContext<'b> {
        EvaluationContext {
            inference,
            split: Split::Test,
            config: &self.config,
            division,
            on_progress,
        }
    }
}

/// The baselines for this data set. Where all of it is for testing, they are fitted to its own frames, and there is no
/// training window to find. Errors: those of [`Splits::windows`], and `Io`.
fn fitted_baselines(evaluation: &EvaluationContext, splits: &Splits) -> Result<Baselines, EvaluationError> {
    let (Inference { loaded, dataset }, config) = (evaluation.inference, evaluation.config);
    let (spec, trained_on) = (loaded.spec(), &loaded.manifest.dataset);
    let known = evaluation.division.saved::<NearestSummary>(NEAREST).remove(&0);
    let known = known.and_then(|saved| saved.first().copied());
    let fit = |splits: &Splits, searched| Baselines::fit(dataset, splits, window_shape(spec), searched, known);
    let mut baselines = match config.split {
        ScoredSplit::WholeSet => fit(&Splits::new(dataset, trained_on.split_seed), 0)?,
        _ => fit(splits, config.nearest_windows)?,
    };
    if let Some(chosen) = baselines.nearest_summary().filter(|_| known.is_none()) {
        evaluation.division.save(NEAREST, 0, &[vec![chosen]])?;
    }
    let scenarios = [&trained_on.scenario, &dataset.info().scenario];
    if scenarios
        .iter()
        .any(|scenario| scenario.as_deref() == Some(MOVING_MNIST))
    {
        baselines = baselines.for_benchmark();
    }
    if spec.keeps_frames() {
        // Its codes are the frames themselves, so there is no codec to measure.
        baselines = baselines.without(Method::CodecOnly);
    }
    Ok(baselines)
}

/// Why a set is not scored, if it is not.
fn why_skipped(dataset: &Dataset, split: Split, available: &[Window]) -> Option<&'static str> {
    let mut trials = dataset.episodes().iter().filter_map(|episode| episode.trial.as_ref());
    match split {
        Split::UnseenPairs if trials.any(|trial| trial.scenario.has_several_goals()) => {
            Some("robots drive on to other goals in this scenario, so that only the first start/goal pair is held out")
        }
        _ if !available.is_empty() => None,
        Split::UnseenPairs => Some("the data set has no trials with held-out start/goal pairs"),
        Split::UnseenGains => Some("the data set has no trials with held-out gains"),
        _ => Some("the split has no trials; collect more"),
    }
}

/// All windows of the set. Errors: those of [`Splits::windows`].
fn available_windows(evaluation: &EvaluationContext, splits: &Splits) -> Result<Vec<Window>, EvaluationError> {
    let Inference { loaded, dataset } = evaluation.inference;
    let (shape, stride) = (window_shape(loaded.spec()), evaluation.config.stride);
    Ok(splits.windows(dataset, evaluation.split, shape, stride)?)
}

/// Scores one set; also gives the novelty of its windows, if the model is calibrated.
fn score_split(
    evaluation: &EvaluationContext,
    splits: &Splits,
    baselines: &Baselines,
) -> Result<(SetOutcome, Vec<f64>), EvaluationError> {
    let available = available_windows(evaluation, splits)?;
    if let Some(reason) = why_skipped(evaluation.inference.dataset, evaluation.split, &available) {
        let reason = reason.to_owned();
        return Ok((SetOutcome::Skipped { reason }, Vec::new()));
    }
    let windows = evenly(&available, evaluation.config.max_windows);
    let measured = Measurements::of(evaluation, &windows, baselines)?;
    let (mut scores, novelty) = measured.scores(evaluation, &windows, baselines);
    scores.windows_available = available.len();
    scores.frames_of_training =
        compatible::frames_of_training(evaluation.inference.loaded, evaluation.inference.dataset, &windows)?;
    if scores.has_frames_of_training() {
        // It would be read as the skill on data that the model never saw.
        scores.skill_against_unfitted = None;
    }
    Ok((SetOutcome::Scored(Box::new(scores)), novelty))
}
