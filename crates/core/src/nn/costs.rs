//! The cost of two published video predictors on a model's frames, for comparison. The paper compares them only in words.
//!
//! Both are counted as in [`ModelSpec::multiply_adds_per_frame`]: only products with weights, with the cost of the context
//! divided by the horizon. Frames are gray. Normalization layers are not counted.

use super::spec::ModelSpec;

/// Side of the kernels of every recurrent layer, in both networks.
const LSTM_KERNEL: u64 = 5;

/// Size and computation of a network.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Cost {
    /// Number of parameters.
    pub parameters: u64,
    /// Multiply–add operations per predicted frame, with the cost of the context divided by the horizon, rounded up.
    pub multiply_adds_per_frame: u64,
}

/// `ConvLSTM` (Shi et al., NIPS 2015, table 1): frames in patches of 4×4 px, an encoder of three peephole layers with 128,
/// 64 and 64 channels, a forecaster of the same layers in reverse order whose only input is the encoder's states, and a 1×1
/// convolution from all its states to patches.
#[must_use]
pub fn conv_lstm(spec: &ModelSpec) -> Cost {
    conv_lstm_of(spec, &[128, 64, 64])
}

fn conv_lstm_of(spec: &ModelSpec, hidden: &[u64]) -> Cost {
    const PATCH_SIDE_PX: u32 = 4;
    let patch = u64::from(PATCH_SIDE_PX * PATCH_SIDE_PX);
    let positions = positions(spec, PATCH_SIDE_PX);
    let (mut encoder, mut forecaster) = (LayerCosts::default(), LayerCosts::default());
    let mut inputs = patch;
    for &hidden in hidden {
        encoder.lstm(inputs, hidden, positions);
        encoder.peepholes(hidden, positions);
        inputs = hidden;
    }
    inputs = 0;
    for &hidden in hidden.iter().rev() {
        forecaster.lstm(inputs, hidden, positions);
        forecaster.peepholes(hidden, positions);
        inputs = hidden;
    }
    forecaster.convolution(1, hidden.iter().sum(), patch, positions);
    let (context, horizon) = (spec.context as u64, spec.horizon.max(1) as u64);
    Cost {
        parameters: encoder.parameters + forecaster.parameters,
        multiply_adds_per_frame: (context * encoder.products).div_ceil(horizon) + forecaster.products,
    }
}

/// CDNA (Finn, Goodfellow & Levine, NIPS 2016, figure 1; skips and kernel sizes as in the program its authors released):
/// seven convolutional LSTMs of 32, 32, 64, 64, 128, 64 and 32 channels at halves, quarters and eighths of the frame's
/// sides, ten 5×5 kernels that move the last frame's pixels, and eleven masks that combine the moved images. It gets the same
/// actions and states as the model. Its prediction of the next state is not counted.
#[must_use]
pub fn cdna(spec: &ModelSpec) -> Cost {
    const KERNELS: u64 = 10 * 5 * 5;
    const MASKS: u64 = 11;
    let [full, half, quarter, eighth] = [1, 2, 4, 8].map(|stride| positions(spec, stride));
    let conditioning_inputs = spec.conditioning_inputs() as u64;
    let mut step = LayerCosts::default();
    step.convolution(5, 1, 32, half);
    step.lstm(32, 32, half);
    step.lstm(32, 32, half);
    step.convolution(3, 32, 32, quarter);
    step.lstm(32, 64, quarter);
    step.lstm(64, 64, quarter);
    step.convolution(3, 64, 64, eighth);
    step.convolution(1, 64 + conditioning_inputs, 64, eighth);
    step.lstm(64, 128, eighth);
    // The three convolutions that enlarge are transposed: they apply their weights at every position of their input.
    step.convolution(3, 128, 128, eighth);
    step.lstm(128, 64, quarter);
    step.convolution(3, 64 + 32, 64 + 32, quarter);
    step.lstm(64 + 32, 32, half);
    step.convolution(3, 32 + 32, 32 + 32, half);
    step.convolution(1, 64, 1, full);
    step.convolution(1, 64, MASKS, full);
    step.convolution(1, 128 * eighth, KERNELS, 1);
    step.products += (KERNELS + MASKS) * full;
    // Every step predicts; the last context step predicts the first frame of the horizon.
    let (steps, horizon) = ((spec.context + spec.horizon).saturating_sub(1), spec.horizon.max(1));
    Cost {
        parameters: step.parameters,
        multiply_adds_per_frame: (steps as u64 * step.products).div_ceil(horizon as u64),
    }
}

/// Number of positions of a layer with this stride on a frame.
fn positions(spec: &ModelSpec, stride_px: u32) -> u64 {
    u64::from(spec.frame_width_px.div_ceil(stride_px)) * u64::from(spec.frame_height_px.div_ceil(stride_px))
}

/// The cost of one time step of a network, summed over its layers.
#[derive(Default)]
struct LayerCosts {
    parameters: u64,
    products: u64,
}

impl LayerCosts {
    fn convolution(&mut self, side: u64, inputs: u64, outputs: u64, positions: u64) {
        let weights = side * side * inputs * outputs;
        self.parameters += weights + outputs;
        self.products += weights * positions;
    }

    /// Four gates, each a convolution of the input and the previous output.
    fn lstm(&mut self, inputs: u64, hidden: u64, positions: u64) {
        self.convolution(LSTM_KERNEL, inputs + hidden, 4 * hidden, positions);
    }

    /// Three gates get the cell state, with one weight for each channel.
    fn peepholes(&mut self, hidden: u64, positions: u64) {
        self.parameters += 3 * hidden;
        self.products += 3 * hidden * positions;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::nn::{ChannelScale, Conditioning};

    /// One context frame, one predicted frame.
    fn single(side_px: u32) -> ModelSpec {
        ModelSpec {
            frame_width_px: side_px,
            frame_height_px: side_px,
            context: 1,
            horizon: 1,
            ..ModelSpec::default()
        }
    }

    #[test]
    fn convlstm_has_as_many_parameters_as_published() {
        // Table 1 of Shi et al.: one, two and three layers.
        for (hidden, printed) in [
            (&[256][..], 13_524_496),
            (&[128, 128], 10_042_896),
            (&[128, 64, 64], 7_585_296),
        ] {
            assert_eq!(conv_lstm_of(&single(64), hidden).parameters, printed, "{hidden:?}");
        }
    }

    #[test]
    fn convlstm_uses_each_weight_once_on_one_patch() {
        // Encoder 25·(16+2)·8 + 3·2 and forecaster 25·2·8 + 3·2 + 2·16, at a single position.
        assert_eq!(conv_lstm_of(&single(4), &[2]).multiply_adds_per_frame, 3606 + 438);
        // Two context frames run the encoder twice; four patches use every weight four times.
        let longer = ModelSpec {
            context: 2,
            ..single(8)
        };
        assert_eq!(
            conv_lstm_of(&longer, &[2]).multiply_adds_per_frame,
            4 * (2 * 3606 + 438)
        );
    }

    #[test]
    fn the_cost_of_cdna_at_8_px_matches_a_manual_count() {
        // Weights grouped by their resolution, in the order of the layers:
        let at_half = 800 + 204_800 + 204_800 + 409_600 + 36_864;
        let at_quarter = 9_216 + 614_400 + 819_200 + 1_228_800 + 82_944;
        let at_eighth = 36_864 + 4_096 + 2_457_600 + 147_456;
        let (at_full, kernels, biases) = (64 + 704, 32_000, 2_406);
        let cost = cdna(&single(8));
        assert_eq!(
            cost.parameters,
            at_half + at_quarter + at_eighth + at_full + kernels + biases
        );
        let moved_and_combined = (250 + 11) * 64;
        let products = 16 * at_half + 4 * at_quarter + at_eighth + 64 * at_full + kernels + moved_and_combined;
        assert_eq!(cost.multiply_adds_per_frame, products);
        assert_eq!((cost.parameters, products), (6_292_614, 27_471_936));
    }

    #[test]
    fn cdna_gets_actions_at_an_eighth_of_the_resolution() {
        let channel = ChannelScale {
            name: "linear".to_owned(),
            unit: "m/s".to_owned(),
            mean: 0.0,
            std: 1.0,
        };
        let with_action = ModelSpec {
            conditioning: Conditioning::Action,
            actions: vec![channel],
            ..single(16)
        };
        let (with_action, without) = (cdna(&with_action), cdna(&single(16)));
        assert_eq!(with_action.parameters - without.parameters, 64);
        assert_eq!(
            with_action.multiply_adds_per_frame - without.multiply_adds_per_frame,
            4 * 64
        );
    }
}
