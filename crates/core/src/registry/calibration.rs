//! How far a model's predictions can be trusted: the error to expect at each step, how unlike the training data a context
//! is, and the ranges of actions and states in training. All of it is stored in the manifest and is computed from numbers
//! that are known when a prediction is made. `evaluation::calibrate` fits it on the validation split.

mod at_pose;
mod context;

use serde::{Deserialize, Serialize};

pub use self::at_pose::{LookAtPose, POSE_FEATURES, pose_features};
pub use self::context::{APPEARANCE, ContextStatistics};
use crate::frame::Frame;
use crate::frame::difference::squared_difference;
use crate::nn::ModelSpec;
use crate::vectorized::vectorized;

/// Numbers from which the error of a predicted frame is estimated, see [`RolloutInContext::error_inputs`].
pub const ERROR_INPUTS: usize = 8;
/// From this novelty on, a prediction and its expected errors say nothing: the calibration was fitted on contexts that are more like
/// the training data.
pub const NOVELTY_LIMIT: f32 = 0.99;
/// Added to mean squared differences before their logarithm.
const FLOOR: f64 = 1e-6;
/// The distance of a value that is out of its range in training by the width of this range.
const OUT_OF_RANGE: f64 = 10.0;

/// What a model's validation says about its predictions.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Calibration {
    /// SHA-256 of the content of the data set.
    pub dataset_content_hash: String,
    /// Validation windows that it was fitted on.
    pub windows: usize,
    /// The error of each predicted step.
    pub steps: Vec<StepErrors>,
    /// The same where no action is known, fitted without states too, for models that can do without; else empty.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub steps_without_actions: Vec<StepErrors>,
    /// How unlike the training data a context is.
    pub novelty: NoveltyScale,
    /// Smallest and largest value of each action channel in training; empty if the model takes no actions.
    pub actions: Vec<ValueRange>,
    /// The same of each state channel.
    pub states: Vec<ValueRange>,
}

impl Calibration {
    /// Whether it fits the model: lengths, and factors, scales and ranges that make sense. Errors: which value does not, and
    /// what it must be.
    pub fn check(&self, spec: &ModelSpec) -> Result<(), String> {
        let novelty = &self.novelty;
        let square =
            novelty.whitening.iter().all(|row| row.len() <= APPEARANCE) && novelty.whitening.len() == APPEARANCE;
        let lengths = [
            ("steps", self.steps.len(), spec.horizon),
            ("novelty.mean", novelty.mean.len(), APPEARANCE),
            ("actions", self.actions.len(), spec.action_inputs().unwrap_or(0)),
            ("states", self.states.len(), spec.state_inputs().unwrap_or(0)),
        ];
        let without_actions = [("steps_without_actions", self.steps_without_actions.len(), spec.horizon)];
        let without_actions = without_actions
            .into_iter()
            .filter(|_| !self.steps_without_actions.is_empty());
        for (what, found, wanted) in lengths.into_iter().chain(without_actions) {
            if found != wanted {
                return Err(format!("calibration.{what} has {found} entries; it must have {wanted}"));
            }
        }
        let factors = |step: &StepErrors| {
            let is_band = (0.0..=step.high_factor).contains(&step.low_factor);
            step.weights.len() == ERROR_INPUTS && step.mean_factor > 0.0 && is_band
        };
        let mut ranges = self.actions.iter().chain(&self.states);
        let is_valid_at_pose = novelty.at_pose.as_ref().is_none_or(LookAtPose::is_valid);
        let rules = [
            (
                self.steps.iter().chain(&self.steps_without_actions).all(factors),
                "steps: each step needs eight weights, a mean_factor above 0, and a low_factor of at most the high_factor",
            ),
            (square, "novelty.whitening: it must have a row for each statistic"),
            (
                is_valid_at_pose,
                "novelty.at_pose: weights and whitening must have a row for each statistic, and scale must be above 0",
            ),
            (
                novelty.appearance_scale > 0.0 && novelty.still_scale > 0.0,
                "novelty: appearance_scale and still_scale must be above 0",
            ),
            (
                !novelty.quantiles.is_empty() && novelty.quantiles.is_sorted(),
                "novelty.quantiles: they must be there, in rising order",
            ),
            (
                ranges.all(|range| range.min <= range.max),
                "actions and states: min must be at most max",
            ),
        ];
        let broken = rules.iter().find(|(holds, _)| !holds);
        broken.map_or(Ok(()), |(_, rule)| Err(format!("calibration.{rule}")))
    }

    /// The distance of these inputs from the training data. It grows if the frames are unusual, if they do not fit the state's
    /// pose, or if state or actions (of any step) leave their ranges. 5 % of the training contexts have about 1 or more. A state
    /// that is not known adds nothing.
    #[must_use]
    pub fn distance(
        &self,
        spec: &ModelSpec,
        context: &ContextStatistics,
        state: Option<&[f32]>,
        actions: &[f32],
    ) -> f64 {
        let features = state.and_then(|state| pose_features(spec, state));
        let at_pose = self.novelty.at_pose.as_ref().zip(features);
        let at_pose = at_pose.map_or(0.0, |(look, features)| look.distance(context, &features));
        let read = spec.states_that_count().into_iter();
        let of_state = read.filter_map(|channel| Some((self.states.get(channel)?, *state?.get(channel)?)));
        let excess = of_state.map(|(range, value)| range.excess(value));
        let out_of_range = OUT_OF_RANGE * excess.fold(0.0, f64::max);
        let of_frames = self.novelty.distance(context).max(at_pose);
        of_frames.max(out_of_range).max(self.distance_of_actions(actions))
    }

    /// The novelty of actions (of any step) alone, 0…1: without what the frames and the state add.
    #[must_use]
    pub(crate) fn novelty_of_actions(&self, actions: &[f32]) -> f32 {
        self.novelty.novelty(self.distance_of_actions(actions))
    }

    fn distance_of_actions(&self, actions: &[f32]) -> f64 {
        let ranges = self.actions.iter().cycle().zip(actions);
        OUT_OF_RANGE * ranges.map(|(range, value)| range.excess(*value)).fold(0.0, f64::max)
    }
}

/// The smallest and the largest value in training.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ValueRange {
    /// Smallest.
    pub min: f32,
    /// Largest.
    pub max: f32,
}

impl ValueRange {
    /// How far a value is out of the range, over the range's width; 0 inside.
    fn excess(self, value: f32) -> f64 {
        let out = f64::from((self.min - value).max(value - self.max).max(0.0));
        out / f64::from(self.max - self.min).max(FLOOR)
    }
}

/// The error of one step: median = exp(intercept + Σ weights · inputs), times a factor.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StepErrors {
    /// The constant term of the error's logarithm.
    pub intercept: f32,
    /// One for each of the [`ERROR_INPUTS`].
    pub weights: Vec<f32>,
    /// The mean of the error over the median.
    pub mean_factor: f32,
    /// 5 % of the errors over the median are below it.
    pub low_factor: f32,
    /// 5 % of the errors over the median are above it.
    pub high_factor: f32,
}

impl StepErrors {
    /// The error to expect for these inputs. An MSE is at most 1.
    #[must_use]
    pub fn expected(&self, inputs: &[f64; ERROR_INPUTS]) -> ExpectedError {
        let median = (f64::from(self.intercept) + weighted_sum(&self.weights, inputs))
            .exp()
            .min(1.0);
        let times = |factor: f32| (median * f64::from(factor)).min(1.0) as f32;
        ExpectedError {
            mse: times(self.mean_factor),
            low: times(self.low_factor),
            high: times(self.high_factor),
        }
    }
}

/// The mean squared error to expect of a predicted frame, intensities 0…1, and its 90 % band.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ExpectedError {
    /// The expected error.
    pub mse: f32,
    /// The error is below it in 5 % of the cases.
    pub low: f32,
    /// The error is above it in 5 % of the cases.
    pub high: f32,
}

impl ExpectedError {
    /// Errors that are larger by a factor; an MSE is at most 1.
    pub(crate) fn times(self, factor: f32) -> Self {
        let [mse, low, high] = [self.mse, self.low, self.high].map(|error| (error * factor).min(1.0));
        Self { mse, low, high }
    }
}

/// Measures how unlike the training data a context is: by the look of its last frame, by how much of the picture stands still,
/// and for models of one room by the look that the pose lets expect. The distance is the largest of them, each over its 95 %
/// quantile in training.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NoveltyScale {
    /// Mean of the [`APPEARANCE`] statistics in training.
    pub mean: Vec<f32>,
    /// Rows of the lower triangular matrix that makes them uncorrelated, with variance 1.
    pub whitening: Vec<Vec<f32>>,
    /// 95 % quantile of the length of the whitened statistics.
    pub appearance_scale: f32,
    /// Median of the still share, as a log-odds ratio.
    pub still_median: f32,
    /// 95 % quantile of the distance from that median.
    pub still_scale: f32,
    /// The look that follows from the pose, where the model reads one.
    #[doc(hidden)]
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub at_pose: Option<LookAtPose>,
    /// Evenly spaced quantiles, 0 % to 100 %, of the distance on the validation split.
    pub quantiles: Vec<f32>,
}

impl NoveltyScale {
    /// Length of the whitened appearance over its scale.
    #[must_use]
    pub fn appearance_distance(&self, context: &ContextStatistics) -> f64 {
        let centred = context.appearance.iter().zip(&self.mean);
        let centred: Vec<f64> = centred.map(|(x, m)| x - f64::from(*m)).collect();
        whitened_length(&self.whitening, &centred) / f64::from(self.appearance_scale)
    }

    /// How far the frames of a context are from the training data.
    fn distance(&self, context: &ContextStatistics) -> f64 {
        let still = (context.still - f64::from(self.still_median)).abs() / f64::from(self.still_scale);
        self.appearance_distance(context).max(still)
    }

    /// The share of the validation contexts that are nearer to the training data than this [`Calibration::distance`], 0…1.
    /// Frames, states and actions unlike those of the training have nearly 1.
    #[must_use]
    pub fn novelty(&self, distance: f64) -> f32 {
        let distance = distance as f32;
        let above = self.quantiles.partition_point(|&quantile| quantile < distance);
        let Some(below) = above.checked_sub(1) else {
            return 0.0;
        };
        let Some(high) = self.quantiles.get(above) else {
            return 1.0;
        };
        let low = self.quantiles[below];
        let part = (distance - low) / (high - low).max(f32::MIN_POSITIVE);
        (below as f32 + part.clamp(0.0, 1.0)) / (self.quantiles.len() - 1) as f32
    }
}

/// A rollout and the frames that it follows, for the estimate of its errors.
#[derive(Clone, Copy, Debug)]
pub struct RolloutInContext<'a> {
    /// The model's.
    pub spec: &'a ModelSpec,
    /// The last two frames seen.
    pub context: &'a ContextStatistics,
    /// Codes of the last frame seen and of the one before it.
    pub seen: [&'a [f32]; 2],
    /// Codes of the predicted frames, one after another.
    pub codes: &'a [f32],
    /// The predicted frames.
    pub frames: &'a [Frame],
    /// The actions, step by step, in their own units; empty if the model takes none.
    pub actions: &'a [f32],
}

impl RolloutInContext<'_> {
    /// What is known of each predicted frame before its error is known: logarithms of the mean squared difference of its code
    /// to the last frame's and to the frame's before it, of that between the last two frames seen, and of its edges; edges and
    /// still share of the context; its distance from the training data; the size of the actions up to it.
    #[must_use]
    pub fn error_inputs(&self, novelty: &NoveltyScale) -> Vec<[f64; ERROR_INPUTS]> {
        let length = self.spec.code_len();
        let [last, before] = self.seen;
        let seen_change = log_difference(last, before);
        let distance = (novelty.appearance_distance(self.context) + FLOOR).ln();
        let mut previous = last;
        let mut inputs = Vec::with_capacity(self.frames.len());
        for (step, (code, frame)) in self.codes.chunks_exact(length).zip(self.frames).enumerate() {
            inputs.push([
                log_difference(code, last),
                log_difference(code, previous),
                seen_change,
                context::log_edges(frame),
                self.context.edges,
                self.context.still,
                distance,
                self.action_size(step),
            ]);
            previous = code;
        }
        inputs
    }

    /// The errors to expect of the steps that the calibration covers.
    #[must_use]
    pub fn expected_errors(&self, calibration: &Calibration) -> Vec<ExpectedError> {
        let inputs = self.error_inputs(&calibration.novelty);
        let steps = if self.lacks_actions() && !calibration.steps_without_actions.is_empty() {
            &calibration.steps_without_actions
        } else {
            &calibration.steps
        };
        let steps = steps.iter().zip(&inputs);
        steps.map(|(step, inputs)| step.expected(inputs)).collect()
    }

    /// Whether the model takes actions, and none is known.
    fn lacks_actions(&self) -> bool {
        self.spec.action_inputs().is_some() && !self.actions.iter().any(|value| value.is_finite())
    }

    /// Root mean square of the scaled actions up to a step; 0 without actions, or if none is known.
    fn action_size(&self, step: usize) -> f64 {
        let scales = &self.spec.actions;
        let taken = (step + 1) * scales.len();
        let scaled = self.actions.iter().zip(scales.iter().cycle()).take(taken);
        let scaled = scaled.map(|(value, scale)| f64::from(scale.scaled(*value)));
        let known = scaled.filter(|value| value.is_finite());
        let squares: Vec<f64> = known.map(|value| value.powi(2)).collect();
        (squares.iter().sum::<f64>() / squares.len().max(1) as f64).sqrt()
    }
}

/// The length of the vector of `values` times the rows of a matrix.
fn whitened_length(whitening: &[Vec<f32>], values: &[f64]) -> f64 {
    let squares = whitening.iter().map(|row| weighted_sum(row, values).powi(2));
    squares.sum::<f64>().sqrt()
}

fn weighted_sum(weights: &[f32], values: &[f64]) -> f64 {
    weights.iter().zip(values).map(|(w, x)| f64::from(*w) * x).sum()
}

/// ln(mean squared difference + [`FLOOR`]).
fn log_difference(a: &[f32], b: &[f32]) -> f64 {
    let sum = vectorized(
        #[inline(always)]
        || squared_difference(a, b),
    );
    (sum / a.len().max(1) as f64 + FLOOR).ln()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scale_of(quantiles: &[f32]) -> NoveltyScale {
        NoveltyScale {
            mean: vec![0.0; APPEARANCE],
            whitening: vec![vec![1.0]],
            appearance_scale: 1.0,
            still_median: 0.0,
            still_scale: 1e9,
            at_pose: None,
            quantiles: quantiles.to_vec(),
        }
    }

    fn brightness(mean: f32) -> ContextStatistics {
        ContextStatistics::of(&[mean; 64], &[mean; 64], 8)
    }

    #[test]
    fn a_calibration_that_cannot_be_right_is_refused() {
        type Change = fn(&mut Calibration);
        let manifest = include_str!(concat!(
            env!("CARGO_MANIFEST_DIR"),
            "/../../models/moving/manifest.json"
        ));
        let mut manifest: serde_json::Value = serde_json::from_str(manifest).unwrap();
        let spec: ModelSpec = serde_json::from_value(manifest["spec"].take()).unwrap();
        let right: Calibration = serde_json::from_value(manifest["calibration"].take()).unwrap();
        assert_eq!(right.check(&spec), Ok(()));
        let changes: [(Change, &str); 6] = [
            (|c| c.steps.clear(), "steps"),
            (|c| c.steps[0].mean_factor = -5.0, "steps"),
            (|c| c.steps[0].weights.clear(), "steps"),
            (|c| c.novelty.quantiles.clear(), "novelty.quantiles"),
            (|c| c.novelty.appearance_scale = 0.0, "novelty"),
            (|c| c.actions[0].min = f32::MAX, "actions"),
        ];
        for (change, field) in changes {
            let mut wrong = right.clone();
            change(&mut wrong);
            let reason = wrong.check(&spec).unwrap_err();
            assert!(reason.starts_with(&format!("calibration.{field}")), "{reason}");
        }
    }

    #[test]
    fn novelty_is_the_share_of_nearer_contexts() {
        let scale = scale_of(&[0.1, 0.2, 0.4]);
        for (mean, novelty) in [(0.05, 0.0), (0.15, 0.25), (0.2, 0.5), (0.3, 0.75), (0.5, 1.0)] {
            let distance = scale.distance(&brightness(mean));
            assert!((scale.novelty(distance) - novelty).abs() < 1e-5, "{mean}");
        }
        assert_eq!(scale_of(&[]).novelty(0.5), 0.0);
    }

    #[test]
    fn expected_errors_grow_with_their_inputs_and_stay_below_one() {
        let step = StepErrors {
            intercept: -2.0,
            weights: vec![1.0],
            mean_factor: 1.2,
            low_factor: 0.5,
            high_factor: 2.0,
        };
        let mut inputs = [0.0; ERROR_INPUTS];
        let near = step.expected(&inputs);
        assert!(near.low < near.mse && near.mse < near.high);
        inputs[0] = 1.0;
        assert!(step.expected(&inputs).mse > near.mse);
        inputs[0] = 1000.0;
        assert_eq!(step.expected(&inputs).high, 1.0);
    }
}
