//! Where the codec's training starts: the principal components of the training frames. A dense codec whose last layer is
//! linear can do no better than they do (Baldi & Hornik 1989), and gradient descent from random weights takes long to get
//! there; what is left to training is the encoder's tanh.

use std::sync::atomic::{AtomicBool, Ordering};

use candle_core::{Device, Tensor};
use rand_distr::{Distribution, StandardNormal};

use super::TrainError;
use crate::nn::{NnError, Parameters};
use crate::types::Seed;

/// Directions that are followed beside those asked for, so that the last of these converge too (Halko et al. 2011).
const OVERSAMPLING: usize = 16;
/// Rounds of orthogonal iteration.
const ITERATIONS: usize = 6;
/// Root mean square over the features of their standard deviations before the tanh: small enough for tanh to be nearly
/// straight.
const FEATURE_STD: f64 = 0.15;
/// What power of a component's own standard deviation its feature keeps: at 0 every feature varies alike and the network
/// overfits the fine ones, at 1 it hardly sees them.
const STD_POWER: f64 = 0.5;
/// The least standard deviation of a component, in the model's space; below it there is only noise.
const MIN_STD: f64 = 1e-4;

/// Sets the encoder to the leading principal components of `frames` `[N, P]`, scaled by [`FEATURE_STD`] and [`STD_POWER`],
/// and the reconstruction layer to what these best write `targets` `[N, P]` with. Returns false, and changes
/// nothing, if cancelled. Errors: `Network` if the tensors don't fit.
pub(super) fn set_codec(
    parameters: &Parameters,
    (frames, targets): (&Tensor, &Tensor),
    seed: Seed,
    cancelled: &AtomicBool,
) -> Result<bool, TrainError> {
    let (count, pixels) = frames.dims2()?;
    let features = named(parameters, "frame_encoder.bias")?.elem_count();
    let mean = frames.mean(0)?;
    let centered = frames.broadcast_sub(&mean)?;
    let transposed = centered.t()?.contiguous()?;
    let width = (features + OVERSAMPLING).min(pixels);
    let mut directions = random_directions(pixels, width, seed);
    for _ in 0..ITERATIONS {
        if !orthonormalize(&mut directions, cancelled) {
            return Ok(false);
        }
        let basis = Tensor::from_vec(directions.concat(), (width, pixels), &Device::Cpu)?;
        let scores = centered.matmul(&basis.t()?)?;
        if cancelled.load(Ordering::Acquire) {
            return Ok(false);
        }
        directions = transposed.matmul(&scores)?.t()?.to_vec2()?;
    }
    if !orthonormalize(&mut directions, cancelled) {
        return Ok(false);
    }
    directions.truncate(features);
    // Fewer pixels than features: the rest of the features stay silent.
    directions.resize(features, vec![0.0; pixels]);
    let basis = Tensor::from_vec(directions.concat(), (features, pixels), &Device::Cpu)?;
    let scores = centered.matmul(&basis.t()?)?;
    let std = (scores.sqr()?.sum(0)? / count as f64)?
        .sqrt()?
        .clamp(MIN_STD, f64::MAX)?
        .reshape((features, 1))?;
    let kept = std.powf(STD_POWER)?;
    let rms = kept.sqr()?.mean_all()?.to_scalar::<f32>()?.sqrt();
    // What one unit of a component becomes in its feature.
    let gain = (kept.div(&std)? * (FEATURE_STD / f64::from(rms)))?;
    let encoder = basis.broadcast_mul(&gain)?.t()?.contiguous()?;
    // Components are uncorrelated, so each one's least-squares weights stand alone: covariance over variance.
    let target_mean = targets.mean(0)?;
    let covariance = (scores.t()?.matmul(&targets.broadcast_sub(&target_mean)?)? / count as f64)?;
    let decoder = covariance.broadcast_div(&(std.sqr()? * gain)?)?;
    let bias = mean.reshape((1, pixels))?.matmul(&encoder)?.neg()?.reshape(features)?;
    for (name, tensor) in [
        ("frame_encoder.weight", encoder),
        ("frame_encoder.bias", bias),
        ("frame_decoder.weight", decoder),
        ("frame_decoder.bias", target_mean),
    ] {
        named(parameters, name)?.set(&tensor)?;
    }
    Ok(true)
}

fn named<'a>(parameters: &'a Parameters, name: &str) -> Result<&'a candle_core::Var, NnError> {
    parameters.get(name).ok_or_else(|| NnError::TensorMissing {
        name: name.to_owned(),
        expected: Vec::new(),
    })
}

fn random_directions(pixels: usize, width: usize, seed: Seed) -> Vec<Vec<f32>> {
    let mut rng = seed.rng();
    (0..width)
        .map(|_| (0..pixels).map(|_| StandardNormal.sample(&mut rng)).collect())
        .collect()
}

/// Gram–Schmidt, twice over each row as rounding asks for; a row that depends on those before it becomes zero.
/// Returns false if cancelled.
fn orthonormalize(rows: &mut [Vec<f32>], cancelled: &AtomicBool) -> bool {
    for index in 0..rows.len() {
        let (before, rest) = rows.split_at_mut(index);
        let Some(row) = rest.first_mut() else { return true };
        if cancelled.load(Ordering::Acquire) {
            return false;
        }
        let original = norm(row);
        for _ in 0..2 {
            for other in before.iter() {
                let overlap: f32 = row.iter().zip(other).map(|(a, b)| a * b).sum();
                row.iter_mut().zip(other).for_each(|(a, b)| *a -= overlap * b);
            }
        }
        let length = norm(row);
        let scale = if length > 1e-6 * original { 1.0 / length } else { 0.0 };
        for value in row.iter_mut() {
            *value *= scale;
        }
    }
    true
}

fn norm(row: &[f32]) -> f32 {
    row.iter().map(|value| value * value).sum::<f32>().sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::nn::{Model, ModelSpec};

    #[test]
    fn frames_of_few_components_come_back_through_the_codec() {
        let spec = ModelSpec {
            frame_width_px: 8,
            frame_height_px: 8,
            features: 6,
            hidden: 4,
            ..ModelSpec::default()
        };
        let parameters = Parameters::initialize(&spec, Seed(1)).unwrap();
        let (mut rng, pixels) = (Seed(2).rng(), 64);
        let patterns = random_directions(pixels, 3, Seed(3));
        let frames: Vec<f32> = (0..200)
            .flat_map(|_| {
                let weights: [f32; 3] = std::array::from_fn(|_| StandardNormal.sample(&mut rng));
                (0..pixels)
                    .map(|p| 0.5 + 0.02 * weights.iter().zip(&patterns).map(|(w, row)| w * row[p]).sum::<f32>())
                    .collect::<Vec<f32>>()
            })
            .collect();
        let frames = Tensor::from_vec(frames, (200, pixels), &Device::Cpu).unwrap();
        let go_on = AtomicBool::new(false);
        assert!(set_codec(&parameters, (&frames, &frames), Seed(4), &go_on).unwrap());
        let cancelled = AtomicBool::new(true);
        assert!(!set_codec(&parameters, (&frames, &frames), Seed(4), &cancelled).unwrap());
        let model = Model::new(spec, &parameters).unwrap();
        let back = model.decode_frames(&model.encode_frames(&frames).unwrap()).unwrap();
        let error = (back - &frames)
            .unwrap()
            .sqr()
            .unwrap()
            .mean_all()
            .unwrap()
            .to_scalar::<f32>()
            .unwrap();
        let variance = frames
            .broadcast_sub(&frames.mean(0).unwrap())
            .unwrap()
            .sqr()
            .unwrap()
            .mean_all()
            .unwrap();
        let variance = variance.to_scalar::<f32>().unwrap();
        assert!(error < 0.02 * variance, "error {error}, variance {variance}");
    }
}
