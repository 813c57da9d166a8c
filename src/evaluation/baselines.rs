//! The trivial predictors that a model must beat, and the names of all that is compared in a table.

use serde::{Deserialize, Serialize};

use super::motion::{Shift, phase_correlation, shifted};

/// One row of a table: who made the prediction.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Method {
    /// The model under test.
    Model,
    /// The last input frame, repeated.
    CopyLast,
    /// The mean of the input frames, repeated.
    MeanOfInputs,
    /// The mean of all frames of the training split, repeated.
    MeanTrainingFrame,
    /// The least-squares line through each pixel's inputs, continued and clamped to 0…1.
    LinearExtrapolation,
    /// The last frame moved on by the shift between the last two inputs (phase correlation).
    ConstantShift,
    /// The true future frame through the model's own dense layers: about the best it can draw. It reads them
    /// smoothed; a prediction that learnt to sharpen can come out better.
    CodecOnly,
}

impl Method {
    /// The trivial baselines, in the order of the tables.
    pub const BASELINES: [Self; 5] = [
        Self::CopyLast,
        Self::MeanOfInputs,
        Self::MeanTrainingFrame,
        Self::LinearExtrapolation,
        Self::ConstantShift,
    ];

    /// All rows, in the order of the tables.
    pub const ALL: [Self; 7] = [
        Self::Model,
        Self::CopyLast,
        Self::MeanOfInputs,
        Self::MeanTrainingFrame,
        Self::LinearExtrapolation,
        Self::ConstantShift,
        Self::CodecOnly,
    ];

    /// The row's name in words.
    #[must_use]
    pub fn label(self) -> &'static str {
        match self {
            Self::Model => "model",
            Self::CopyLast => "copy last frame",
            Self::MeanOfInputs => "mean of the inputs",
            Self::MeanTrainingFrame => "mean training frame",
            Self::LinearExtrapolation => "linear extrapolation",
            Self::ConstantShift => "constant global shift",
            Self::CodecOnly => "codec on the true frame",
        }
    }
}

/// What a baseline may look at: intensities 0…1 in the camera's space.
#[derive(Clone, Copy, Debug)]
pub struct BaselineInput<'a> {
    /// The input frames, oldest first; at least one.
    pub inputs: &'a [Vec<f32>],
    /// The mean frame of the training split.
    pub training_mean: &'a [f32],
    /// Width of a frame in pixels.
    pub width: usize,
}

/// The frames 1…`horizon` steps ahead as a baseline predicts them; none for [`Method::Model`] and
/// [`Method::CodecOnly`], which need a model.
#[must_use]
pub fn predict(method: Method, seen: &BaselineInput, horizon: usize) -> Vec<Vec<f32>> {
    let Some(last) = seen.inputs.last() else {
        return Vec::new();
    };
    match method {
        Method::CopyLast => vec![last.clone(); horizon],
        Method::MeanOfInputs => vec![mean(seen.inputs); horizon],
        Method::MeanTrainingFrame => vec![seen.training_mean.to_vec(); horizon],
        Method::LinearExtrapolation => extrapolate(seen.inputs, horizon),
        Method::ConstantShift => move_on(seen, last, horizon),
        Method::Model | Method::CodecOnly => Vec::new(),
    }
}

fn mean(frames: &[Vec<f32>]) -> Vec<f32> {
    let mut sum = vec![0.0; frames.first().map_or(0, Vec::len)];
    for frame in frames {
        for (sum, value) in sum.iter_mut().zip(frame) {
            *sum += value;
        }
    }
    for value in &mut sum {
        *value /= frames.len() as f32;
    }
    sum
}

/// With times centred on their mean, a pixel's slope is Σ time · value / Σ time².
fn extrapolate(frames: &[Vec<f32>], horizon: usize) -> Vec<Vec<f32>> {
    let mean = mean(frames);
    let centre = (frames.len() - 1) as f32 / 2.0;
    let spread: f32 = (0..frames.len()).map(|i| (i as f32 - centre).powi(2)).sum();
    let mut slope = vec![0.0; mean.len()];
    if spread > 0.0 {
        for (i, frame) in frames.iter().enumerate() {
            let weight = (i as f32 - centre) / spread;
            for (slope, value) in slope.iter_mut().zip(frame) {
                *slope += weight * value;
            }
        }
    }
    (1..=horizon)
        .map(|step| {
            let ahead = centre + step as f32;
            mean.iter()
                .zip(&slope)
                .map(|(mean, slope)| (mean + slope * ahead).clamp(0.0, 1.0))
                .collect()
        })
        .collect()
}

fn move_on(seen: &BaselineInput, last: &[f32], horizon: usize) -> Vec<Vec<f32>> {
    let before = seen.inputs.iter().rev().nth(1);
    let shift = before.map(|before| phase_correlation(before, last, seen.width));
    (1..=horizon)
        .map(|step| match shift {
            Some(Shift { x_px, y_px }) if x_px != 0.0 || y_px != 0.0 => shifted(
                last,
                seen.width,
                Shift {
                    x_px: x_px * step as f32,
                    y_px: y_px * step as f32,
                },
            ),
            _ => last.to_vec(),
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use rand::Rng;

    use super::*;
    use crate::frame::quality::mse;
    use crate::types::Seed;

    fn seen<'a>(inputs: &'a [Vec<f32>], training_mean: &'a [f32], width: usize) -> BaselineInput<'a> {
        BaselineInput {
            inputs,
            training_mean,
            width,
        }
    }

    #[test]
    fn a_line_is_continued_exactly() {
        let inputs: Vec<Vec<f32>> = (0..5)
            .map(|t| vec![0.1 + 0.05 * t as f32, 0.9 - 0.1 * t as f32, 0.4])
            .collect();
        let frames = predict(Method::LinearExtrapolation, &seen(&inputs, &[], 3), 5);
        for (step, frame) in frames.iter().enumerate() {
            let time = (5 + step) as f32;
            assert!((frame[0] - (0.1 + 0.05 * time)).abs() < 1e-6);
            assert!((frame[1] - (0.9 - 0.1 * time).max(0.0)).abs() < 1e-6);
            assert!((frame[2] - 0.4).abs() < 1e-6);
        }
    }

    #[test]
    fn every_baseline_that_sees_the_scene_is_right_on_a_still_one() {
        let scene: Vec<f32> = (0..256).map(|i| (i * 37 % 101) as f32 / 101.0).collect();
        let inputs = vec![scene.clone(); 5];
        for method in Method::BASELINES {
            for frame in predict(method, &seen(&inputs, &scene, 16), 3) {
                assert!(mse(&frame, &scene) < 1e-12, "{method:?}");
            }
        }
    }

    #[test]
    fn a_panning_scene_is_moved_on() {
        let mut rng = Seed(2).rng();
        let texture: Vec<f32> = (0..96 * 64).map(|_| rng.random()).collect();
        let at = |time: usize| -> Vec<f32> {
            (0..64 * 64)
                .map(|i| texture[i / 64 * 96 + 32 - 2 * time + i % 64])
                .collect()
        };
        let inputs: Vec<Vec<f32>> = (0..5).map(at).collect();
        let moved = predict(Method::ConstantShift, &seen(&inputs, &[], 64), 2);
        let copied = predict(Method::CopyLast, &seen(&inputs, &[], 64), 2);
        for step in 0..2 {
            let truth = at(5 + step);
            assert!(mse(&moved[step], &truth) < 0.3 * mse(&copied[step], &truth));
        }
    }

    #[test]
    fn one_input_is_enough() {
        let inputs = vec![vec![0.25; 4]];
        for method in Method::BASELINES {
            assert_eq!(predict(method, &seen(&inputs, &[0.25; 4], 2), 1), [vec![0.25; 4]]);
        }
    }
}
