//! The loops of a product, the same for each kind of instructions.
// A function's vector instructions reach what is inlined into it, and only that.
#![allow(clippy::inline_always)]

use super::{ByteRange, LANES, PlaceGroups, ReducedPanel, ReducedProduct, Register};
use crate::nn::ops::packed::StartSums;

/// A function that computes a product with instructions of its own. `places 8 then 4, vectors 1 2 3`: the sums of 8 places stay in
/// registers while the inputs and weights pass by, for as many vectors of outputs as a panel has, which is 1, 2 or 3; what is left is
/// computed for 4 places at once, then for each alone.
macro_rules! products {
    (
        fn $name:ident, $features:literal, places $places:literal then $fewer:literal, vectors $($vectors:literal)*,
        sums $no_sum:expr, weights $weights:path, group $group:path, add $add:path, finish $finish:path
    ) => {
        #[target_feature(enable = $features)]
        pub(super) fn $name(mut product: ReducedProduct) {
            #[target_feature(enable = $features)]
            fn panel<const VECTORS: usize>(product: &mut ReducedProduct, panel: &ReducedPanel) {
                let (mut place, places) = (0, product.out.len() / product.weights.outputs);
                while place + $places <= places {
                    block::<$places, VECTORS>(product, panel, place);
                    place += $places;
                }
                while place + $fewer <= places {
                    block::<$fewer, VECTORS>(product, panel, place);
                    place += $fewer;
                }
                while place < places {
                    block::<1, VECTORS>(product, panel, place);
                    place += 1;
                }
            }

            #[target_feature(enable = $features)]
            #[inline]
            fn block<const PLACES: usize, const VECTORS: usize>(
                product: &mut ReducedProduct,
                panel: &ReducedPanel,
                place: usize,
            ) {
                let PlaceGroups {
                    groups, step, runs, ..
                } = product.inputs;
                let weights = panel.weights.as_chunks::<VECTORS>().0;
                let mut sums = [[$no_sum; VECTORS]; PLACES];
                for run in runs {
                    let weights = &weights[run.first..][..run.length];
                    // A slice of the loop's length needs no check in the loop, which would keep the sums out of the registers.
                    let mut inputs: [&[Group]; PLACES] = [&[]; PLACES];
                    for (at, inputs) in inputs.iter_mut().enumerate() {
                        *inputs = &groups[(place + at) * step + run.offset..][..weights.len()];
                    }
                    for (input, weights) in weights.iter().enumerate() {
                        for at in 0..PLACES {
                            let group = $group(inputs[at][input]);
                            for vector in 0..VECTORS {
                                sums[at][vector] = $add(sums[at][vector], group, $weights(weights[vector]));
                            }
                        }
                    }
                }
                for (at, sums) in sums.into_iter().enumerate() {
                    for (vector, sums) in sums.into_iter().enumerate() {
                        let values = $finish(sums, product.inputs.range(place + at), panel, vector);
                        product.store(panel, [place + at, vector], values);
                    }
                }
            }

            for outputs in &product.weights.panels {
                match outputs.vectors {
                    $($vectors => panel::<$vectors>(&mut product, outputs),)*
                    others => unreachable!("{others} vectors of outputs are a bug"),
                }
            }
        }
    };
}

pub(super) use products;

impl PlaceGroups<'_> {
    /// What the bytes of a place stand for.
    #[inline(always)]
    pub(super) fn range(&self, place: usize) -> Option<ByteRange> {
        match self.ranges {
            [all] => Some(*all),
            ranges => ranges.get(place).copied(),
        }
    }
}

impl ReducedProduct<'_> {
    /// Writes the sums of a vector of outputs at a place.
    #[inline(always)]
    pub(super) fn store(&mut self, panel: &ReducedPanel, [place, vector]: [usize; 2], Register(sums): Register<f32>) {
        let outputs = self.weights.outputs;
        let first = panel.first + vector * LANES;
        let out = &mut self.out[place * outputs + first..][..LANES.min(outputs - first)];
        let held = |at: usize, out: &[f32]| if self.start == StartSums::Output { out[at] } else { 0.0 };
        match out.as_mut_array::<LANES>() {
            Some(out) => {
                for at in 0..LANES {
                    out[at] = sums[at] + held(at, out);
                }
            }
            None => {
                for at in 0..out.len() {
                    out[at] = sums[at] + held(at, out);
                }
            }
        }
    }
}

/// What sums of products of bytes stand for, with the bias. `shift` was taken from each byte of an input before.
#[inline(always)]
pub(super) fn dequantized(
    Register(sums): Register<i32>,
    shift: i32,
    range: Option<ByteRange>,
    panel: &ReducedPanel,
    vector: usize,
) -> Register<f32> {
    let ByteRange { scale, zero } = range.expect("a place without a range is a bug");
    let zero = i32::from(zero) - shift;
    let Register(mut values) = panel.bias[vector];
    for lane in 0..LANES {
        let of_zeros = zero.wrapping_mul(panel.weight_sums[vector].0[lane]);
        let factor = scale * panel.factors[vector].0[lane];
        values[lane] += sums[lane].wrapping_sub(of_zeros) as f32 * factor;
    }
    Register(values)
}
