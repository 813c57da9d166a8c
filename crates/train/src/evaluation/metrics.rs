//! Scores of single frames and their means: per step ahead, and over all steps.

use serde::{Deserialize, Serialize};

use super::method::Method;
use foreframe_core::frame::quality;

/// The greatest PSNR of a frame, in dB: that of rounding to 8 bits. Without it, one perfect frame would make a mean
/// infinite.
pub(super) const PSNR_CAP_DB: f64 = 59.0;

/// Scores of one predicted frame against the true one, intensities 0…1.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct FrameScore {
    /// Mean squared error per pixel.
    pub(super) mse: f64,
    /// Peak signal-to-noise ratio in dB, at most [`PSNR_CAP_DB`].
    pub(super) psnr_db: f64,
    /// Structural similarity, −1…1.
    pub(super) ssim: f64,
    /// The same with the even windows of published benchmarks; 0 where that was not asked for.
    pub(super) ssim_even: f64,
    /// Sum of squared errors over the pixels of moving robots in the true frame.
    pub(super) mover_squared_error: f64,
    /// Number of such pixels.
    pub(super) mover_pixels: usize,
}

/// A true frame and the mask of its movers.
#[derive(Clone, Copy, Debug)]
pub(super) struct TargetFrame<'a> {
    /// Intensities 0…1.
    pub(super) pixels: &'a [f32],
    /// 0 for pixels of the scene, other values for pixels of movers; absent for recordings.
    pub(super) mask: Option<&'a [u8]>,
    /// Width in pixels.
    pub(super) width: usize,
    /// Whether the scores of published benchmarks are computed too.
    pub(super) for_benchmark: bool,
}

impl FrameScore {
    /// Compares a predicted frame with the true one.
    pub(super) fn of(predicted: &[f32], truth: &TargetFrame) -> Self {
        let mse = quality::mse(predicted, truth.pixels);
        let mut score = Self {
            mse,
            psnr_db: quality::psnr_db(mse).min(PSNR_CAP_DB),
            ssim: quality::ssim(predicted, truth.pixels, truth.width),
            ..Self::default()
        };
        if truth.for_benchmark {
            score.ssim_even = quality::ssim_even(predicted, truth.pixels, truth.width);
        }
        for (owner, (a, b)) in truth.mask.into_iter().flatten().zip(predicted.iter().zip(truth.pixels)) {
            if *owner > 0 {
                score.mover_pixels += 1;
                score.mover_squared_error += f64::from(a - b).powi(2);
            }
        }
        score
    }
}

/// A value for each step ahead and their mean.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct StepCurve {
    /// At t+1, t+2, …
    pub per_step: Vec<f64>,
    /// Mean over the steps.
    pub mean: f64,
}

impl StepCurve {
    /// A curve of these values.
    #[must_use]
    pub fn new(per_step: Vec<f64>) -> Self {
        let mean = per_step.iter().sum::<f64>() / per_step.len().max(1) as f64;
        Self { per_step, mean }
    }

    /// The mean over the items of the value that each has at a step.
    pub(super) fn mean_over<T>(items: &[T], steps: usize, value: impl Fn(&T, usize) -> f64) -> Self {
        let mean_at = |step| items.iter().map(|item| value(item, step)).sum::<f64>() / items.len() as f64;
        Self::new((0..steps).map(mean_at).collect())
    }
}

/// All scores of one window.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct WindowScores {
    /// Position of its trial in the data set.
    pub(super) episode: usize,
    /// Its first frame in the data set.
    pub(super) first_frame: usize,
    /// What it is resampled with: windows of the same number are not independent.
    pub(super) group: usize,
    /// `frames[row][step]`, one row for each method that was scored.
    pub(super) frames: Vec<Vec<FrameScore>>,
    /// Mean squared error of the model in its own space, per step.
    pub(super) model_space_mse: Vec<f64>,
    /// Mean squared error of the reconstruction of each frame seen, the oldest first.
    pub(super) reconstruction_mse: Vec<f64>,
}

impl WindowScores {
    /// Mean squared error of the model over all steps.
    pub(super) fn model_mse(&self) -> f64 {
        let steps = self.frames.first().map_or(&[][..], Vec::as_slice);
        steps.iter().map(|score| score.mse).sum::<f64>() / steps.len().max(1) as f64
    }
}

/// One row of a test set's tables.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct MethodScores {
    /// The method.
    pub method: Method,
    /// Mean squared error per pixel.
    pub mse: StepCurve,
    /// Peak signal-to-noise ratio in dB: mean over frames of each frame's own.
    pub psnr_db: StepCurve,
    /// Structural similarity: mean over frames.
    pub ssim: StepCurve,
    /// Mean squared error over all pixels of movers; absent where the data set has no masks or no mover is in view.
    pub mover_mse: Option<StepCurve>,
    /// The scores that papers on Moving MNIST print; absent for other data sets.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub benchmark: Option<BenchmarkScores>,
}

/// The scores that papers on Moving MNIST print, for intensities 0…1.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct BenchmarkScores {
    /// Squared error summed over the pixels of a frame: mean over frames.
    pub squared_error: StepCurve,
    /// Structural similarity with even windows, as scikit-image computes it: mean over frames.
    pub ssim: StepCurve,
}

/// Adds the benchmark's scores to the rows of [`summarize`], for frames of `frame_pixels` pixels.
pub(super) fn add_benchmark(rows: &mut [MethodScores], windows: &[WindowScores], frame_pixels: usize) {
    for (row, scores) in rows.iter_mut().enumerate() {
        scores.benchmark = Some(BenchmarkScores {
            squared_error: mean_curve(windows, row, |score| score.mse * frame_pixels as f64),
            ssim: mean_curve(windows, row, |score| score.ssim_even),
        });
    }
}

/// The tables' rows from the windows' scores of these methods.
pub(super) fn summarize(methods: &[Method], windows: &[WindowScores]) -> Vec<MethodScores> {
    methods
        .iter()
        .enumerate()
        .map(|(row, &method)| MethodScores {
            method,
            mse: mean_curve(windows, row, |score| score.mse),
            psnr_db: mean_curve(windows, row, |score| score.psnr_db),
            ssim: mean_curve(windows, row, |score| score.ssim),
            mover_mse: mover_curve(windows, row),
            benchmark: None,
        })
        .collect()
}

fn steps(windows: &[WindowScores], row: usize) -> usize {
    windows.first().map_or(0, |window| window.frames[row].len())
}

fn mean_curve(windows: &[WindowScores], row: usize, value: impl Fn(&FrameScore) -> f64) -> StepCurve {
    StepCurve::mean_over(windows, steps(windows, row), |window, step| {
        value(&window.frames[row][step])
    })
}

fn mover_curve(windows: &[WindowScores], row: usize) -> Option<StepCurve> {
    (0..steps(windows, row))
        .map(|step| {
            let scores = windows.iter().map(|window| &window.frames[row][step]);
            let pixels: usize = scores.clone().map(|score| score.mover_pixels).sum();
            (pixels > 0).then(|| scores.map(|score| score.mover_squared_error).sum::<f64>() / pixels as f64)
        })
        .collect::<Option<Vec<f64>>>()
        .filter(|values| !values.is_empty())
        .map(StepCurve::new)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_frame_without_error_has_the_cap_and_full_similarity() {
        let pixels = vec![0.5; 64];
        let truth = TargetFrame {
            pixels: &pixels,
            mask: None,
            width: 8,
            for_benchmark: true,
        };
        let score = FrameScore::of(&pixels, &truth);
        assert_eq!((score.mse, score.psnr_db, score.mover_pixels), (0.0, PSNR_CAP_DB, 0));
        assert!((score.ssim - 1.0).abs() < 1e-6 && (score.ssim_even - 1.0).abs() < 1e-6);
    }

    #[test]
    fn only_the_movers_pixels_count_inside_the_mask() {
        let truth = TargetFrame {
            pixels: &[0.0, 0.0, 0.0, 0.0],
            mask: Some(&[0, 1, 2, 0]),
            width: 2,
            for_benchmark: false,
        };
        let score = FrameScore::of(&[1.0, 0.5, 0.0, 1.0], &truth);
        assert_eq!((score.mover_pixels, score.mover_squared_error), (2, 0.25));
    }

    #[test]
    fn the_psnr_of_a_set_is_the_mean_of_its_frames() {
        let window = |psnr_db, mover_pixels| WindowScores {
            episode: 0,
            first_frame: 0,
            group: 0,
            frames: vec![
                vec![FrameScore {
                    psnr_db,
                    mover_pixels,
                    mover_squared_error: 1.0,
                    ..FrameScore::default()
                }];
                Method::ALL.len()
            ],
            model_space_mse: vec![0.0],
            reconstruction_mse: vec![0.0],
        };
        let rows = summarize(&Method::ALL, &[window(20.0, 1), window(40.0, 3)]);
        assert_eq!(rows[0].psnr_db.mean, 30.0);
        assert_eq!(rows[0].mover_mse.as_ref().unwrap().mean, 0.5);
    }
}
