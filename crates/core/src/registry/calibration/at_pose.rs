//! What a training frame looks like from a place in a known room, for models that remember one. A pose that does not fit the
//! picture, such as one that is counted from another origin, is noticed by it.

use serde::{Deserialize, Serialize};

use super::{APPEARANCE, ContextStatistics, weighted_sum, whitened_length};
use crate::nn::ModelSpec;

/// Waves of the heading, the constant one aside.
const HEADING_WAVES: usize = 6;
/// 1, x, y and their squares and product.
const PLACES: usize = 6;
/// Numbers that describe a pose: each of a place with each of a heading.
pub const POSE_FEATURES: usize = PLACES * (2 * HEADING_WAVES + 1);

/// The look of a frame as it follows from the pose, and how far a frame is from it in training.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LookAtPose {
    /// For each of the [`APPEARANCE`] statistics, the weight of each of the [`POSE_FEATURES`].
    pub weights: Vec<Vec<f32>>,
    /// Rows of the lower triangular matrix that makes the differences uncorrelated, with variance 1.
    pub whitening: Vec<Vec<f32>>,
    /// 95 % quantile of the length of the whitened differences.
    pub scale: f32,
}

impl LookAtPose {
    /// Whether lengths and scale make sense.
    pub(super) fn is_valid(&self) -> bool {
        let lengths = |rows: &[Vec<f32>], is_right: fn(usize) -> bool| {
            rows.len() == APPEARANCE && rows.iter().all(|row| is_right(row.len()))
        };
        let weights = lengths(&self.weights, |length| length == POSE_FEATURES);
        weights && lengths(&self.whitening, |length| length <= APPEARANCE) && self.scale > 0.0
    }

    /// The appearance of a frame less what follows from the pose.
    #[must_use]
    pub fn difference(&self, context: &ContextStatistics, features: &[f64; POSE_FEATURES]) -> Vec<f64> {
        let looks = context.appearance.iter().zip(&self.weights);
        looks.map(|(look, row)| look - weighted_sum(row, features)).collect()
    }

    /// Length of the whitened difference over its scale.
    #[must_use]
    pub fn distance(&self, context: &ContextStatistics, features: &[f64; POSE_FEATURES]) -> f64 {
        whitened_length(&self.whitening, &self.difference(context, features)) / f64::from(self.scale)
    }
}

/// What describes the pose in a state: 1, x, y, x², xy and y² in standard deviations of the training, each with 1 and the
/// cosines and sines of 1 to 6 times the heading. `None` if the model does not read where in a room it is.
#[must_use]
pub fn pose_features(spec: &ModelSpec, state: &[f32]) -> Option<[f64; POSE_FEATURES]> {
    let [x, y, heading] = spec.absolute_pose(state)?.map(f64::from);
    let places = [1.0, x, y, x * x, x * y, y * y];
    let mut features = [0.0; POSE_FEATURES];
    for (place, features) in places.iter().zip(features.chunks_exact_mut(2 * HEADING_WAVES + 1)) {
        features[0] = *place;
        for (wave, pair) in features[1..].chunks_exact_mut(2).enumerate() {
            let (sin, cos) = (heading * (wave + 1) as f64).sin_cos();
            pair.copy_from_slice(&[place * cos, place * sin]);
        }
    }
    Some(features)
}
