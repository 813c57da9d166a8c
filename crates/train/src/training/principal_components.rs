//! Initial weights of the codec from the principal components of the training frames. They are optimal for a linear codec
//! (Baldi & Hornik 1989), and gradient descent from random weights needs many steps to reach them. Training then only has
//! to adapt to the encoder's tanh.

use std::sync::atomic::{AtomicBool, Ordering};

use candle_core::{Device, Tensor};
use rand_distr::{Distribution, StandardNormal};

use super::TrainError;
use foreframe_core::nn::Parameters;
use foreframe_core::types::Seed;

/// Additional directions in the iteration, so that the last requested ones converge too (Halko et al. 2011).
const OVERSAMPLING: usize = 16;
/// Steps of orthogonal iteration.
const ITERATIONS: usize = 6;
/// Standard deviation of the features before the tanh (root mean square over the features): small, so that tanh is almost
/// linear.
const FEATURE_STD: f64 = 0.15;
/// A feature's standard deviation is that of its component to this power. With 0, all features vary equally and the network
/// overfits fine details; with 1, fine details are almost lost.
const STD_POWER: f64 = 0.5;
/// Smallest standard deviation of a component, in the model's value range; below it there is only noise.
const MIN_STD: f64 = 1e-4;

/// Sets the frame encoder to the first principal components of `frames` `[N, P]`, scaled by [`FEATURE_STD`] and
/// [`STD_POWER`], and the frame decoder to the least-squares weights for `targets` `[N, P]`. Returns false, and changes
/// nothing, if cancelled. Errors: `Network` if the shapes do not match.
pub(super) fn set_codec(
    parameters: &Parameters,
    frames: &Tensor,
    targets: &Tensor,
    seed: Seed,
    cancelled: &AtomicBool,
) -> Result<bool, TrainError> {
    let (count, pixels) = frames.dims2()?;
    let features = parameters.require("frame_encoder.bias")?.elem_count();
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
    // If there are fewer pixels than features, the other features stay 0.
    directions.resize(features, vec![0.0; pixels]);
    let basis = Tensor::from_vec(directions.concat(), (features, pixels), &Device::Cpu)?;
    let scores = centered.matmul(&basis.t()?)?;
    let std = (scores.sqr()?.sum(0)? / count as f64)?
        .sqrt()?
        .clamp(MIN_STD, f64::MAX)?
        .reshape((features, 1))?;
    let feature_std = std.powf(STD_POWER)?;
    let rms = feature_std.sqr()?.mean_all()?.to_scalar::<f32>()?.sqrt();
    // Feature value per unit of the component.
    let gain = (feature_std.div(&std)? * (FEATURE_STD / f64::from(rms)))?;
    let encoder = basis.broadcast_mul(&gain)?.t()?.contiguous()?;
    // Components are uncorrelated, so the least-squares weights of each are covariance / variance.
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
        parameters.require(name)?.set(&tensor)?;
    }
    Ok(true)
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
    use foreframe_core::nn::{Architecture, DenseSpec, ModelSpec, Network};

    #[test]
    fn the_codec_restores_frames_of_few_components() {
        let spec = ModelSpec {
            frame_width_px: 8,
            frame_height_px: 8,
            architecture: Architecture::Dense(DenseSpec {
                features: 6,
                hidden: 4,
                ..DenseSpec::default()
            }),
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
        assert!(set_codec(&parameters, &frames, &frames, Seed(4), &go_on).unwrap());
        let cancelled = AtomicBool::new(true);
        assert!(!set_codec(&parameters, &frames, &frames, Seed(4), &cancelled).unwrap());
        let model = Network::new(spec, &parameters).unwrap();
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
