//! The loops of a product, the same for each kind of instructions.
// A function's vector instructions reach what is inlined into it, and only that.
#![allow(clippy::inline_always)]

use super::{ByteRange, LANES, PlaceGroups, ReducedPanel, ReducedProduct, Register};
use crate::nn::ops::packed::StartSums;

/// A function that computes a product with instructions of its own. `places 8 then 4, vectors 1 2 3`: the sums of 8 places stay in
/// registers while the inputs and weights pass by, for as many vectors of outputs as a panel has, which is 1, 2 or 3; what is left is
/// computed for 4 places at once, then for two and for one. The sums of a vector begin with what `start` gives, and `finish` turns them into
/// values. Where half of a panel's last vector has no outputs, `add_half` is taken, which may leave that half out.
macro_rules! products {
    (
        fn $name:ident, $features:literal, places $places:literal then $fewer:literal, vectors $($vectors:literal)*,
        weights $weights:path, group $group:path, start $start:path, add $add:path, add_half $add_half:path, finish $finish:path
    ) => {
        #[target_feature(enable = $features)]
        pub(super) fn $name(mut product: ReducedProduct) {
            #[target_feature(enable = $features)]
            fn panel<const VECTORS: usize, const HALF: bool>(product: &mut ReducedProduct, panel: &ReducedPanel) {
                let (mut place, places) = (0, product.out.len() / product.weights.outputs);
                while place + $places <= places {
                    block::<$places, VECTORS, HALF>(product, panel, place);
                    place += $places;
                }
                while place + $fewer <= places {
                    block::<$fewer, VECTORS, HALF>(product, panel, place);
                    place += $fewer;
                }
                if place + 2 <= places {
                    block::<2, VECTORS, HALF>(product, panel, place);
                    place += 2;
                }
                while place < places {
                    block::<1, VECTORS, HALF>(product, panel, place);
                    place += 1;
                }
            }

            #[target_feature(enable = $features)]
            #[inline]
            fn block<const PLACES: usize, const VECTORS: usize, const HALF: bool>(
                product: &mut ReducedProduct,
                panel: &ReducedPanel,
                place: usize,
            ) {
                let PlaceGroups {
                    groups, step, runs, ..
                } = product.inputs;
                let weights = panel.weights.as_chunks::<VECTORS>().0;
                let ranges = product.inputs.ranges_of::<PLACES>(place);
                // Of the right type; each is set below.
                let mut sums = [[$start(ranges[0], panel, 0); VECTORS]; PLACES];
                for at in 0..PLACES {
                    for vector in 0..VECTORS {
                        sums[at][vector] = $start(ranges[at], panel, vector);
                    }
                }
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
                                let (sum, weights) = (sums[at][vector], $weights(weights[vector]));
                                let adds = if HALF && vector + 1 == VECTORS { $add_half } else { $add };
                                sums[at][vector] = adds(sum, group, weights);
                            }
                        }
                    }
                }
                // Loops of a known length with little in them are unrolled, so that the sums stay in registers.
                let mut values = [[products::NO_VALUES; VECTORS]; PLACES];
                for at in 0..PLACES {
                    for vector in 0..VECTORS {
                        values[at][vector] = $finish(sums[at][vector], ranges[at], panel, vector);
                    }
                }
                product.store(panel, place, &values);
            }

            for outputs in &product.weights.panels {
                match outputs.vectors {
                    $($vectors if outputs.ends_with_half => panel::<$vectors, true>(&mut product, outputs),)*
                    $($vectors => panel::<$vectors, false>(&mut product, outputs),)*
                    others => unreachable!("{others} vectors of outputs are a bug"),
                }
            }
        }
    };
}

pub(super) use products;

pub(super) const NO_VALUES: Register<f32> = Register([0.0; LANES]);

impl PlaceGroups<'_> {
    /// What the bytes of some places from one on stand for; of other numbers than bytes, anything.
    #[inline(always)]
    pub(super) fn ranges_of<const PLACES: usize>(&self, first: usize) -> [ByteRange; PLACES] {
        match self.ranges {
            [] => [ByteRange::default(); PLACES],
            [all] => [*all; PLACES],
            ranges => *ranges[first..].first_chunk().expect("a place without a range is a bug"),
        }
    }
}

impl ReducedProduct<'_> {
    /// Writes the values of a panel's outputs at some places, or adds them to what is there.
    #[inline(always)]
    pub(super) fn store<const VECTORS: usize>(
        &mut self,
        panel: &ReducedPanel,
        first: usize,
        values: &[[Register<f32>; VECTORS]],
    ) {
        let (outputs, adds) = (self.weights.outputs, self.start == StartSums::Output);
        let width = (VECTORS * LANES).min(outputs - panel.first);
        let places = self.out[first * outputs..].chunks_exact_mut(outputs);
        for (out, values) in places.zip(values) {
            let (vectors, rest) = out[panel.first..][..width].as_chunks_mut::<LANES>();
            for (out, values) in vectors.iter_mut().zip(values) {
                put(values, out, adds);
            }
            let values = values.last().filter(|_| !rest.is_empty());
            let Some(values) = values else { continue };
            match rest.as_mut_array::<{ LANES / 2 }>() {
                Some(out) => put(values, out, adds),
                None => put_some(values, rest, adds),
            }
        }
    }
}

/// Writes the first of these values, or adds them to what is there.
#[inline(always)]
fn put<const COUNT: usize>(Register(values): &Register<f32>, out: &mut [f32; COUNT], adds: bool) {
    for at in 0..COUNT {
        out[at] = if adds { values[at] + out[at] } else { values[at] };
    }
}

/// As [`put`]. In a function of its own, since it is rarely called.
#[inline(never)]
fn put_some(Register(values): &Register<f32>, out: &mut [f32], adds: bool) {
    for (out, value) in out.iter_mut().zip(values) {
        *out = if adds { value + *out } else { *value };
    }
}

/// What sums of products of bytes begin with, so that a byte that stands for zero counts as none. `shift` was taken from each byte of
/// an input before.
#[inline(always)]
pub(super) fn first_sums(shift: i32, range: ByteRange, panel: &ReducedPanel, vector: usize) -> Register<i32> {
    let zero = shift - i32::from(range.zero);
    let Register(mut sums) = panel.weight_sums[vector];
    for sum in &mut sums {
        *sum = sum.wrapping_mul(zero);
    }
    Register(sums)
}

/// What such sums stand for, with the bias.
#[inline(always)]
pub(super) fn dequantized(
    Register(sums): Register<i32>,
    range: ByteRange,
    panel: &ReducedPanel,
    vector: usize,
) -> Register<f32> {
    let Register(mut values) = panel.bias[vector];
    for lane in 0..LANES {
        values[lane] += sums[lane] as f32 * (range.scale * panel.factors[vector].0[lane]);
    }
    Register(values)
}
