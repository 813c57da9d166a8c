//! Joins images along their channels, as `Tensor::cat` does, in one pass over memory.
// A closure's vector instructions reach what is inlined into it, and only that.
#![allow(clippy::inline_always)]

use candle_core::{Result, Shape, Tensor, bail};

use crate::nn::fused::{FusedOperation, Operand, apply};
use crate::nn::recycled::buffer;
use crate::vectorized::vectorized;

/// The channels of images `[N, H, W, …]`, one after another.
pub(in crate::nn) fn joined<const COUNT: usize>(images: [&Tensor; COUNT]) -> Result<Tensor> {
    apply(Joining { shuffles_first: false }, images)
}

/// As [`joined`], where the first image goes through [`pixel_shuffle`](super::pixel_shuffle::pixel_shuffle) before: it is `[N, H, W, 4 · C]`,
/// the others `[N, 2H, 2W, …]`.
pub(in crate::nn) fn joined_to_shuffled<const COUNT: usize>(images: [&Tensor; COUNT]) -> Result<Tensor> {
    apply(Joining { shuffles_first: true }, images)
}

struct Joining {
    shuffles_first: bool,
}

/// Where the channels of an image lie.
#[derive(Clone, Copy, Default)]
struct Source {
    channels: usize,
    is_shuffled: bool,
}

impl Source {
    /// Where the channels of a row's first place begin; how far it is from there to those of the second place, and from these to those of
    /// the third; then both distances take turns.
    #[inline(always)]
    fn row(self, row: usize, width: usize) -> (usize, [usize; 2]) {
        let channels = self.channels;
        if self.is_shuffled {
            let first = row / 2 * width * 2 + 2 * (row % 2);
            (first * channels, [channels, 3 * channels])
        } else {
            (row * width * channels, [channels; 2])
        }
    }
}

impl Joining {
    /// The sources, and the sides of the joined image.
    fn sources<const COUNT: usize>(&self, images: [Operand; COUNT]) -> Result<([Source; COUNT], [usize; 3])> {
        let (mut sources, mut sides) = ([Source::default(); COUNT], None);
        for (nth, (source, image)) in sources.iter_mut().zip(images).enumerate() {
            let (count, height, width, channels) = image.layout.shape().dims4()?;
            let is_shuffled = self.shuffles_first && nth == 0;
            let (own, channels) = if is_shuffled {
                ([count, 2 * height, 2 * width], channels / 4)
            } else {
                ([count, height, width], channels)
            };
            let first = *sides.get_or_insert(own);
            if first != own || is_shuffled && image.dims()[3] % 4 != 0 {
                bail!("an image of {:?} is not joined to one of {first:?}", image.dims());
            }
            *source = Source { channels, is_shuffled };
        }
        Ok((sources, sides.unwrap_or_default()))
    }
}

/// Copies the channels of a place: mostly a few values, which a call would take longer for. So the first and the last of them are
/// copied as vectors, which may overlap.
#[inline(always)]
fn copy(from: &[f32], to: &mut [f32]) {
    match from.len() {
        4..=8 => copy_ends::<4>(from, to),
        9..=16 => copy_ends::<8>(from, to),
        17..=32 => copy_ends::<16>(from, to),
        33..=64 => copy_ends::<32>(from, to),
        _ => to.copy_from_slice(from),
    }
}

/// Copies the first and the last values: all, if there are at most twice as many.
#[inline(always)]
fn copy_ends<const COUNT: usize>(from: &[f32], to: &mut [f32]) {
    if let (Some(from), Some(to)) = (from.first_chunk::<COUNT>(), to.first_chunk_mut()) {
        *to = *from;
    }
    if let (Some(from), Some(to)) = (from.last_chunk::<COUNT>(), to.last_chunk_mut()) {
        *to = *from;
    }
}

impl<const COUNT: usize> FusedOperation<COUNT> for Joining {
    const NAME: &'static str = "join";

    fn forward(&self, images: [Operand; COUNT]) -> Result<(Vec<f32>, Shape)> {
        let (sources, [count, height, width]) = self.sources(images)?;
        let channels: usize = sources.iter().map(|source| source.channels).sum();
        let mut out = buffer(count * height * width * channels);
        let rows = out.chunks_exact_mut(width * channels).enumerate();
        vectorized(
            #[inline(always)]
            || {
                for (row, out) in rows {
                    let mut first = 0;
                    for nth in 0..COUNT {
                        let source = sources[nth];
                        let (mut begin, [next, after]) = source.row(row, width);
                        for (column, out) in out.chunks_exact_mut(channels).enumerate() {
                            let from = &images[nth].values[begin..][..source.channels];
                            copy(from, &mut out[first..][..source.channels]);
                            begin += if column % 2 == 0 { next } else { after };
                        }
                        first += source.channels;
                    }
                }
            },
        );
        Ok((out, Shape::from((count, height, width, channels))))
    }

    fn backward(&self, images: [Operand; COUNT], _: Operand, gradient: Operand) -> Result<[Option<Vec<f32>>; COUNT]> {
        let (sources, [_, _, width]) = self.sources(images)?;
        let channels: usize = sources.iter().map(|source| source.channels).sum();
        let mut first = 0;
        let mut parts = [const { None }; COUNT];
        for ((part, source), image) in parts.iter_mut().zip(sources).zip(images) {
            let own = first..first + source.channels;
            first = own.end;
            if !image.is_tracked {
                continue;
            }
            let mut of_image = vec![0.0; image.values.len()];
            for (row, gradient) in gradient.values.chunks_exact(width * channels).enumerate() {
                let (mut begin, [next, after]) = source.row(row, width);
                for (column, gradient) in gradient.chunks_exact(channels).enumerate() {
                    copy(&gradient[own.clone()], &mut of_image[begin..][..source.channels]);
                    begin += if column % 2 == 0 { next } else { after };
                }
            }
            *part = Some(of_image);
        }
        Ok(parts)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::nn::gradient_check::{assert_gradients, noise, values};
    use crate::nn::ops::pixel_shuffle::pixel_shuffle;

    #[test]
    fn images_are_joined_as_tensors_are() {
        for (width, channels) in [(4, [4, 5, 5]), (5, [16, 17, 9]), (4, [3, 1, 40]), (3, [65, 8, 64])] {
            let image = |nth: usize| noise(&[2, 6, width, channels[nth]], nth as u64);
            let (first, second, third) = (image(0), image(1), image(2));
            let expected = Tensor::cat(&[&first, &second, &third], 3).unwrap();
            assert_eq!(values(&joined([&first, &second, &third]).unwrap()), values(&expected));
        }
        let (enlarged, beside) = (noise(&[2, 3, 2, 20], 1), noise(&[2, 6, 4, 7], 2));
        let expected = Tensor::cat(&[&pixel_shuffle(&enlarged).unwrap(), &beside], 3).unwrap();
        assert_eq!(
            values(&joined_to_shuffled([&enlarged, &beside]).unwrap()),
            values(&expected)
        );
        let known = noise(&[2, 6, 4, 3], 3);
        assert_gradients(&[enlarged, beside], 1e-2, |inputs| {
            joined_to_shuffled([&inputs[0], &known, &inputs[1]])
        });
    }

    #[test]
    fn images_of_other_sides_are_refused() {
        let refused = |joined: Result<Tensor>| joined.unwrap_err().to_string().contains("is not joined");
        assert!(refused(joined([&noise(&[1, 2, 3, 4], 1), &noise(&[1, 3, 2, 4], 1)])));
        assert!(refused(joined_to_shuffled([
            &noise(&[1, 2, 3, 6], 1),
            &noise(&[1, 4, 6, 4], 1)
        ])));
    }
}
