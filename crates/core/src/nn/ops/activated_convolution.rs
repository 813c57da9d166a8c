//! An activation, the convolution of what it gives, and an addition: the step that the flow network is built of. With packed
//! weights it is one pass: the activated values are written once, into the image with its border, and the sums start from what
//! they are added to.
// A closure's vector instructions reach what is inlined into it, and only that.
#![allow(clippy::inline_always)]

use candle_core::{Result, Tensor, bail};
use candle_nn::Module as _;

use super::convolution::{Convolution3, ImageGeometry, PackedKernel};
use super::modulation::{activate, modulated_silu, silu};
use super::packed::{PlaceInputs, StartSums, TapRun};
use super::scratch::with_buffers;
use super::winograd::TiledConvolution;
use crate::nn::tensors::with_values;
use crate::vectorized::vectorized;

/// What is done to a convolution's input.
#[derive(Clone, Copy)]
pub(in crate::nn) enum Activation<'a> {
    None,
    Silu,
    /// As [`modulated_silu`], with its modulation `[N, 2 · C]`.
    Modulated(&'a Tensor),
}

/// The convolution of activated x `[N, H, W, C]`, plus `added`. Errors: shapes that do not fit.
pub(in crate::nn) fn activated_convolution(
    layer: &Convolution3,
    x: &Tensor,
    activation: Activation,
    added: Option<&Tensor>,
) -> Result<Tensor> {
    if let Some(packed) = &layer.packed {
        return predict(layer, packed, x, activation, added);
    }
    let convolved = match activation {
        Activation::None => layer.forward(x)?,
        Activation::Silu => layer.forward(&silu(x)?)?,
        Activation::Modulated(modulation) => layer.forward(&modulated_silu(x, modulation)?)?,
    };
    match added {
        Some(added) => added + convolved,
        None => Ok(convolved),
    }
}

fn predict(
    layer: &Convolution3,
    packed: &PackedKernel,
    x: &Tensor,
    activation: Activation,
    added: Option<&Tensor>,
) -> Result<Tensor> {
    let dims = x.dims4()?;
    let image = ImageGeometry::of(dims, layer.shape);
    let outputs = packed.places.outputs();
    let shape = (dims.0, image.out_height(), image.out_width(), outputs);
    let (mut out, start) = match added {
        Some(added) if added.dims4()? != shape => bail!("{:?} is not added to {shape:?}", added.dims()),
        Some(added) => (with_values(added, <[f32]>::to_vec)?, StartSums::Output),
        None => (vec![0.0; dims.0 * image.places() * outputs], StartSums::Bias),
    };
    let convolution = BorderedConvolution::new(packed, image);
    let mut convolve = |x: &[f32], modulations: &[f32]| {
        let modulations = modulations.chunks_exact(2 * image.channels);
        let items = x
            .chunks_exact(image.inputs())
            .zip(out.chunks_exact_mut(image.places() * outputs));
        match activation {
            Activation::None => items.for_each(|(x, out)| convolution.forward(x, out, start, Written::Plain)),
            Activation::Silu => items.for_each(|(x, out)| convolution.forward(x, out, start, Written::Silu)),
            Activation::Modulated(_) => items.zip(modulations).for_each(|((x, out), modulation)| {
                convolution.forward(x, out, start, Written::Modulated(modulation));
            }),
        }
    };
    with_values(x, |x| {
        if let Activation::Modulated(modulation) = activation {
            return with_values(modulation, |modulation| convolve(x, modulation));
        }
        convolve(x, &[]);
        Ok(())
    })??;
    Tensor::from_vec(out, shape, x.device())
}

/// How an item's values are written into the bordered image.
#[derive(Clone, Copy)]
enum Written<'a> {
    Plain,
    Silu,
    /// Scales and shifts.
    Modulated(&'a [f32]),
}

/// A convolution of images with a border of zeros.
struct BorderedConvolution<'a> {
    packed: &'a PackedKernel,
    image: ImageGeometry,
    runs: Vec<TapRun>,
    /// Where the weights fit.
    tiled: Option<TiledConvolution<'a>>,
}

impl<'a> BorderedConvolution<'a> {
    fn new(packed: &'a PackedKernel, image: ImageGeometry) -> Self {
        let patches = packed.patches.as_ref().filter(|patches| patches.fit(image));
        Self {
            tiled: patches.map(|patches| TiledConvolution::new(patches, image)),
            packed,
            image,
            runs: image.runs().collect(),
        }
    }

    /// Computes one item.
    fn forward(&self, x: &[f32], out: &mut [f32], start: StartSums, written: Written) {
        let bordered = (self.image.height + 2 * self.image.shape.dilation) * self.image.pitch() * self.image.channels;
        let [patches, products] = self.tiled.as_ref().map_or([0; 2], TiledConvolution::buffers);
        with_buffers([bordered, patches, products], |[bordered, patches, products]| {
            self.write(bordered, x, written);
            match &self.tiled {
                Some(tiled) => tiled.forward(bordered, [patches, products], out, start),
                None => self.convolve(bordered, out, start),
            }
        });
    }

    fn convolve(&self, bordered: &[f32], out: &mut [f32], start: StartSums) {
        let ImageGeometry { channels, shape, .. } = self.image;
        let row_length = self.image.out_width() * self.packed.places.outputs();
        for (row, out) in out.chunks_exact_mut(row_length).enumerate() {
            let inputs = PlaceInputs {
                values: &bordered[row * shape.stride * self.image.pitch() * channels..],
                step: shape.stride * channels,
                runs: &self.runs,
            };
            self.packed.places.multiply(inputs, out, start);
        }
    }

    /// Writes an item with its border.
    fn write(&self, bordered: &mut [f32], x: &[f32], written: Written) {
        let image = self.image;
        let (length, pitch) = (image.width * image.channels, image.pitch() * image.channels);
        vectorized(
            #[inline(always)]
            || {
                let (above, rest) = bordered.split_at_mut(image.inside());
                above.fill(0.0);
                let (rows, below) = rest.split_at_mut(image.height * pitch);
                below.fill(0.0);
                for (to, from) in rows.chunks_exact_mut(pitch).zip(x.chunks_exact(length)) {
                    let (to, between) = to.split_at_mut(length);
                    between.fill(0.0);
                    match written {
                        Written::Plain => to.copy_from_slice(from),
                        Written::Silu => {
                            for (to, &from) in to.iter_mut().zip(from) {
                                *to = activate(from);
                            }
                        }
                        Written::Modulated(modulation) => {
                            let (scale, shift) = modulation.split_at(image.channels);
                            let places = to.chunks_exact_mut(image.channels);
                            for (to, from) in places.zip(from.chunks_exact(image.channels)) {
                                for (((to, from), scale), shift) in to.iter_mut().zip(from).zip(scale).zip(shift) {
                                    *to = activate(from * (1.0 + scale) + shift);
                                }
                            }
                        }
                    }
                }
            },
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::nn::gradient_check::noise;
    use crate::nn::ops::convolution::ConvShape;

    #[test]
    fn packed_weights_give_what_the_tensors_give() {
        for (shape, sides) in [
            (ConvShape::PLAIN, [6, 5]),
            (ConvShape::HALVING, [3, 3]),
            (ConvShape::dilated(2), [6, 5]),
        ] {
            let mut layer = Convolution3 {
                weight: noise(&[27, 20], 2),
                bias: noise(&[20], 3),
                shape,
                packed: None,
            };
            let (x, modulation) = (noise(&[2, 6, 5, 3], 1), noise(&[2, 6], 4));
            let added = noise(&[2, sides[0], sides[1], 20], 5);
            let outputs = |layer: &Convolution3| {
                let activations = [Activation::None, Activation::Silu, Activation::Modulated(&modulation)];
                [None, Some(&added)].map(|added| {
                    activations.map(|activation| activated_convolution(layer, &x, activation, added).unwrap())
                })
            };
            let plain = outputs(&layer);
            layer.pack().unwrap();
            for (plain, packed) in plain.iter().flatten().zip(outputs(&layer).iter().flatten()) {
                assert_eq!(plain.dims(), packed.dims());
                let most = (plain - packed).unwrap().abs().unwrap().max_all().unwrap();
                assert!(most.to_scalar::<f32>().unwrap() < 1e-5, "{shape:?}: {most}");
            }
        }
    }
}
