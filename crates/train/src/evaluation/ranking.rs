//! Would a planner choose what was driven? A recording shows only what followed on its own actions. Where its actions
//! change most, the camera's picture at the end is taken as a goal image: among the driven plan, the same mirrored, and plans of other
//! windows, how often does the model predict that picture best under the driven one?

use rand::Rng;
use serde::{Deserialize, Serialize};

use super::EvaluationError;
use super::bootstrap::{Bootstrap, Interval, TrialSums, is_recording};
use super::inference::{ActionSource, Inference};
use super::progress::{EvaluationContext, EvaluationStage, Pass};
use super::windows::true_frame;
use foreframe_core::frame::quality;
use foreframe_core::types::Seed;
use foreframe_data::dataset::Window;

/// Plans among which the driven one is ranked, and the places that count: top-1 of 8, top-5 of 64.
const RANKINGS: [(usize, usize); 2] = [(8, 1), (64, 5)];
/// Plans that are predicted for each moment: enough for the largest ranking.
const PLANS: usize = RANKINGS[1].0;
/// A quarter of the windows are moments: those in which the actions change most.
const MOMENT_SHARE: usize = 4;
/// Moments at most.
const MAX_MOMENTS: usize = 120;

/// How often the driven plan is ranked among the first.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PlanRanking {
    /// Moments at which plans were compared.
    pub moments: usize,
    /// Whether the mirrored plan was among them.
    pub has_mirrored: bool,
    /// Top-1 of 8, then top-5 of 64.
    pub rates: Vec<RankingRate>,
}

/// The ranking among a given number of plans.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RankingRate {
    /// Plans that were compared.
    pub plans: usize,
    /// A rank up to this one counts.
    pub top: usize,
    /// The share of the moments.
    pub rate: f64,
    /// Its 95 % bootstrap interval over blocks; absent with fewer than two blocks.
    pub interval: Option<Interval>,
    /// The share that guessing gives.
    pub chance: f64,
}

/// For each moment and ranking, how many other plans are at least as good as the driven one. Empty if the data set is no
/// recording or has too few windows. Errors: those of the network, `Cancelled`.
pub(super) fn rank(evaluation: &EvaluationContext, windows: &[Window]) -> Result<Vec<Vec<usize>>, EvaluationError> {
    let inference = evaluation.inference;
    let length = inference.spec().context + inference.spec().horizon;
    // At each moment there are enough windows that do not overlap with its own.
    if !is_recording(inference.dataset) || windows.len() < PLANS + 2 * length {
        return Ok(Vec::new());
    }
    let mirrored = mirrored_channels(inference);
    let moments = moments(inference, windows);
    let moments: Vec<(Window, Seed)> = (0..)
        .zip(moments)
        .map(|(index, moment)| (windows[moment], evaluation.config.seed.derive("ranking", index)))
        .collect();
    let pass = Pass {
        batch: 1,
        ..evaluation.pass(EvaluationStage::Ranking)
    };
    evaluation.in_divided_batches(pass, &moments, |moments| {
        let rank = |&(moment, seed)| {
            let plans = plans(inference, (moment, windows), &mirrored, seed);
            better_plans(evaluation, moment, &plans)
        };
        moments.iter().map(rank).collect()
    })
}

/// The rates. `better`: what [`rank`] gives for these windows; `group_of`: the block of each window.
pub(super) fn rates(
    evaluation: &EvaluationContext,
    windows: &[Window],
    group_of: &[usize],
    better: &[Vec<usize>],
    bootstrap: &Bootstrap,
) -> Option<PlanRanking> {
    if better.is_empty() {
        return None;
    }
    let inference = evaluation.inference;
    let own: Vec<usize> = moments(inference, windows)
        .into_iter()
        .map(|moment| group_of[moment])
        .collect();
    let row = |better: &Vec<usize>| -> Vec<f64> {
        let pairs = better.iter().zip(RANKINGS);
        pairs
            .map(|(&better, (_, top))| f64::from(u8::from(better < top)))
            .collect()
    };
    let sums = TrialSums::group(&own, better.iter().map(row));
    let (means, intervals) = (sums.means(), sums.intervals(bootstrap, <[f64]>::to_vec));
    let rate = |(index, (plans, top)): (usize, (usize, usize))| RankingRate {
        plans,
        top,
        rate: means[index],
        interval: intervals.as_ref().map(|all| all[index]),
        chance: top as f64 / plans as f64,
    };
    Some(PlanRanking {
        moments: better.len(),
        has_mirrored: !mirrored_channels(inference).is_empty(),
        rates: RANKINGS.into_iter().enumerate().map(rate).collect(),
    })
}

/// The action channels whose sign a mirror changes: those that the training mirrored, or the turning speeds.
fn mirrored_channels(inference: Inference) -> Vec<usize> {
    let manifest = &inference.loaded.manifest;
    let named = manifest.training["data"]["mirror"].as_array();
    let is_mirrored = |(name, unit): (&str, &str)| {
        unit == "rad/s" || named.is_some_and(|names| names.iter().any(|own| own.as_str() == Some(name)))
    };
    let channels = inference.spec().actions.iter().enumerate();
    channels
        .filter(|(_, channel)| is_mirrored((&channel.name, &channel.unit)))
        .map(|(index, _)| index)
        .collect()
}

/// Positions of the windows whose actions change most from the one before, in the order of the windows.
fn moments(inference: Inference, windows: &[Window]) -> Vec<usize> {
    let mut by_change: Vec<(f32, usize)> = windows
        .iter()
        .enumerate()
        .map(|(position, &window)| (change(inference, window), position))
        .collect();
    by_change.sort_by(|one, two| two.0.total_cmp(&one.0).then(one.1.cmp(&two.1)));
    by_change.truncate(windows.len() / MOMENT_SHARE);
    let mut moments: Vec<usize> = by_change.into_iter().map(|(_, position)| position).collect();
    moments.sort_unstable();
    let count = moments.len().min(MAX_MOMENTS);
    (0..count).map(|nth| moments[nth * moments.len() / count]).collect()
}

/// The sum of the squared changes of a window's actions from the one that led to the last frame seen, in the channels' spread.
fn change(inference: Inference, window: Window) -> f32 {
    let spec = inference.spec();
    let last = window.first_frame + spec.context - 1;
    let before = inference.dataset.action(last.saturating_sub(1).max(window.first_frame));
    let squares = (last..last + spec.horizon).flat_map(|frame| {
        let pairs = inference.dataset.action(frame).iter().zip(before).zip(&spec.actions);
        pairs.map(|((now, before), channel)| ((now - before) / channel.std.max(1e-3)).powi(2))
    });
    squares.sum()
}

/// The actions of the plans of a moment: its own, the same mirrored, then those of other windows, each at most once.
fn plans(inference: Inference, (own, windows): (Window, &[Window]), mirrored: &[usize], seed: Seed) -> Vec<f32> {
    let spec = inference.spec();
    let driven = actions_of(inference, own);
    let mut plans = driven.clone();
    if !mirrored.is_empty() {
        for action in driven.chunks_exact(spec.actions.len()) {
            let sign = |channel: usize| if mirrored.contains(&channel) { -1.0 } else { 1.0 };
            plans.extend(action.iter().enumerate().map(|(channel, value)| sign(channel) * value));
        }
    }
    // Windows that overlap were driven nearly alike.
    let length = spec.context + spec.horizon;
    let is_apart = |other: &&Window| other.first_frame.abs_diff(own.first_frame) >= length;
    let mut others: Vec<Window> = windows.iter().filter(is_apart).copied().collect();
    let mut rng = seed.rng();
    for nth in 0..PLANS - plans.len() / driven.len() {
        let drawn = rng.random_range(nth..others.len());
        others.swap(nth, drawn);
        plans.extend(actions_of(inference, others[nth]));
    }
    plans
}

/// Predicts the plans of a moment; of each ranking, how many other plans predict the last picture at least as well as the driven one.
fn better_plans(evaluation: &EvaluationContext, own: Window, plans: &[f32]) -> Result<Vec<usize>, EvaluationError> {
    let inference = evaluation.inference;
    let spec = inference.spec();
    let truth = true_frame(inference.dataset, own.first_frame + spec.context + spec.horizon - 1)?;
    let mut errors = Vec::with_capacity(PLANS);
    for plans in plans.chunks(evaluation.config.batch * plans.len() / PLANS) {
        let repeated = vec![own; plans.len() / (spec.horizon * spec.actions.len())];
        let predicted = inference.predict(&repeated, ActionSource::Given(plans))?.frames;
        errors.extend(predicted.chunks_exact(spec.horizon * spec.pixels()).map(|frames| {
            let last = &frames[(spec.horizon - 1) * spec.pixels()..];
            quality::mse(&spec.preprocess.inverse(last), &truth)
        }));
    }
    Ok(RANKINGS.map(|(plans, _)| as_good(&errors[..plans])).into())
}

/// How many of the other plans are at least as good as the first.
fn as_good(errors: &[f64]) -> usize {
    errors[1..].iter().filter(|&&error| error <= errors[0]).count()
}

fn actions_of(inference: Inference, window: Window) -> Vec<f32> {
    let last = window.first_frame + inference.spec().context - 1;
    let frames = last..last + inference.spec().horizon;
    frames
        .flat_map(|frame| inference.dataset.action(frame))
        .copied()
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_equal_prediction_does_not_count_as_worse() {
        assert_eq!(as_good(&[0.2, 0.3, 0.2, 0.1, 0.5]), 2);
        assert_eq!(as_good(&[0.0, 0.1]), 0);
        assert_eq!(as_good(&[0.5; 8]), 7, "a model that ignores actions chooses nothing");
    }
}
