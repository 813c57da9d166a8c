//! Products with packed weights. For prediction, weights are packed once, when a model is loaded. Training packs those of its convolutions
//! in every pass. A block of sums stays in registers while the inputs and weights pass by, so nothing is copied and no product lies in
//! memory. On one core with AVX-512, this is about twice as fast as general matrix products of the same small sizes.
// A closure's vector instructions reach what is inlined into it, and only that.
#![allow(clippy::inline_always)]

use pulp::{Arch, Simd, WithSimd};

/// The weights `[inputs, outputs]` of a layer, and its bias, in vectors as wide as this machine's.
#[derive(Debug)]
pub(in crate::nn) struct PackedWeights {
    outputs: usize,
    panels: Vec<OutputPanel>,
}

/// The weights of neighbouring outputs, filled up with zeros to whole vectors.
#[derive(Debug)]
struct OutputPanel {
    /// The first of them.
    first: usize,
    /// Vectors of an input's weights.
    vectors: usize,
    /// `[inputs, vectors]`.
    weights: Vec<f32>,
    /// `[vectors]`.
    bias: Vec<f32>,
}

/// Inputs of a place that lie side by side: for a convolution, taps of its kernel.
#[derive(Clone, Copy, Debug)]
pub(in crate::nn) struct TapRun {
    /// From the place's beginning, in values.
    pub(in crate::nn) offset: usize,
    /// The first of them among the weights' inputs.
    pub(in crate::nn) first: usize,
    pub(in crate::nn) length: usize,
}

/// The inputs of neighbouring places.
#[derive(Clone, Copy)]
pub(in crate::nn) struct PlaceInputs<'a> {
    pub(in crate::nn) values: &'a [f32],
    /// Values from one place's beginning to the next one's.
    pub(in crate::nn) step: usize,
    /// What each place reads.
    pub(in crate::nn) runs: &'a [TapRun],
}

/// What a place's sums start from.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(in crate::nn) enum StartSums {
    /// The bias.
    Bias,
    /// What the output holds, and the bias.
    Output,
}

impl PackedWeights {
    /// Packs weights `[inputs, outputs]` and a bias `[outputs]`.
    pub(in crate::nn) fn new(weights: &[f32], bias: &[f32]) -> Self {
        let (Registers { lanes, vectors: most }, outputs) = (registers(), bias.len());
        let vectors = outputs.div_ceil(lanes);
        let panels = vectors.div_ceil(most);
        let panel = |index: usize| {
            // As equal as possible.
            let [from, to] = [index, index + 1].map(|index| index * vectors / panels);
            let (first, width) = (from * lanes, (to - from) * lanes);
            let filled = |row: &[f32]| {
                let mut filled = row[first..outputs.min(first + width)].to_vec();
                filled.resize(width, 0.0);
                filled
            };
            OutputPanel {
                first,
                vectors: to - from,
                weights: weights.chunks_exact(outputs).flat_map(filled).collect(),
                bias: filled(bias),
            }
        };
        Self {
            outputs,
            panels: (0..panels).map(panel).collect(),
        }
    }

    pub(in crate::nn) fn outputs(&self) -> usize {
        self.outputs
    }

    /// Writes the sums of each place to `out` `[places, outputs]`.
    pub(in crate::nn) fn multiply(&self, inputs: PlaceInputs, out: &mut [f32], start: StartSums) {
        Arch::new().dispatch(Product {
            weights: self,
            inputs,
            out,
            start,
        });
    }

    /// The sums of places `[places, inputs]` without neighbours.
    pub(in crate::nn) fn multiply_rows(&self, rows: &[f32], out: &mut [f32]) {
        let length = rows.len() / (out.len() / self.outputs).max(1);
        let runs = [TapRun {
            offset: 0,
            first: 0,
            length,
        }];
        let inputs = PlaceInputs {
            values: rows,
            step: length,
            runs: &runs,
        };
        self.multiply(inputs, out, StartSums::Bias);
    }
}

/// How many f32 a vector of this machine holds.
pub(super) fn lanes() -> usize {
    registers().lanes
}

/// The registers of this machine.
struct Registers {
    lanes: usize,
    /// Most vectors of outputs whose sums are kept in registers together.
    vectors: usize,
}

fn registers() -> Registers {
    Arch::new().dispatch(AskRegisters)
}

struct AskRegisters;

impl WithSimd for AskRegisters {
    type Output = Registers;

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) -> Registers {
        Registers {
            lanes: S::F32_LANES,
            vectors: if has_many::<S>() { 3 } else { 2 },
        }
    }
}

/// Whether there are more than the 16 vector registers of processors with AVX2.
#[inline(always)]
fn has_many<S: Simd>() -> bool {
    S::REGISTER_COUNT > 16
}

struct Product<'a> {
    weights: &'a PackedWeights,
    inputs: PlaceInputs<'a>,
    out: &'a mut [f32],
    start: StartSums,
}

impl WithSimd for Product<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, simd: S) {
        for panel in &self.weights.panels {
            match panel.vectors {
                1 => self.panel::<S, 1>(simd, panel),
                2 => self.panel::<S, 2>(simd, panel),
                _ => self.panel::<S, 3>(simd, panel),
            }
        }
    }
}

impl Product<'_> {
    #[inline(always)]
    fn panel<S: Simd, const VECTORS: usize>(&mut self, simd: S, panel: &OutputPanel) {
        let (mut place, places) = (0, self.out.len() / self.weights.outputs);
        // Sums, weights and one input fit the registers. With all of 16 registers in use, the compiler would move sums to memory and back.
        while has_many::<S>() && place + 8 <= places {
            self.block::<S, 8, VECTORS>(simd, panel, place);
            place += 8;
        }
        while !has_many::<S>() && VECTORS == 1 && place + 12 <= places {
            self.block::<S, 12, VECTORS>(simd, panel, place);
            place += 12;
        }
        while !has_many::<S>() && place + 6 <= places {
            self.block::<S, 6, VECTORS>(simd, panel, place);
            place += 6;
        }
        while place + 4 <= places {
            self.block::<S, 4, VECTORS>(simd, panel, place);
            place += 4;
        }
        while place < places {
            self.block::<S, 1, VECTORS>(simd, panel, place);
            place += 1;
        }
    }

    /// The sums of a panel's outputs at `PLACES` places.
    #[inline(always)]
    fn block<S: Simd, const PLACES: usize, const VECTORS: usize>(
        &mut self,
        simd: S,
        panel: &OutputPanel,
        place: usize,
    ) {
        let outputs = self.weights.outputs;
        let weights = S::as_simd_f32s(&panel.weights).0.as_chunks::<VECTORS>().0;
        let (bias, _) = S::as_simd_f32s(&panel.bias);
        // The part of the output that a vector of sums goes to.
        let part = |at: usize, vector: usize| {
            let first = panel.first + vector * S::F32_LANES;
            let from = (place + at) * outputs + first;
            from..from + S::F32_LANES.min(outputs - first)
        };
        let mut sums = [[simd.splat_f32s(0.0); VECTORS]; PLACES];
        for (at, sums) in sums.iter_mut().enumerate() {
            for (vector, sum) in sums.iter_mut().enumerate() {
                *sum = bias[vector];
                if self.start == StartSums::Output {
                    *sum = simd.add_f32s(*sum, load(simd, &self.out[part(at, vector)]));
                }
            }
        }
        let PlaceInputs { values, step, runs } = self.inputs;
        for run in runs {
            let weights = &weights[run.first..][..run.length];
            // Slices of the loop's length need no check in the loop. A closure for each place would stay a call.
            let mut inputs: [&[f32]; PLACES] = [&[]; PLACES];
            for (at, inputs) in inputs.iter_mut().enumerate() {
                *inputs = &values[(place + at) * step + run.offset..][..weights.len()];
            }
            sums = with_products(simd, sums, inputs, weights);
            if !has_many::<S>() {
                // Puts the sums in memory between the runs. Otherwise the compiler would leave some there within them too.
                sums = std::hint::black_box(sums);
            }
        }
        for (at, sums) in sums.iter().enumerate() {
            for (vector, sum) in sums.iter().enumerate() {
                store(simd, &mut self.out[part(at, vector)], *sum);
            }
        }
    }
}

/// Adds, for each place, the products of its inputs with the weights. There are as many inputs as weights.
#[inline(always)]
fn with_products<S: Simd, const PLACES: usize, const VECTORS: usize>(
    simd: S,
    mut sums: [[S::f32s; VECTORS]; PLACES],
    inputs: [&[f32]; PLACES],
    weights: &[[S::f32s; VECTORS]],
) -> [[S::f32s; VECTORS]; PLACES] {
    for (input, weights) in weights.iter().enumerate() {
        for at in 0..PLACES {
            let value = simd.splat_f32s(inputs[at][input]);
            for vector in 0..VECTORS {
                sums[at][vector] = simd.mul_add_e_f32s(value, weights[vector], sums[at][vector]);
            }
        }
    }
    sums
}

/// A vector of as many values as there are, at most the lanes.
#[inline(always)]
fn load<S: Simd>(simd: S, values: &[f32]) -> S::f32s {
    match S::as_simd_f32s(values).0 {
        [whole] => *whole,
        _ => simd.partial_load_f32s(values),
    }
}

/// Writes as many values as there is place for, at most the lanes.
#[inline(always)]
fn store<S: Simd>(simd: S, to: &mut [f32], values: S::f32s) {
    match S::as_mut_simd_f32s(to) {
        ([whole], _) => *whole = values,
        (_, part) => simd.partial_store_f32s(part, values),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::nn::gradient_check::noise;

    fn values(count: usize, seed: u64) -> Vec<f32> {
        noise(&[count], seed).to_vec1().unwrap()
    }

    #[test]
    fn packed_products_agree_with_plain_sums() {
        for (places, inputs, outputs) in [
            (1, 3, 1),
            (13, 20, 12),
            (8, 7, 16),
            (30, 33, 48),
            (5, 9, 50),
            (3, 4, 129),
            (1, 21, 40),
            (1, 21, 200),
            (1, 7, 515),
        ] {
            let (x, weights, bias) = (
                values(places * inputs, 1),
                values(inputs * outputs, 2),
                values(outputs, 3),
            );
            let mut out = vec![7.0; places * outputs];
            PackedWeights::new(&weights, &bias).multiply_rows(&x, &mut out);
            for (index, found) in out.iter().enumerate() {
                let (place, output) = (index / outputs, index % outputs);
                let products = (0..inputs).map(|input| x[place * inputs + input] * weights[input * outputs + output]);
                let expected = bias[output] + products.sum::<f32>();
                assert!((found - expected).abs() < 1e-5, "{found} {expected}");
            }
        }
    }
}
