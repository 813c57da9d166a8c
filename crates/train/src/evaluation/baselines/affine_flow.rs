//! A motion of the whole image that is affine in its coordinates and linear in the actions, fitted to the training split
//! by Gauss–Newton steps on the brightness error: the ego-motion of a camera whose model is not known.

use rayon::prelude::*;

use super::input::BaselineInput;
use crate::evaluation::EvaluationError;
use crate::evaluation::least_squares::{factor, solve};
use crate::evaluation::statistics::mean_and_deviation;
use crate::evaluation::windows::evenly;
use foreframe_core::frame::preprocess::Preprocess;
use foreframe_core::frame::warp::sample;
use foreframe_data::dataset::sampler::WindowShape;
use foreframe_data::dataset::{Dataset, Window};

/// Two frames whose motion is explained, and the one before, whose action is still felt.
pub(super) const SHAPE: WindowShape = WindowShape { context: 2, horizon: 1 };
/// Pairs of frames that it is fitted to at most, evenly spread.
const MAX_PAIRS: usize = 600;
/// Smoothing of the frames from coarse to fine, as a share of their width, so that large motions are found.
const SMOOTHING: [f32; 4] = [0.08, 0.04, 0.02, 0.01];
/// Gauss–Newton steps at each smoothing.
const STEPS: usize = 5;
/// Ridge, as a share of the mean of the diagonal.
const RIDGE: f64 = 1e-4;
/// Parameters of an affine motion: right and down, each a constant and its slope across and down the image.
const AFFINE: usize = 6;

/// The motion [right, down] in pixels by which a pixel's source lies beside it, from an affine motion's parameters.
struct Affine([f32; AFFINE]);

impl Affine {
    /// At normalized coordinates.
    fn at(&self, [x, y]: [f32; 2]) -> [f32; 2] {
        let Self([a, b, c, d, e, f]) = self;
        [a + b * x + c * y, d + e * x + f * y]
    }
}

/// The fitted motion.
pub(super) struct AffineFlow {
    width: usize,
    height: usize,
    mean: Vec<f64>,
    scale: Vec<f64>,
    /// [`AFFINE`] parameters for each regressor.
    parameters: Vec<f64>,
}

impl AffineFlow {
    /// None if the data set has no actions or there are no windows of [`SHAPE`]. Errors: those of [`Dataset::pixels`].
    pub(super) fn fit(dataset: &Dataset, windows: &[Window]) -> Result<Option<Self>, EvaluationError> {
        let info = dataset.info();
        if info.action_channels.is_empty() || windows.is_empty() {
            return Ok(None);
        }
        let pairs = evenly(windows, MAX_PAIRS);
        let channels = 0..info.action_channels.len();
        let (mean, scale): (Vec<f64>, Vec<f64>) = channels
            .map(|channel| {
                let values = pairs.iter().map(|pair| dataset.action(pair.first_frame + 1)[channel]);
                let [mean, deviation] = mean_and_deviation(values.map(f64::from));
                (mean, deviation.max(1e-6))
            })
            .unzip();
        let regressors = 1 + 2 * mean.len();
        let mut flow = Self {
            width: info.frame_width_px as usize,
            height: info.frame_height_px as usize,
            mean,
            scale,
            parameters: vec![0.0; AFFINE * regressors],
        };
        for share in SMOOTHING {
            let smooth = Preprocess {
                blur_sigma_px: share * flow.width as f32,
                invert: false,
            };
            for _ in 0..STEPS {
                let equations = pairs.par_iter().map(|pair| flow.equations_of(dataset, pair, smooth));
                let none = || NormalEquations::new(AFFINE * regressors);
                let equations = equations.try_reduce(none, |sum, more| Ok(sum.plus(&more)))?;
                let Some(steps) = equations.solve() else {
                    return Ok(None);
                };
                for (parameter, step) in flow.parameters.iter_mut().zip(steps) {
                    *parameter += step;
                }
            }
        }
        Ok(Some(flow))
    }

    /// One frame for each action of the input: the last frame sampled once, where the motions lead back to.
    pub(super) fn predict(&self, input: &BaselineInput, last: &[f32]) -> Vec<Vec<f32>> {
        let previous = std::iter::once(input.previous_action).chain(input.actions.iter().copied());
        let motions: Vec<Affine> = previous
            .zip(&input.actions)
            .map(|(previous, action)| self.motion(&self.regressors(previous, action)))
            .collect();
        (1..=motions.len())
            .map(|steps| {
                let mut grid = self.identity();
                for motion in motions.iter().take(steps).rev() {
                    self.shift(&mut grid, motion);
                }
                sample(last, self.width, self.height, &grid).0
            })
            .collect()
    }

    /// 1, then the action and the one before, centred and scaled.
    fn regressors(&self, previous: &[f32], action: &[f32]) -> Vec<f64> {
        let scaled = |action: &[f32]| -> Vec<f64> {
            let channels = action.iter().zip(self.mean.iter().zip(&self.scale));
            channels
                .map(|(&value, (mean, scale))| (f64::from(value) - mean) / scale)
                .collect()
        };
        [vec![1.0], scaled(action), scaled(previous)].concat()
    }

    fn motion(&self, regressors: &[f64]) -> Affine {
        let mut motion = [0.0f32; AFFINE];
        for (parameters, regressor) in self.parameters.chunks_exact(AFFINE).zip(regressors) {
            for (sum, parameter) in motion.iter_mut().zip(parameters) {
                *sum += (parameter * regressor) as f32;
            }
        }
        Affine(motion)
    }

    fn identity(&self) -> Vec<[f32; 2]> {
        let pixels = 0..self.width * self.height;
        pixels
            .map(|pixel| [(pixel % self.width) as f32 + 0.5, (pixel / self.width) as f32 + 0.5])
            .collect()
    }

    fn shift(&self, grid: &mut [[f32; 2]], motion: &Affine) {
        for point in grid {
            let [right, down] = motion.at(self.normalized(*point));
            *point = [point[0] + right, point[1] + down];
        }
    }

    /// −1…1 across and down the image.
    fn normalized(&self, [column, row]: [f32; 2]) -> [f32; 2] {
        [
            2.0 * column / self.width as f32 - 1.0,
            2.0 * row / self.height as f32 - 1.0,
        ]
    }

    /// What a pair of frames says about the step from the present parameters.
    fn equations_of(
        &self,
        dataset: &Dataset,
        pair: &Window,
        smooth: Preprocess,
    ) -> Result<NormalEquations, EvaluationError> {
        let (before, after) = (pair.first_frame + 1, pair.first_frame + 2);
        let regressors = self.regressors(dataset.action(pair.first_frame), dataset.action(before));
        let source = smooth.forward(&dataset.frame(before)?);
        let target = smooth.forward(&dataset.frame(after)?);
        let mut grid = self.identity();
        self.shift(&mut grid, &self.motion(&regressors));
        let (warped, inside) = sample(&source, self.width, self.height, &grid);
        let mut own = [[0.0f64; AFFINE + 1]; AFFINE];
        for row in 1..self.height.saturating_sub(1) {
            for column in 1..self.width.saturating_sub(1) {
                let pixel = row * self.width + column;
                if !inside[pixel] {
                    continue;
                }
                let right = f64::from(warped[pixel + 1] - warped[pixel - 1]) / 2.0;
                let down = f64::from(warped[pixel + self.width] - warped[pixel - self.width]) / 2.0;
                let [x, y] = self.normalized([column as f32 + 0.5, row as f32 + 0.5]).map(f64::from);
                let slope = [right, right * x, right * y, down, down * x, down * y];
                let error = f64::from(target[pixel] - warped[pixel]);
                for (i, sums) in own.iter_mut().enumerate() {
                    for (j, slope_j) in slope.iter().enumerate() {
                        sums[j] += slope[i] * slope_j;
                    }
                    sums[AFFINE] += slope[i] * error;
                }
            }
        }
        Ok(NormalEquations::of_pair(&own, &regressors))
    }
}

/// Sums of products of a least-squares problem.
struct NormalEquations {
    /// Row by row.
    matrix: Vec<f64>,
    right_side: Vec<f64>,
}

impl NormalEquations {
    fn new(size: usize) -> Self {
        Self {
            matrix: vec![0.0; size * size],
            right_side: vec![0.0; size],
        }
    }

    /// Those of one pair of frames: the sums over its pixels, for a motion with these regressors.
    fn of_pair(own: &[[f64; AFFINE + 1]; AFFINE], regressors: &[f64]) -> Self {
        let mut equations = Self::new(0);
        for one in regressors {
            for sums in own {
                for other in regressors {
                    let products = sums.iter().take(AFFINE).map(|sum| one * other * sum);
                    equations.matrix.extend(products);
                }
                equations.right_side.push(one * sums[AFFINE]);
            }
        }
        equations
    }

    fn plus(mut self, other: &Self) -> Self {
        let sums = self.matrix.iter_mut().chain(&mut self.right_side);
        for (sum, value) in sums.zip(other.matrix.iter().chain(&other.right_side)) {
            *sum += value;
        }
        self
    }

    /// The solution with a small ridge, by Cholesky's factorization; none where the frames say nothing.
    fn solve(self) -> Option<Vec<f64>> {
        let size = self.right_side.len();
        let trace: f64 = self.matrix.iter().step_by(size + 1).sum();
        if trace <= 0.0 || !trace.is_finite() {
            return Some(vec![0.0; size]);
        }
        let factor = factor(&self.matrix, size, RIDGE * trace / size as f64)?;
        Some(solve(&factor, self.right_side))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_solution_solves_its_equations() {
        let equations = NormalEquations {
            matrix: vec![4.0, 1.0, 1.0, 3.0],
            right_side: vec![1.0, 2.0],
        };
        let solution = equations.solve().unwrap();
        assert!((solution[0] - 1.0 / 11.0).abs() < 1e-3 && (solution[1] - 7.0 / 11.0).abs() < 1e-3);
    }

    #[test]
    fn without_a_picture_to_follow_nothing_moves() {
        assert_eq!(NormalEquations::new(3).solve(), Some(vec![0.0; 3]));
    }
}
