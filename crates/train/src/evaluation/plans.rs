//! Plan identification: does the model tell what each of several plans would lead to? The simulator carries each plan out from the
//! same context, which gives the true frames; the model predicts the frames of each. Counted is how often the true frames after a
//! plan are nearest to the prediction for it.

use rand::Rng;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::EvaluationError;
use super::bootstrap::{Interval, TrialSums};
use super::inference::{ActionSource, Inference};
use super::progress::{EvaluationContext, EvaluationStage, Pass};
use super::replay::{action, replayed};
use super::windows::evenly;
use foreframe_core::frame::preprocess::scale;
use foreframe_core::frame::quality;
use foreframe_core::nn::ModelSpec;
use foreframe_core::types::Seed;
use foreframe_data::dataset::{Dataset, Window};
use foreframe_sim::WorldConfig;

/// Plans at each context: the one that was carried out, and those of other windows.
const PLANS: usize = 8;
/// Contexts at most, evenly spread over the windows.
const MAX_CONTEXTS: usize = 60;

/// How often plans were identified, or why that was not measured.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "status", rename_all = "kebab-case")]
pub enum PlanOutcome {
    /// It was measured.
    Measured(PlanIdentification),
    /// It could not be measured.
    Skipped {
        /// Why.
        reason: String,
    },
}

/// How often the true frames after a plan are nearest to the prediction for that plan.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PlanIdentification {
    /// Contexts at which the simulator branched.
    pub contexts: usize,
    /// Plans at each context.
    pub plans: usize,
    /// Share of the plans whose true frames are nearest to their own prediction.
    pub rate: f64,
    /// Its 95 % bootstrap interval over trials; absent with fewer than two trials.
    pub interval: Option<Interval>,
    /// The share that guessing gives.
    pub chance: f64,
}

/// The true frames of a context under each plan; each `horizon` frames, 0…1. None if the replay differs.
type TrueFrames = Option<Vec<Vec<f32>>>;

/// The contexts at which plans are compared, with the plans: its own first.
fn contexts(windows: &[Window], seed: Seed) -> Vec<(Window, Vec<Window>)> {
    let contexts = (0..).zip(evenly(windows, MAX_CONTEXTS));
    let contexts = contexts.map(|(index, own)| (own, plans_of(own, windows, seed.derive("plans", index))));
    contexts.collect()
}

/// Why plans cannot be compared, if they cannot.
fn why_skipped(dataset: &Dataset, windows: &[Window]) -> Option<&'static str> {
    let drives = |window: &Window| {
        let trial = dataset.episodes()[window.episode].trial.as_ref();
        trial.is_some_and(|trial| trial.scenario.observer_drives())
    };
    if dataset.info().world.is_none() {
        return Some("the data set is a recording, so no other plan can be tried");
    }
    if windows.len() < PLANS {
        return Some("there are fewer windows than plans to compare");
    }
    (!windows.iter().all(drives)).then_some("the camera stands still in this scenario, whatever the plan")
}

/// For each context the share of the plans that a model which takes actions identifies; `None` if the simulator does not
/// reproduce the context, and nothing if plans cannot be compared. Errors: those of the network and the simulator, `Cancelled`.
pub(super) fn identify(
    evaluation: &EvaluationContext,
    windows: &[Window],
) -> Result<Vec<Option<f64>>, EvaluationError> {
    let (inference, config) = (evaluation.inference, evaluation.config);
    let (dataset, spec) = (inference.dataset, inference.spec());
    let world = dataset.info().world.as_ref();
    let Some(world) = world.filter(|_| why_skipped(dataset, windows).is_none()) else {
        return Ok(Vec::new());
    };
    let pass = Pass {
        batch: (config.batch / PLANS).max(1),
        ..evaluation.pass(EvaluationStage::Plans)
    };
    evaluation.in_divided_batches(pass, &contexts(windows, config.seed), |contexts| {
        let truths = contexts.par_iter();
        let truths = truths.map(|(context, plans)| true_frames_of(inference, world, *context, plans));
        let Some(truths) = truths.collect::<Result<Option<Vec<_>>, EvaluationError>>()? else {
            return Ok(vec![None; contexts.len()]);
        };
        let repeated: Vec<Window> = contexts.iter().flat_map(|&(context, _)| [context; PLANS]).collect();
        let plans: Vec<Window> = contexts.iter().flat_map(|(_, plans)| plans).copied().collect();
        let predicted = inference.predict(&repeated, ActionSource::OfWindows(&plans))?.frames;
        let predicted = predicted.par_chunks_exact(PLANS * spec.horizon * spec.pixels());
        let shares = predicted.zip(&truths);
        Ok(shares
            .map(|(predicted, truths)| Some(share_identified(spec, predicted, truths)))
            .collect())
    })
}

/// The rate over all contexts, from the shares that [`identify`] gives for these windows.
pub(super) fn outcome(evaluation: &EvaluationContext, windows: &[Window], shares: &[Option<f64>]) -> PlanOutcome {
    let (dataset, config) = (evaluation.inference.dataset, evaluation.config);
    let skipped = |reason: &str| PlanOutcome::Skipped {
        reason: reason.to_owned(),
    };
    if let Some(reason) = why_skipped(dataset, windows) {
        return skipped(reason);
    }
    let Some(identified) = shares.iter().copied().collect::<Option<Vec<f64>>>() else {
        return skipped("the simulator no longer reproduces the frames of this data set");
    };
    let contexts = evenly(windows, MAX_CONTEXTS);
    let trial_of: Vec<usize> = contexts.iter().map(|context| context.episode).collect();
    let trials = TrialSums::group(&trial_of, identified.iter().map(|&share| [share]));
    let interval = trials.intervals(&config.bootstrap(), <[f64]>::to_vec);
    PlanOutcome::Measured(PlanIdentification {
        contexts: contexts.len(),
        plans: PLANS,
        rate: trials.means()[0],
        interval: interval.map(|all| all[0]),
        chance: 1.0 / PLANS as f64,
    })
}

/// The windows whose actions are the plans at a context: its own first, then others drawn at random.
fn plans_of(own: Window, windows: &[Window], seed: Seed) -> Vec<Window> {
    let mut rng = seed.rng();
    let mut plans = vec![own];
    while plans.len() < PLANS {
        let drawn = windows[rng.random_range(0..windows.len())];
        if !plans.contains(&drawn) {
            plans.push(drawn);
        }
    }
    plans
}

/// Replays the trial up to the context's last frame, once for each plan, and carries the plan out.
fn true_frames_of(
    inference: Inference,
    world: &WorldConfig,
    context: Window,
    plans: &[Window],
) -> Result<TrueFrames, EvaluationError> {
    let spec = inference.spec();
    let mut truths = Vec::with_capacity(plans.len());
    for plan in plans {
        let Some(mut branch) = replayed(inference, world, context)? else {
            return Ok(None);
        };
        let first_action = plan.first_frame + spec.context - 1;
        let mut truth = Vec::with_capacity(spec.horizon * spec.pixels());
        for frame in first_action..first_action + spec.horizon {
            let result = branch.step(&action(inference.dataset, frame)?)?;
            let pixels = result.observation.frame.pixels();
            truth.extend(scale(&inference.dataset.in_its_light(pixels)));
        }
        truths.push(truth);
    }
    Ok(Some(truths))
}

/// The share of the plans whose true frames are nearest to their own prediction.
fn share_identified(spec: &ModelSpec, predicted: &[f32], truths: &[Vec<f32>]) -> f64 {
    let predicted = predicted.chunks_exact(spec.horizon * spec.pixels());
    let predicted: Vec<Vec<f32>> = predicted.map(|frames| spec.preprocess.inverse(frames)).collect();
    let is_own = |&plan: &usize| {
        let error = |other: usize| quality::mse(&predicted[other], &truths[plan]);
        let own = error(plan);
        (0..predicted.len()).all(|other| other == plan || own < error(other))
    };
    (0..truths.len()).filter(is_own).count() as f64 / truths.len().max(1) as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_plan_counts_only_if_its_own_prediction_is_nearest() {
        let spec = ModelSpec {
            frame_width_px: 1,
            frame_height_px: 1,
            horizon: 2,
            preprocess: foreframe_core::frame::preprocess::Preprocess {
                blur_sigma_px: 0.0,
                invert: false,
            },
            ..ModelSpec::default()
        };
        let truths = [vec![0.1, 0.1], vec![0.5, 0.5], vec![0.9, 0.9]];
        assert_eq!(share_identified(&spec, &[0.1, 0.2, 0.5, 0.4, 0.8, 0.9], &truths), 1.0);
        assert!((share_identified(&spec, &[0.5, 0.5, 0.1, 0.1, 0.9, 0.9], &truths) - 1.0 / 3.0).abs() < 1e-9);
        assert_eq!(
            share_identified(&spec, &[0.5; 6], &truths),
            0.0,
            "equal predictions identify nothing"
        );
    }

    #[test]
    fn the_plans_at_a_context_differ_and_its_own_is_first() {
        let windows: Vec<Window> = (0..10)
            .map(|frame| Window {
                episode: 0,
                first_frame: frame,
            })
            .collect();
        let plans = plans_of(windows[4], &windows, Seed(1));
        let mut distinct = plans.clone();
        distinct.sort_unstable();
        distinct.dedup();
        assert_eq!((plans[0], distinct.len()), (windows[4], PLANS));
    }
}
