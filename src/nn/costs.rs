//! What two published video predictors would cost on a model's frames: the comparison that the paper makes in words.
//!
//! Both are counted as [`ModelSpec::multiply_adds_per_frame`] counts: products of weights only, the steps through the
//! context spread over the frames predicted. Frames are gray. Normalization layers are left out.

use super::ModelSpec;

/// Side of the kernels of every recurrent layer, in both networks.
const LSTM_KERNEL: u64 = 5;

/// The trained numbers of a network and its work.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Cost {
    /// Trained numbers.
    pub parameters: u64,
    /// Multiply–adds to predict one frame, the context's steps shared out, rounded up.
    pub multiply_adds_per_frame: u64,
}

/// `ConvLSTM` (Shi et al., NIPS 2015, table 1): frames cut into patches of 4×4 px, an encoder of three peephole layers of
/// 128, 64 and 64 channels, a forecaster of the same layers reversed that reads nothing but their states, and a 1×1
/// convolution of all its states back to patches.
#[must_use]
pub fn conv_lstm(spec: &ModelSpec) -> Cost {
    conv_lstm_of(spec, &[128, 64, 64])
}

fn conv_lstm_of(spec: &ModelSpec, hidden: &[u64]) -> Cost {
    const PATCH_SIDE_PX: u32 = 4;
    let patch = u64::from(PATCH_SIDE_PX * PATCH_SIDE_PX);
    let places = places(spec, PATCH_SIDE_PX);
    let (mut encoder, mut forecaster) = (LayerCosts::default(), LayerCosts::default());
    let mut inputs = patch;
    for &hidden in hidden {
        encoder.lstm(inputs, hidden, places);
        encoder.peepholes(hidden, places);
        inputs = hidden;
    }
    inputs = 0;
    for &hidden in hidden.iter().rev() {
        forecaster.lstm(inputs, hidden, places);
        forecaster.peepholes(hidden, places);
        inputs = hidden;
    }
    forecaster.convolution(1, (hidden.iter().sum(), patch), places);
    let (context, horizon) = (spec.context as u64, spec.horizon.max(1) as u64);
    Cost {
        parameters: encoder.parameters + forecaster.parameters,
        multiply_adds_per_frame: (context * encoder.products).div_ceil(horizon) + forecaster.products,
    }
}

/// CDNA (Finn, Goodfellow & Levine, NIPS 2016, figure 1; skips and kernel sizes as in the program its authors released):
/// seven convolutional LSTMs of 32, 32, 64, 64, 128, 64 and 32 channels at halves, quarters and eighths of the frame's
/// sides, ten 5×5 kernels that move the last frame's pixels, and eleven masks that compose what came of it. It is told
/// the same actions and states as the model. Its prediction of the next state is left out.
#[must_use]
pub fn cdna(spec: &ModelSpec) -> Cost {
    const KERNELS: u64 = 10 * 5 * 5;
    const MASKS: u64 = 11;
    let [full, half, quarter, eighth] = [1, 2, 4, 8].map(|stride| places(spec, stride));
    let told = (spec.predictor_inputs() - spec.features) as u64;
    let mut step = LayerCosts::default();
    step.convolution(5, (1, 32), half);
    step.lstm(32, 32, half);
    step.lstm(32, 32, half);
    step.convolution(3, (32, 32), quarter);
    step.lstm(32, 64, quarter);
    step.lstm(64, 64, quarter);
    step.convolution(3, (64, 64), eighth);
    step.convolution(1, (64 + told, 64), eighth);
    step.lstm(64, 128, eighth);
    // The three that enlarge are transposed: their weights meet every place that they read.
    step.convolution(3, (128, 128), eighth);
    step.lstm(128, 64, quarter);
    step.convolution(3, (64 + 32, 64 + 32), quarter);
    step.lstm(64 + 32, 32, half);
    step.convolution(3, (32 + 32, 32 + 32), half);
    step.convolution(1, (64, 1), full);
    step.convolution(1, (64, MASKS), full);
    step.convolution(1, (128 * eighth, KERNELS), 1);
    step.products += (KERNELS + MASKS) * full;
    // Every step predicts, and the last of the context's predicts the first frame to come.
    let (steps, horizon) = ((spec.context + spec.horizon).saturating_sub(1), spec.horizon.max(1));
    Cost {
        parameters: step.parameters,
        multiply_adds_per_frame: (steps as u64 * step.products).div_ceil(horizon as u64),
    }
}

/// Places where a layer of that stride stands on a frame.
fn places(spec: &ModelSpec, stride_px: u32) -> u64 {
    u64::from(spec.frame_width_px.div_ceil(stride_px)) * u64::from(spec.frame_height_px.div_ceil(stride_px))
}

/// One step of a network in time, counted layer by layer.
#[derive(Default)]
struct LayerCosts {
    parameters: u64,
    products: u64,
}

impl LayerCosts {
    fn convolution(&mut self, side: u64, (inputs, outputs): (u64, u64), places: u64) {
        let weights = side * side * inputs * outputs;
        self.parameters += weights + outputs;
        self.products += weights * places;
    }

    /// The four gates, each from the input and the last output.
    fn lstm(&mut self, inputs: u64, hidden: u64, places: u64) {
        self.convolution(LSTM_KERNEL, (inputs + hidden, 4 * hidden), places);
    }

    /// Three gates see the cell, each channel by a weight of its own.
    fn peepholes(&mut self, hidden: u64, places: u64) {
        self.parameters += 3 * hidden;
        self.products += 3 * hidden * places;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::nn::{ChannelScale, Conditioning};

    /// One frame seen, one predicted.
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
    fn the_parameters_of_convlstm_are_those_its_authors_print() {
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
    fn the_products_of_convlstm_on_one_patch_are_its_weights_and_peepholes() {
        // Encoder 25·(16+2)·8 + 3·2 and forecaster 25·2·8 + 3·2 + 2·16, at a single place.
        assert_eq!(conv_lstm_of(&single(4), &[2]).multiply_adds_per_frame, 3606 + 438);
        // Two frames seen for one predicted take the encoder twice; four patches take all four times.
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
    fn the_cost_of_cdna_on_a_frame_of_8_px_is_that_worked_by_hand() {
        // Weights by the places they stand at, in the order of the layers:
        let at_half = 800 + 204_800 + 204_800 + 409_600 + 36_864;
        let at_quarter = 9_216 + 614_400 + 819_200 + 1_228_800 + 82_944;
        let at_eighth = 36_864 + 4_096 + 2_457_600 + 147_456;
        let (at_full, kernels, biases) = (64 + 704, 32_000, 2_406);
        let cost = cdna(&single(8));
        assert_eq!(
            cost.parameters,
            at_half + at_quarter + at_eighth + at_full + kernels + biases
        );
        let moved_and_composed = (250 + 11) * 64;
        let products = 16 * at_half + 4 * at_quarter + at_eighth + 64 * at_full + kernels + moved_and_composed;
        assert_eq!(cost.multiply_adds_per_frame, products);
        assert_eq!((cost.parameters, products), (6_292_614, 27_471_936));
    }

    #[test]
    fn what_cdna_is_told_enters_at_an_eighth_of_the_sides() {
        let channel = ChannelScale {
            name: "linear".to_owned(),
            unit: "m/s".to_owned(),
            mean: 0.0,
            std: 1.0,
        };
        let told = ModelSpec {
            conditioning: Conditioning::Action,
            actions: vec![channel],
            ..single(16)
        };
        let (told, untold) = (cdna(&told), cdna(&single(16)));
        assert_eq!(told.parameters - untold.parameters, 64);
        assert_eq!(told.multiply_adds_per_frame - untold.multiply_adds_per_frame, 4 * 64);
    }
}
