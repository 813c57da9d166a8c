//! Fits what a model's training contexts look like, for its novelty.

use std::array;

use super::least_squares::{factor, forward, second_moments, solve};
use super::statistics::{mean_and_deviation, quantile, rounded};
use foreframe_core::registry::calibration::{APPEARANCE, ContextStatistics, LookAtPose, NoveltyScale, POSE_FEATURES};

/// The quantile to which distances are scaled.
const SCALED_TO: f64 = 0.95;
/// Added to standard deviations of the statistics: nothing varies less in a real camera.
const LEAST_SPREAD: f64 = 2e-4;
/// Added to correlations so that the equations can be solved.
const RIDGE: f64 = 1e-2;
/// Added to the mean products of the features of poses: they are many, and some are nearly the same.
const POSE_RIDGE: f64 = 1e-3;

/// What the contexts of the training look like, and how their look follows from the features of their poses, which are empty
/// if the model reads none. The quantiles are filled in later.
pub(super) fn novelty_scale(seen: &[ContextStatistics], poses: &[[f64; POSE_FEATURES]]) -> NoveltyScale {
    let looks: Vec<[f64; APPEARANCE]> = seen.iter().map(|context| context.appearance).collect();
    let (mean, whitening) = whitening(&looks);
    let still: Vec<f64> = seen.iter().map(|context| context.still).collect();
    let still_median = quantile(still.clone(), 0.5);
    let from_median = still.iter().map(|still| (still - still_median).abs()).collect();
    let mut scale = NoveltyScale {
        mean: mean.map(rounded).to_vec(),
        whitening,
        appearance_scale: 1.0,
        still_median: rounded(still_median),
        still_scale: scale_of(from_median),
        at_pose: (poses.len() == seen.len()).then(|| look_at_pose(seen, poses)),
        quantiles: Vec::new(),
    };
    scale.appearance_scale = scale_of(seen.iter().map(|context| scale.appearance_distance(context)).collect());
    scale
}

/// Least squares of each statistic of the look on the features of the poses.
fn look_at_pose(seen: &[ContextStatistics], poses: &[[f64; POSE_FEATURES]]) -> LookAtPose {
    let factor = factor(&second_moments(poses), POSE_FEATURES, POSE_RIDGE)
        .expect("mean squares with a ridge that are not positive is a bug");
    let weights_of = |at: usize| {
        let mut right_side = vec![0.0; POSE_FEATURES];
        for (pose, context) in poses.iter().zip(seen) {
            for (sum, feature) in right_side.iter_mut().zip(pose) {
                *sum += feature * context.appearance[at] / seen.len() as f64;
            }
        }
        solve(&factor, right_side).into_iter().map(rounded).collect()
    };
    let mut look = LookAtPose {
        weights: (0..APPEARANCE).map(weights_of).collect(),
        whitening: Vec::new(),
        scale: 1.0,
    };
    let differences = seen.iter().zip(poses).map(|(context, pose)| {
        let difference = look.difference(context, pose);
        array::from_fn(|at| difference[at])
    });
    (_, look.whitening) = whitening(&differences.collect::<Vec<_>>());
    let lengths = seen
        .iter()
        .zip(poses)
        .map(|(context, pose)| look.distance(context, pose));
    look.scale = scale_of(lengths.collect());
    look
}

/// The means of the values, and the rows of the lower triangular matrix that makes them uncorrelated, with variance 1: the
/// inverse of the factor of their correlations, over their spread.
fn whitening(values: &[[f64; APPEARANCE]]) -> ([f64; APPEARANCE], Vec<Vec<f32>>) {
    let statistics: [[f64; 2]; APPEARANCE] =
        array::from_fn(|at| mean_and_deviation(values.iter().map(|values| values[at])));
    let mean = statistics.map(|[mean, _]| mean);
    let spread = statistics.map(|[_, deviation]| deviation + LEAST_SPREAD);
    let scaled = |values: &[f64; APPEARANCE]| array::from_fn(|at| (values[at] - mean[at]) / spread[at]);
    let rows: Vec<[f64; APPEARANCE]> = values.iter().map(scaled).collect();
    let factor = factor(&second_moments(&rows), APPEARANCE, RIDGE)
        .expect("correlations with a ridge that are not positive is a bug");
    let column = |at: usize| forward(&factor, (0..APPEARANCE).map(|row| f64::from(row == at)).collect());
    let columns: [Vec<f64>; APPEARANCE] = array::from_fn(column);
    let row = |row: usize| (0..=row).map(|at| rounded(columns[at][row] / spread[at])).collect();
    (mean, (0..APPEARANCE).map(row).collect())
}

fn scale_of(distances: Vec<f64>) -> f32 {
    rounded(quantile(distances, SCALED_TO).max(LEAST_SPREAD))
}

#[cfg(test)]
mod tests {
    use rand::Rng as _;

    use super::*;
    use foreframe_core::types::Seed;

    #[test]
    fn contexts_unlike_those_of_the_training_are_far_away() {
        let textured = |seed: u64, size: f32| {
            let mut rng = Seed(seed).rng();
            let phase: f32 = rng.random_range(0.0..6.0);
            let image: Vec<f32> = (0..256)
                .map(|at| 0.5 + size * (at as f32 * 0.3 + phase).sin())
                .collect();
            let moved: Vec<f32> = image
                .iter()
                .map(|value| value + rng.random_range(-0.05..0.05))
                .collect();
            ContextStatistics::of(&image, &moved, 16)
        };
        let seen: Vec<ContextStatistics> = (0..300).map(|seed| textured(seed, 0.2)).collect();
        let scale = novelty_scale(&seen, &[]);
        let distance = |context| scale.appearance_distance(context);
        let far = seen.iter().filter(|context| distance(context) > 1.0).count();
        assert!((15..=30).contains(&far), "{far}");
        assert!(distance(&textured(1000, 0.4)) > 2.0);
        assert_eq!(scale.at_pose, None);
    }

    /// The brightness follows the second feature of the pose.
    #[test]
    fn a_look_that_does_not_fit_the_pose_is_far_away() {
        let seen = |seed: u64| {
            let mut rng = Seed(seed).rng();
            let mut pose = [0.0; POSE_FEATURES];
            pose[0] = 1.0;
            pose[1] = rng.random_range(-1.0..1.0);
            let bright = 0.5 + 0.3 * pose[1] as f32;
            let image: Vec<f32> = (0..256).map(|_| bright + rng.random_range(-0.05..0.05)).collect();
            (ContextStatistics::of(&image, &image, 16), pose)
        };
        let (contexts, poses): (Vec<_>, Vec<_>) = (0..500).map(seen).unzip();
        let look = novelty_scale(&contexts, &poses).at_pose.unwrap();
        let (new, mut pose) = seen(1000);
        assert!(look.distance(&new, &pose) < 2.0);
        pose[1] += if pose[1] > 0.0 { -1.0 } else { 1.0 };
        assert!(look.distance(&new, &pose) > 5.0, "{}", look.distance(&new, &pose));
    }
}
