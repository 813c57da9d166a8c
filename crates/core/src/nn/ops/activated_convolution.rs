//! An activation, the convolution of what it gives, and an addition: the step that the flow network is built of. With packed
//! weights it is one pass: the activated values are written once, into the image with its border, and the sums start from what
//! they are added to.
use candle_core::{Result, Tensor, bail};
use candle_nn::Module as _;

use super::bordered_convolution::{BorderedConvolution, PackedKernel, Written};
use super::convolution::Convolution3;
use super::image_geometry::ImageGeometry;
use super::modulation::{modulated_silu, silu};
use super::packed::StartSums;
use crate::nn::recycled::buffer;
use crate::nn::tensors::with_values;

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
    let outputs = packed.outputs();
    let shape = (dims.0, image.out_height(), image.out_width(), outputs);
    if let Activation::Modulated(modulation) = activation
        && modulation.dims() != [dims.0, 2 * image.channels]
    {
        bail!("a modulation of shape {:?} does not fit {dims:?}", modulation.dims());
    }
    let (mut out, start) = match added {
        Some(added) if added.dims4()? != shape => bail!("{:?} is not added to {shape:?}", added.dims()),
        Some(added) => {
            let mut sums = buffer(added.elem_count());
            with_values(added, |added| sums.copy_from_slice(added))?;
            (sums, StartSums::Output)
        }
        None => (buffer(dims.0 * image.places() * outputs), StartSums::Bias),
    };
    let convolution = BorderedConvolution::in_strips(packed, image, rayon::current_num_threads());
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::nn::gradient_check::{noise, values};
    use crate::nn::ops::image_geometry::ConvShape;
    use crate::nn::precision::Precision;

    #[test]
    fn packed_weights_give_what_the_tensors_give() {
        for (shape, sides) in [
            (ConvShape::PLAIN, [6, 5]),
            (ConvShape::HALVING, [3, 3]),
            (ConvShape::dilated(2), [6, 5]),
        ] {
            let mut layer = Convolution3 {
                weight: noise(&[27, 24], 2),
                bias: noise(&[24], 3),
                shape,
                packed: None,
            };
            let (x, modulation) = (noise(&[2, 6, 5, 3], 1), noise(&[2, 6], 4));
            let added = noise(&[2, sides[0], sides[1], 24], 5);
            let outputs = |layer: &Convolution3| {
                let activations = [Activation::None, Activation::Silu, Activation::Modulated(&modulation)];
                [None, Some(&added)].map(|added| {
                    activations.map(|activation| activated_convolution(layer, &x, activation, added).unwrap())
                })
            };
            let plain = outputs(&layer);
            // The activated values are at most 3, the weights at most 1, and a sum has 27 of them.
            for (precision, bound) in [(Precision::F32, 1e-5), (Precision::Bf16, 0.08), (Precision::Int8, 0.15)] {
                if !precision.is_supported() {
                    eprintln!("skipped: this processor does not multiply {precision}");
                    continue;
                }
                layer.pack(precision).unwrap();
                for (plain, packed) in plain.iter().flatten().zip(outputs(&layer).iter().flatten()) {
                    assert_eq!(plain.dims(), packed.dims());
                    let most = (plain - packed).unwrap().abs().unwrap().max_all().unwrap();
                    assert!(
                        most.to_scalar::<f32>().unwrap() < bound,
                        "{shape:?}, {precision}: {most}"
                    );
                }
            }
        }
    }

    #[test]
    fn any_number_of_threads_gives_the_same_bits() {
        for (shape, channels) in [
            (ConvShape::PLAIN, 48),
            (ConvShape::HALVING, 48),
            (ConvShape::dilated(2), 48),
            (ConvShape::PLAIN, 7),
        ] {
            let mut layer = Convolution3 {
                weight: noise(&[9 * channels, 48], 2),
                bias: noise(&[48], 3),
                shape,
                packed: None,
            };
            let (x, modulation) = (noise(&[2, 32, 32, channels], 1), noise(&[2, 2 * channels], 4));
            let of_threads = |layer: &Convolution3, threads: usize| {
                let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
                let convolve = || activated_convolution(layer, &x, Activation::Modulated(&modulation), None);
                values(&pool.install(convolve).unwrap())
            };
            for precision in Precision::ALL.into_iter().filter(|precision| precision.is_supported()) {
                layer.pack(precision).unwrap();
                let alone = of_threads(&layer, 1);
                for threads in [2, 3, 5, 8] {
                    assert_eq!(of_threads(&layer, threads), alone, "{shape:?}, {threads}, {precision}");
                }
            }
        }
    }
}
