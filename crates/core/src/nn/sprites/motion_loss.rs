//! What teaches the sprite network how things go on: the blocks of the last frame are followed through the frames to come, as they
//! were followed through the context. Comparing pixels alone would say little where a sprite is predicted far from where it comes.

use candle_core::{Device, Tensor};

use super::block_tracks::{TRACK_VALUES, Tracks, block_tracks};
use super::network::SpritePrediction;
use super::two_ways::MISFIT_DECAY;
use crate::nn::error::NnError;
use crate::nn::spec::ModelSpec;
use crate::nn::tensors::with_values;

/// The mean over sprites and frames of w · (√(1 + d²) − 1). d is the distance, in pixels, between where a sprite was predicted and where its blocks
/// went in the frames to come `[N, horizon, P]`; w is what the blocks' trust is worth there: for each one times its fits in all frames so far.
pub fn motion_loss(
    spec: &ModelSpec,
    prediction: &SpritePrediction,
    contexts: &Tensor,
    coming: &Tensor,
) -> Result<Tensor, NnError> {
    let size = spec.image_size();
    let (windows, horizon, pixels) = coming.dims3()?;
    let tracks = with_values(&contexts.narrow(1, spec.context - 1, 1)?, |last| {
        with_values(coming, |coming| -> Vec<Tracks> {
            let coming = coming.chunks_exact(horizon * pixels);
            let both = last.chunks_exact(pixels).zip(coming);
            both.map(|(last, coming)| block_tracks(last, coming.chunks_exact(pixels), size))
                .collect()
        })
    })??;
    let blocks = size.shrunk(4).pixels();
    let (mut places, mut counts) = (Vec::new(), Vec::new());
    with_values(&prediction.trust.detach(), |trust| {
        for (row, trust) in trust.chunks_exact(blocks).enumerate() {
            let mut sums = vec![[0.0f32; 3]; horizon];
            let Tracks { values, followed } = &tracks[row % windows];
            let blocks = values.chunks_exact(horizon * TRACK_VALUES).zip(followed);
            for (trust, (track, followed)) in trust.iter().zip(blocks) {
                let mut weight = if *followed { *trust } else { 0.0 };
                for (sum, step) in sums.iter_mut().zip(track.chunks_exact(TRACK_VALUES)) {
                    weight *= (-MISFIT_DECAY * step[2]).exp();
                    sum[0] += weight * step[0];
                    sum[1] += weight * step[1];
                    sum[2] += weight;
                }
            }
            places.extend(
                sums.iter()
                    .flat_map(|sum| [sum[0] / (sum[2] + 1e-6), sum[1] / (sum[2] + 1e-6)]),
            );
            counts.extend(sums.iter().map(|sum| sum[2]));
        }
    })?;
    let rows = counts.len() / horizon;
    let places = Tensor::from_vec(places, (rows, horizon, 2), &Device::Cpu)?;
    let counts = Tensor::from_vec(counts, (rows, horizon), &Device::Cpu)?;
    let squared = (&prediction.moves - places)?.sqr()?.sum(2)?;
    let distances = ((squared + 1.0)?.sqrt()? - 1.0)?;
    Ok((distances * counts)?.mean_all()?)
}
