//! Products with weights of 16 or 8 bits, by instructions that multiply neighbouring inputs of a place at once and add up what they
//! give: two of bfloat16, or four whole numbers. Such neighbours are a group, of 32 bits.
//!
//! Whole numbers: x = scale · (byte − zero), with one scale and zero for a row or an image, so that 0 is exact; w = factor · byte, with
//! one factor for each output. A sum of products of bytes is exact. It becomes
//! scale · factor · (Σ byte of x · byte of w − zero · Σ byte of w).
// A closure's vector instructions reach what is inlined into it, and only that.
#![allow(clippy::inline_always)]

#[cfg(target_arch = "aarch64")]
mod arm;
#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
mod bytes;
mod instructions;
#[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
mod products;

pub(super) use bytes::ByteRange;
use instructions::ReducedInstructions;

use super::packed::{StartSums, TapRun};
use super::scratch::with_groups;
use crate::nn::precision::Precision;
use crate::vectorized::vectorized;

/// Outputs whose sums are computed together.
const LANES: usize = 16;

/// Neighbouring inputs of a place.
pub(super) type Group = [u8; 4];

/// A vector of 512 bits.
#[derive(Clone, Copy, Debug)]
#[repr(C, align(64))]
struct Register<T>([T; LANES]);

/// Weights and a bias.
#[derive(Debug)]
pub(in crate::nn) struct ReducedWeights {
    outputs: usize,
    precision: Precision,
    instructions: ReducedInstructions,
    panels: Vec<ReducedPanel>,
}

/// The weights of neighbouring outputs, filled up with zeros to whole vectors.
#[derive(Debug)]
struct ReducedPanel {
    /// The first of them.
    first: usize,
    /// Vectors of a group's weights.
    vectors: usize,
    /// Whether the second half of the last one has no outputs.
    ends_with_half: bool,
    /// `[groups, vectors]`.
    weights: Vec<Register<Group>>,
    /// `[vectors]` each: of whole numbers, the factors and the sums of the weights.
    factors: Vec<Register<f32>>,
    weight_sums: Vec<Register<i32>>,
    bias: Vec<Register<f32>>,
}

/// The groups of neighbouring places.
#[derive(Clone, Copy)]
pub(super) struct PlaceGroups<'a> {
    pub(super) groups: &'a [Group],
    /// Groups from one place's beginning to the next one's.
    pub(super) step: usize,
    /// What each place reads, in groups.
    pub(super) runs: &'a [TapRun],
    /// Of whole numbers: one for each place, or one for all.
    pub(super) ranges: &'a [ByteRange],
}

/// What one call computes.
struct ReducedProduct<'a> {
    weights: &'a ReducedWeights,
    inputs: PlaceGroups<'a>,
    out: &'a mut [f32],
    start: StartSums,
}

impl ReducedWeights {
    /// Packs weights `[inputs, outputs]` and a bias `[outputs]`. The inputs are runs of that many, each filled up to whole groups. A
    /// processor without instructions for the precision is a bug.
    pub(super) fn new(weights: &[f32], bias: &[f32], run: usize, precision: Precision) -> Self {
        let instructions = ReducedInstructions::all(precision);
        let fastest = instructions.first().expect("an unsupported precision is a bug");
        Self::with(*fastest, precision, [weights, bias], run)
    }

    fn with(instructions: ReducedInstructions, precision: Precision, [weights, bias]: [&[f32]; 2], run: usize) -> Self {
        let outputs = bias.len();
        let vectors = outputs.div_ceil(LANES);
        let panels = vectors.div_ceil(instructions.most_vectors());
        let mut packed = Self {
            outputs,
            precision,
            instructions,
            panels: Vec::new(),
        };
        for index in 0..panels {
            // As equal as possible.
            let vectors = [index, index + 1].map(|index| index * vectors / panels);
            packed.panels.push(packed.panel([weights, bias], vectors, run));
        }
        packed
    }

    pub(super) fn outputs(&self) -> usize {
        self.outputs
    }

    /// Writes the sums of each place to `out` `[places, outputs]`.
    pub(super) fn multiply(&self, inputs: PlaceGroups, out: &mut [f32], start: StartSums) {
        self.instructions.multiply(ReducedProduct {
            weights: self,
            inputs,
            out,
            start,
        });
    }

    /// The sums of rows `[rows, inputs]` without neighbours. Bytes have one range for each row.
    pub(super) fn multiply_rows(&self, rows: &[f32], out: &mut [f32]) {
        self.multiply_in_ranges(rows, out, 1);
    }

    /// The same, with one range for all rows. It is found in less time, and rows with values of one kind lose little.
    pub(super) fn multiply_alike(&self, rows: &[f32], out: &mut [f32]) {
        self.multiply_in_ranges(rows, out, usize::MAX);
    }

    fn multiply_in_ranges(&self, rows: &[f32], out: &mut [f32], rows_of_range: usize) {
        let count = out.len() / self.outputs;
        if count == 0 {
            return;
        }
        let rows_of_range = rows_of_range.min(count);
        let inputs = rows.len() / count;
        let length = inputs.div_ceil(inputs_of_group(self.precision));
        let runs = [TapRun {
            offset: 0,
            first: 0,
            length,
        }];
        with_groups(count * length, |groups| {
            let mut ranges = Vec::new();
            match self.precision {
                Precision::Int8 => {
                    let groups = groups.chunks_exact_mut(rows_of_range * length);
                    for (rows, groups) in rows.chunks_exact(rows_of_range * inputs).zip(groups) {
                        let range = ByteRange::of(rows);
                        range.write(rows, inputs, groups);
                        ranges.push(range);
                    }
                }
                Precision::F32 | Precision::Bf16 => write_halves(rows, inputs, groups),
            }
            let inputs = PlaceGroups {
                groups,
                step: length,
                runs: &runs,
                ranges: &ranges,
            };
            self.multiply(inputs, out, StartSums::Bias);
        });
    }

    /// The weights and the bias of the vectors `from..to` of outputs.
    fn panel(&self, [weights, bias]: [&[f32]; 2], [from, to]: [usize; 2], run: usize) -> ReducedPanel {
        let (outputs, precision) = (self.outputs, self.precision);
        let weight = |input: usize, output: usize| {
            let row = weights.chunks_exact(outputs).nth(input);
            row.and_then(|row| row.get(output)).copied().unwrap_or(0.0)
        };
        let inputs = weights.len() / outputs;
        let lanes = |vector: usize| (from + vector) * LANES..(from + vector + 1) * LANES;
        let of_outputs = |value: &dyn Fn(usize) -> f32| -> Vec<Register<f32>> {
            let vector = |vector| {
                let first = lanes(vector).start;
                Register(std::array::from_fn(|lane| value(first + lane)))
            };
            (0..to - from).map(vector).collect()
        };
        let factors = of_outputs(&|output| {
            let largest = (0..inputs).fold(0.0f32, |most, input| most.max(weight(input, output).abs()));
            if largest > 0.0 {
                largest / self.instructions.most_of_weight()
            } else {
                1.0
            }
        });
        let mut weight_sums = vec![Register([0; LANES]); to - from];
        let mut packed = Vec::new();
        for first in (0..inputs).step_by(run.max(1)) {
            for group in (0..run).step_by(inputs_of_group(precision)) {
                for (vector, sums) in weight_sums.iter_mut().enumerate() {
                    let mut groups = Register([[0; 4]; LANES]);
                    for (lane, output) in lanes(vector).enumerate() {
                        // A run's end has no weights of the next one.
                        let value = |at: usize| {
                            if group + at < run {
                                weight(first + group + at, output)
                            } else {
                                0.0
                            }
                        };
                        groups.0[lane] = match precision {
                            Precision::Int8 => {
                                let bytes = [0, 1, 2, 3].map(|at| (value(at) / factors[vector].0[lane]).round() as i8);
                                sums.0[lane] += bytes.map(i32::from).iter().sum::<i32>();
                                bytes.map(i8::cast_unsigned)
                            }
                            Precision::F32 | Precision::Bf16 => halves([value(0), value(1)]),
                        };
                    }
                    packed.push(groups);
                }
            }
        }
        ReducedPanel {
            first: from * LANES,
            vectors: to - from,
            ends_with_half: outputs + LANES / 2 <= to * LANES,
            weights: packed,
            factors,
            weight_sums,
            bias: of_outputs(&|output| bias.get(output).copied().unwrap_or(0.0)),
        }
    }
}

/// Inputs of a group.
pub(super) fn inputs_of_group(precision: Precision) -> usize {
    if precision == Precision::Int8 { 4 } else { 2 }
}

/// Writes rows `[rows, inputs]` as bfloat16; the last group of each is filled up with a zero.
fn write_halves(rows: &[f32], inputs: usize, groups: &mut [Group]) {
    let length = inputs.next_multiple_of(inputs_of_group(Precision::Bf16));
    let to = groups.as_flattened_mut().as_chunks_mut::<2>().0;
    vectorized(
        #[inline(always)]
        || {
            if length == inputs {
                return write_bfloats(rows, to);
            }
            for (row, to) in rows.chunks_exact(inputs).zip(to.chunks_exact_mut(length)) {
                write_bfloats(row, to);
                to[inputs..].fill([0; 2]);
            }
        },
    );
}

#[inline(always)]
fn write_bfloats(values: &[f32], to: &mut [[u8; 2]]) {
    for (to, value) in to.iter_mut().zip(values) {
        *to = bfloat(*value).to_le_bytes();
    }
}

/// A group of bfloat16.
fn halves(values: [f32; 2]) -> Group {
    let [[a, b], [c, d]] = values.map(|value| bfloat(value).to_le_bytes());
    [a, b, c, d]
}

/// A value as bfloat16, rounded to the nearest, ties to even.
#[inline(always)]
fn bfloat(value: f32) -> u16 {
    let bits = value.to_bits();
    (bits.wrapping_add(0x7fff + (bits >> 16 & 1)) >> 16) as u16
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::nn::gradient_check::noise;

    fn values(count: usize, seed: u64) -> Vec<f32> {
        noise(&[count], seed).to_vec1().unwrap()
    }

    /// What a value becomes in bfloat16.
    fn half(value: f32) -> f32 {
        f32::from_bits(u32::from(bfloat(value)) << 16)
    }

    #[test]
    fn products_are_those_of_the_rounded_numbers() {
        for precision in [Precision::Bf16, Precision::Int8] {
            if !precision.is_supported() {
                eprintln!("skipped: this processor does not multiply {precision}");
            }
            let all = ReducedInstructions::all(precision).into_iter();
            all.for_each(|instructions| check_products(precision, instructions));
        }
    }

    fn check_products(precision: Precision, instructions: ReducedInstructions) {
        for (rows, inputs, outputs) in [
            (1, 3, 1),
            (13, 20, 12),
            (8, 7, 16),
            (30, 33, 48),
            (13, 20, 24),
            (5, 9, 40),
            (3, 7, 8),
            (5, 9, 50),
            (3, 4, 129),
        ] {
            let (x, weights, bias) = (
                values(rows * inputs, 1),
                values(inputs * outputs, 2),
                values(outputs, 3),
            );
            let mut out = vec![7.0; rows * outputs];
            let packed = ReducedWeights::with(instructions, precision, [&weights, &bias], inputs);
            packed.multiply_rows(&x, &mut out);
            for (index, found) in out.iter().enumerate() {
                let (row, output) = (index / outputs, index % outputs);
                let row = &x[row * inputs..(row + 1) * inputs];
                let column: Vec<f32> = (0..inputs).map(|input| weights[input * outputs + output]).collect();
                let (row, column) = match precision {
                    Precision::Int8 => (of_bytes(row), of_weight_bytes(&column, instructions.most_of_weight())),
                    _ => [row, &column]
                        .map(|values| values.iter().map(|value| half(*value)).collect())
                        .into(),
                };
                let expected = bias[output] + row.iter().zip(&column).map(|(x, w)| x * w).sum::<f32>();
                assert!(
                    (found - expected).abs() < 2e-5,
                    "{instructions:?}, {precision}: {found} {expected}"
                );
            }
        }
    }

    /// The values that a row's bytes stand for.
    fn of_bytes(row: &[f32]) -> Vec<f32> {
        let range = ByteRange::of(row);
        let mut groups = vec![[0; 4]; row.len().div_ceil(4)];
        range.write(row, row.len(), &mut groups);
        let bytes = groups.as_flattened()[..row.len()].iter();
        bytes
            .map(|byte| (f32::from(*byte) - f32::from(range.zero)) * range.scale)
            .collect()
    }

    fn of_weight_bytes(column: &[f32], most: f32) -> Vec<f32> {
        let factor = column.iter().fold(0.0f32, |most, weight| most.max(weight.abs())) / most;
        column.iter().map(|weight| (weight / factor).round() * factor).collect()
    }

    #[test]
    fn sums_of_the_largest_bytes_are_exact() {
        const INPUTS: usize = 1000;
        for instructions in ReducedInstructions::all(Precision::Int8) {
            for (input, weight) in [(1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)] {
                let weights = vec![weight; INPUTS * 20];
                let packed = ReducedWeights::with(instructions, Precision::Int8, [&weights, &[0.0; 20]], INPUTS);
                let mut out = [0.0; 7 * 20];
                packed.multiply_rows(&vec![input; 7 * INPUTS], &mut out);
                let expected = input * weight * INPUTS as f32;
                assert!(
                    out.iter().all(|found| (found - expected).abs() < 1e-3),
                    "{instructions:?}: {out:?}"
                );
            }
        }
    }

    #[test]
    fn bytes_stand_for_nearly_the_same_values() {
        for row in [
            &[0.0; 5][..],
            &[-1.0, 2.5, 0.3, 1e-3, 0.0, 2.4999],
            &[3.0, 7.0],
            &[-0.1; 7],
        ] {
            let scale = ByteRange::of(row).scale;
            for (found, value) in of_bytes(row).into_iter().zip(row) {
                assert!((found - value).abs() <= 0.5001 * scale, "{row:?}: {found} {value}");
                assert!(*value != 0.0 || found == 0.0, "{row:?}: {found}");
            }
        }
    }

    #[test]
    fn halves_are_the_nearest() {
        for (value, expected) in [
            (1.0, 1.0),
            (1.003, 1.0),
            (1.005, 1.007_812_5),
            (-3.3, -3.296_875),
            (0.0, 0.0),
        ] {
            assert_eq!(half(value), expected);
        }
    }
}
