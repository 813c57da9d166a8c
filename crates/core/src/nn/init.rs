//! Initial weights from a seeded random generator. Each tensor has its own random stream, named after the tensor, so that
//! its values do not depend on which other tensors a model has. candle-nn's `init` takes no seed on the CPU, so the same
//! training would give other weights each time.
//!
//! - Linear weights `[D, O]`: uniform ±√(6 / (D + O)) (Glorot & Bengio 2010); biases 0.
//! - LSTM weights and peepholes: uniform ±1/√H; biases 0, the forget gate's 1 (Jozefowicz et al. 2015).
//! - The flow network's weights: the linear range, or a share of it (`flow_gain`); its other tensors 0.
//! - `predictor.output.weight`: a tenth of the linear range, so that an untrained model predicts almost no change.
//! - `sprites.step.output.weight` and the second layers of the sprite network's encoder: 0, so that at first everything goes straight on.

use candle_core::{Device, Tensor};
use rand::Rng;

use super::error::NnError;
use crate::types::Seed;

/// The initial tensor of this name and shape.
pub(super) fn tensor(name: &str, shape: &[usize], seed: Seed) -> Result<Tensor, NnError> {
    let count = shape.iter().product();
    let (layer, part) = name.rsplit_once('.').unwrap_or(("", name));
    let values = match (part, shape) {
        ("weight", &[inputs, outputs]) if layer.starts_with("flow.") => uniform(
            count,
            flow_gain(layer) * (6.0 / (inputs + outputs) as f32).sqrt(),
            name,
            seed,
        ),
        _ if layer.starts_with("flow.") => vec![0.0; count],
        ("bias", &[gates]) if is_lstm(name) => lstm_bias(gates),
        ("bias", _) => vec![0.0; count],
        ("weight", &[inputs, outputs]) => {
            let gain = match layer {
                "predictor.output" => 0.1,
                "sprites.step.output" => 0.0,
                _ if layer.starts_with("sprites.encoder.") && layer.ends_with(".second") => 0.0,
                _ => 1.0,
            };
            uniform(count, gain * (6.0 / (inputs + outputs) as f32).sqrt(), name, seed)
        }
        (_, &[.., last]) => {
            let hidden = if part.starts_with("peephole") { last } else { last / 4 };
            uniform(count, 1.0 / (hidden as f32).sqrt(), name, seed)
        }
        _ => vec![0.0; count],
    };
    Ok(Tensor::from_vec(values, shape, &Device::Cpu)?)
}

/// The share of the linear range for a layer of the flow network. At first, the residual blocks and corrections change
/// nothing, and pixels hardly move.
fn flow_gain(layer: &str) -> f32 {
    match layer {
        "flow.motion.output" | "flow.affine" | "flow.depth.output" => 0.0,
        // What reads a memory starts without effect, but for its small constant share.
        _ if layer.starts_with("flow.memory.") => 0.0,
        "flow.modulation.output" | "flow.head" | "flow.advance" | "flow.speeds.votes" => 0.1,
        _ if layer.ends_with(".second") => 0.0,
        _ => 1.0,
    }
}

/// Whether the tensor belongs to an LSTM cell, not to a linear layer.
fn is_lstm(name: &str) -> bool {
    matches!(name.split_once('.'), Some(("encoder" | "predictor" | "reconstructor", part)) if !part.contains('.'))
}

/// Biases of the gates i, f, c, o: 0, 1, 0, 0. The forget gate starts open.
fn lstm_bias(gates: usize) -> Vec<f32> {
    let hidden = gates / 4;
    (0..gates)
        .map(|unit| if unit / hidden == 1 { 1.0 } else { 0.0 })
        .collect()
}

fn uniform(count: usize, bound: f32, name: &str, seed: Seed) -> Vec<f32> {
    let mut rng = seed.derive(name, 0).rng();
    (0..count).map(|_| bound * (2.0 * rng.random::<f32>() - 1.0)).collect()
}
