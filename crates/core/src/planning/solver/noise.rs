//! Coloured noise: neighbouring steps are alike, so that a plan drives somewhere instead of trembling (Timmer & König 1995;
//! Pinneri et al. 2020, iCEM).

use std::f32::consts::TAU;

use rand::Rng;
use rand_chacha::ChaCha8Rng;

/// A row of `steps` numbers of mean 0 and variance 1, whose power falls with the frequency to the `color`.
pub(super) fn colored(random: &mut ChaCha8Rng, steps: usize, color: f32) -> Vec<f32> {
    let scale = |wave: usize| (wave.max(1) as f32).powf(-color / 2.0);
    let waves = steps / 2;
    let power: f32 = (0..=waves).map(|wave| scale(wave).powi(2)).sum();
    let mut row = vec![0.0; steps];
    for wave in 0..=waves {
        let (cos, sin) = (normal(random), normal(random));
        for (step, value) in row.iter_mut().enumerate() {
            let angle = TAU * wave as f32 * step as f32 / steps as f32;
            *value += scale(wave) * (cos * angle.cos() + sin * angle.sin());
        }
    }
    let scale = power.sqrt().recip();
    for value in &mut row {
        *value *= scale;
    }
    row
}

/// Noise for a plan: a row of its own for each channel.
pub(super) fn of_plan(random: &mut ChaCha8Rng, [steps, channels]: [usize; 2], color: f32) -> Vec<f32> {
    let mut noise = vec![0.0; steps * channels];
    for channel in 0..channels {
        for (step, value) in colored(random, steps, color).into_iter().enumerate() {
            noise[step * channels + channel] = value;
        }
    }
    noise
}

/// A normally distributed number (Box & Muller 1958).
fn normal(random: &mut ChaCha8Rng) -> f32 {
    let (one, two): (f32, f32) = (random.random(), random.random());
    (-2.0 * (1.0 - one).ln()).sqrt() * (TAU * two).cos()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::types::Seed;

    #[test]
    fn colored_noise_has_variance_one_and_alike_neighbours() {
        let likeness = |color: f32| {
            let mut random = Seed(1).rng();
            let rows: Vec<Vec<f32>> = (0..2000).map(|_| colored(&mut random, 10, color)).collect();
            let variance = rows.iter().flatten().map(|value| value * value).sum::<f32>() / 20_000.0;
            assert!((variance - 1.0).abs() < 0.1, "{variance}");
            let pairs = rows.iter().flat_map(|row| row.windows(2));
            pairs.map(|pair| pair[0] * pair[1]).sum::<f32>() / 18_000.0
        };
        assert!(likeness(3.0) > 0.7 && likeness(0.0) < 0.3);
    }
}
