//! The tensors of the dense network, and its cost.

use std::collections::BTreeMap;

use crate::nn::options::Reconstruction;
use crate::nn::spec::{DenseSpec, ModelSpec};

/// Name and shape of every trained tensor. Gate order in `w_x`, `w_h` and `bias` is i, f, c, o.
pub(in crate::nn) fn tensor_shapes(spec: &ModelSpec, sizes: &DenseSpec) -> BTreeMap<String, Vec<usize>> {
    let (pixels, features, hidden) = (spec.pixels(), sizes.features, sizes.hidden);
    let mut shapes = BTreeMap::new();
    let mut linear = |name: &str, inputs: usize, outputs: usize| {
        shapes.insert(format!("{name}.weight"), vec![inputs, outputs]);
        shapes.insert(format!("{name}.bias"), vec![outputs]);
    };
    linear("frame_encoder", pixels, features);
    linear("frame_decoder", features, pixels);
    linear("predictor.output", hidden, features);
    linear("reconstructor.output", hidden, features);
    let lstms = [
        ("encoder", features),
        ("predictor", predictor_inputs(spec, sizes)),
        ("reconstructor", reconstructor_inputs(sizes)),
    ];
    for (name, inputs) in lstms {
        shapes.insert(format!("{name}.w_x"), vec![inputs, 4 * hidden]);
        shapes.insert(format!("{name}.w_h"), vec![hidden, 4 * hidden]);
        shapes.insert(format!("{name}.bias"), vec![4 * hidden]);
        for gate in ["i", "f", "o"] {
            shapes.insert(format!("{name}.peephole_{gate}"), vec![hidden]);
        }
    }
    shapes
}

/// Multiply–add operations with weights per predicted frame, rounded up. Biases and the products inside the gates are not
/// counted. The cost of encoding the context is divided by the horizon:
///
/// `(context · (P·F + L(F)) + horizon · (L(F+A+S) + H·F + F·P)) / horizon`, `L(D) = 4H·(D + H) + 3H`.
///
/// The reconstructor is not used in a prediction.
pub(in crate::nn) fn multiply_adds_per_frame(spec: &ModelSpec, sizes: &DenseSpec) -> u64 {
    let (context, horizon) = (spec.context as u64, spec.horizon.max(1) as u64);
    let (pixels, features, hidden) = (spec.pixels() as u64, sizes.features as u64, sizes.hidden as u64);
    let lstm = |inputs: u64| 4 * hidden * (inputs + hidden) + 3 * hidden;
    let encoding = context * (pixels * features + lstm(features));
    let prediction = lstm(predictor_inputs(spec, sizes) as u64) + hidden * features + features * pixels;
    encoding.div_ceil(horizon) + prediction
}

/// Inputs of the predictor's LSTM: features, then the action, then the state.
fn predictor_inputs(spec: &ModelSpec, sizes: &DenseSpec) -> usize {
    sizes.features + spec.conditioning_inputs()
}

/// Inputs of the reconstructor's LSTM: its own previous output (approach 1), or the encoder's output (approach 2).
fn reconstructor_inputs(sizes: &DenseSpec) -> usize {
    match sizes.reconstruction {
        Reconstruction::Sequence => sizes.features,
        Reconstruction::Stepwise => sizes.hidden,
    }
}
