//! The predicted frame from its parts: pixels of the last true frame moved twice (with the room and with what moves in
//! it) and new content, mixed by a mask of three. The last true frame is sampled once per step, so it never blurs twice.
// A closure's vector instructions reach what is inlined into it, and only that.
#![allow(clippy::inline_always)]

use candle_core::{Result, Shape, Tensor, bail};

use super::activation::{exp, exp_with};
use super::gathering::{SAMPLED_TOGETHER, of_pairs, write_together};
use super::sampling::{ImageSize, Neighbourhood, PixelPlaces, SampledImage};
use crate::nn::fused::{FusedOperation, Operand, apply};
use crate::vectorized::{Instructions, vectorized, vectorized_by};

/// Numbers that the head gives for each pixel: two flows (column, row), three mask logits, one change of the content.
pub(in crate::nn) const HEAD_VALUES: usize = 8;
/// Channels of the scene that are not content.
pub(in crate::nn) const SCENE_FEATURES: usize = 8;
/// Channels of the scene on the grid of half the sides: features, then the content of each 2×2 block.
pub(in crate::nn) const SCENE_CHANNELS: usize = SCENE_FEATURES + 4;
/// Pixels that a flow of 1 moves.
pub(in crate::nn) const FLOW_PX: f32 = 4.0;
/// How much the room's pixels are preferred before anything is learned, as a logit.
pub(in crate::nn) const ROOM_LOGIT: f32 = 1.5;
/// Logit lost with each pixel that a place lies outside the frame, and the most that is lost.
pub(in crate::nn) const OUTSIDE_LOGIT: f32 = 2.0;
pub(in crate::nn) const MAX_OUTSIDE_LOGIT: f32 = 8.0;

/// What a frame is composed from, beside the tensors.
#[derive(Clone)]
pub(in crate::nn) struct Composition {
    pub(in crate::nn) size: ImageSize,
    /// The last true frames `[B, P]`.
    pub(in crate::nn) frames: Vec<f32>,
    /// Which of them each item moves, `[M]`.
    pub(in crate::nn) frame_of: Vec<u32>,
    /// Where it moves the room's pixels from.
    pub(in crate::nn) room: RoomPlaces,
}

/// Where each pixel of the room was seen (columns and rows).
#[derive(Clone)]
pub(in crate::nn) enum RoomPlaces {
    /// Where it was before the camera turned.
    Turned,
    /// There, `[M, P, 2]`; no gradient goes to them.
    Known(Vec<f32>),
    /// In the tensor of places, which is then `[M, 4 or more, P]`: columns and rows before the turn, then those; gradients go to them.
    Tracked,
}

/// What one pixel is made of.
struct PixelParts {
    /// Around the places of the two flows.
    around: [Neighbourhood; 2],
    /// The two moved pixels and the content.
    values: [f32; 3],
    /// Their shares.
    mask: [f32; 3],
}

impl Composition {
    /// The frames `[M, P]`. `head` is `[M, H/2, W/2, 4 · HEAD_VALUES]`, `scene` `[M, H/2, W/2, 4 or more]` with the content in
    /// its last four channels, `places` `[M, P, 2]` where each pixel was before the camera turned (if tracked, as
    /// [`RoomPlaces::Tracked`] says). Gradients go to all three.
    pub(in crate::nn) fn compose(self, head: &Tensor, scene: &Tensor, places: &Tensor) -> Result<Tensor> {
        apply(self, [head, scene, places])
    }

    /// Calls `visit` with the index of each pixel among all, of its head values and of its content, with its parts and its
    /// frame.
    #[inline(always)]
    fn visit(&self, [heads, scene, places]: [Operand; 3], mut visit: impl FnMut([usize; 3], PixelParts, &[f32])) {
        let ImageSize { height, width } = self.size;
        let pixels = self.size.pixels();
        let scene_channels = last_side(scene);
        for (item, &frame) in self.frame_of.iter().enumerate() {
            let from = frame as usize * pixels;
            let frame = &self.frames[from..from + pixels];
            let of_pixels = self.places_of(places, item);
            for row in 0..height {
                for column in 0..width {
                    let block = (item * (height / 2) + row / 2) * (width / 2) + column / 2;
                    let part = row % 2 * 2 + column % 2;
                    let pixel = item * pixels + row * width + column;
                    let head = (block * 4 + part) * HEAD_VALUES;
                    let content = (block + 1) * scene_channels - 4 + part;
                    let at = row * width + column;
                    let (turned, room) = (of_pixels[0].at(at), of_pixels[1].at(at));
                    let head_values = &heads.values[head..head + HEAD_VALUES];
                    let parts = self.parts(head_values, scene.values[content], [room, turned], frame);
                    visit([pixel, head, content], parts, frame);
                }
            }
        }
    }

    /// The indices, in the tensor of places, of where a pixel (counted over all items) was before the turn, and of where it was
    /// tracked to.
    #[inline(always)]
    fn indices(&self, places: Operand, pixel: usize) -> [[usize; 2]; 2] {
        if !matches!(self.room, RoomPlaces::Tracked) {
            return [[2 * pixel, 2 * pixel + 1]; 2];
        }
        let (pixels, values) = (self.size.pixels(), places.dims()[1]);
        let first = pixel / pixels * values * pixels + pixel % pixels;
        [[first, first + pixels], [first + 2 * pixels, first + 3 * pixels]]
    }

    /// Where each pixel of an item was before the turn, and where it was in the room.
    #[inline(always)]
    fn places_of<'v>(&'v self, places: Operand<'v>, item: usize) -> [PixelPlaces<'v>; 2] {
        let pixels = self.size.pixels();
        let pairs = |places: &'v [f32]| PixelPlaces::Pairs(&places[2 * item * pixels..2 * (item + 1) * pixels]);
        match &self.room {
            RoomPlaces::Turned => [pairs(places.values); 2],
            RoomPlaces::Known(room) => [pairs(places.values), pairs(room)],
            RoomPlaces::Tracked => {
                let [turned, tracked] = self.indices(places, item * pixels);
                let axis = |first: usize| &places.values[first..first + pixels];
                [
                    PixelPlaces::Axes([axis(turned[0]), axis(turned[1])]),
                    PixelPlaces::Axes([axis(tracked[0]), axis(tracked[1])]),
                ]
            }
        }
    }

    /// Writes some neighbouring pixels of a row (counted over all items) from a column on. The same arithmetic as
    /// [`Composition::parts`] and [`PixelParts::mixed`], but for rounding.
    #[inline(always)]
    fn mix(
        &self,
        [heads, scene, places]: [Operand; 3],
        [row, column]: [usize; 2],
        out: &mut [f32],
        instructions: Instructions,
    ) {
        let ImageSize { height, width } = self.size;
        let scene_channels = last_side(scene);
        let from = self.frame_of[row / height] as usize * self.size.pixels();
        let frame = SampledImage {
            size: self.size,
            pixels: &self.frames[from..from + self.size.pixels()],
            instructions,
        };
        let (of_item, pixel) = (self.places_of(places, row / height), row % height * width + column);
        let (turned, room) = (of_item[0].together(pixel), of_item[1].together(pixel));
        // The two lower or upper pixels of each block.
        let half = row % 2 * 2;
        let first_block = row / 2 * (width / 2) + column / 2;
        let mut pairs = [[0.0; 2 * HEAD_VALUES]; SAMPLED_TOGETHER / 2];
        let mut content = [0.0; SAMPLED_TOGETHER];
        for at in 0..out.len().div_ceil(2) {
            let block = first_block + at;
            pairs[at].copy_from_slice(&heads.values[(4 * block + half) * HEAD_VALUES..][..2 * HEAD_VALUES]);
            content[2 * at..2 * at + 2].copy_from_slice(&scene.values[(block + 1) * scene_channels - 4 + half..][..2]);
        }
        let head = of_pairs(&pairs, instructions);
        let [mut first, mut second] = [[[0.0; SAMPLED_TOGETHER]; 2]; 2];
        for axis in 0..2 {
            for at in 0..SAMPLED_TOGETHER {
                first[axis][at] = room[axis][at] + FLOW_PX * head[axis][at];
                second[axis][at] = turned[axis][at] + FLOW_PX * head[2 + axis][at];
            }
        }
        let (first, second) = (frame.sample(&first), frame.sample(&second));
        let mut mixed = [0.0; SAMPLED_TOGETHER];
        for at in 0..SAMPLED_TOGETHER {
            let logits = [
                head[4][at] + ROOM_LOGIT - self.outside([room[0][at], room[1][at]]),
                head[5][at] - self.outside([turned[0][at], turned[1][at]]),
                head[6][at],
            ];
            let most = logits[0].max(logits[1]).max(logits[2]);
            let shares = [
                exp_with(logits[0] - most, instructions),
                exp_with(logits[1] - most, instructions),
                exp_with(logits[2] - most, instructions),
            ];
            let sum = shares[0] + shares[1] + shares[2];
            let content = content[at] + head[7][at];
            mixed[at] = first[at] * (shares[0] / sum) + second[at] * (shares[1] / sum) + content * (shares[2] / sum);
        }
        write_together(&mixed, out, 0);
    }

    /// The parts of a pixel from its head values, content and places.
    #[inline(always)]
    fn parts(&self, head: &[f32], content: f32, [room, turned]: [[f32; 2]; 2], frame: &[f32]) -> PixelParts {
        let around = [
            self.size
                .around(room[0] + FLOW_PX * head[0], room[1] + FLOW_PX * head[1]),
            self.size
                .around(turned[0] + FLOW_PX * head[2], turned[1] + FLOW_PX * head[3]),
        ];
        let logits = [
            head[4] + ROOM_LOGIT - self.outside(room),
            head[5] - self.outside(turned),
            head[6],
        ];
        let most = logits[0].max(logits[1]).max(logits[2]);
        let shares = logits.map(|logit| exp(logit - most));
        let sum = shares[0] + shares[1] + shares[2];
        PixelParts {
            values: [around[0].sample(frame), around[1].sample(frame), content + head[7]],
            mask: shares.map(|share| share / sum),
            around,
        }
    }

    /// The logit that a place outside the frame costs.
    #[inline(always)]
    fn outside(&self, place: [f32; 2]) -> f32 {
        (OUTSIDE_LOGIT * self.size.outside(place)).min(MAX_OUTSIDE_LOGIT)
    }

    fn check(&self, inputs: [Operand; 3]) -> Result<()> {
        let (items, ImageSize { height, width }) = (self.frame_of.len(), self.size);
        let [head, scene, places] = inputs.map(|input| input.dims());
        let fits = head == [items, height / 2, width / 2, 4 * HEAD_VALUES]
            && matches!(*scene, [scenes, h, w, 4..=SCENE_CHANNELS] if [scenes, h, w] == [items, height / 2, width / 2])
            && match &self.room {
                RoomPlaces::Tracked => {
                    matches!(*places, [places, values, pixels] if values >= 4 && [places, pixels] == [items, height * width])
                }
                RoomPlaces::Turned | RoomPlaces::Known(_) => places == [items, height * width, 2],
            };
        if fits {
            return Ok(());
        }
        bail!("{items} frames of {width}×{height} are not composed of {head:?}, {scene:?} and {places:?}")
    }
}

fn last_side(operand: Operand) -> usize {
    operand.dims().last().copied().unwrap_or(1)
}

#[inline(always)]
fn add(sums: &mut [f32], indices: [usize; 2], values: [f32; 2]) {
    for (index, value) in indices.into_iter().zip(values) {
        sums[index] += value;
    }
}

impl FusedOperation<3> for Composition {
    const NAME: &'static str = "compose";

    fn forward(&self, inputs: [Operand; 3]) -> Result<(Vec<f32>, Shape)> {
        self.check(inputs)?;
        let (items, pixels) = (self.frame_of.len(), self.size.pixels());
        let mut out = vec![0.0; items * pixels];
        let rows = out.chunks_exact_mut(self.size.width).enumerate();
        vectorized_by(
            #[inline(always)]
            |instructions| {
                for (row, out) in rows {
                    for (part, out) in out.chunks_mut(SAMPLED_TOGETHER).enumerate() {
                        self.mix(inputs, [row, part * SAMPLED_TOGETHER], out, instructions);
                    }
                }
            },
        );
        Ok((out, Shape::from((items, pixels))))
    }

    fn backward(&self, inputs: [Operand; 3], _output: Operand, gradient: Operand) -> Result<[Option<Vec<f32>>; 3]> {
        let [mut for_head, mut for_scene, mut for_places] = inputs.map(|input| vec![0.0; input.values.len()]);
        vectorized(
            #[inline(always)]
            || {
                self.visit(
                    inputs,
                    #[inline(always)]
                    |[pixel, head, content], parts, frame| {
                        let gradient = gradient.values[pixel];
                        let [room, turned] = parts.gradient(gradient, frame, &mut for_head[head..head + HEAD_VALUES]);
                        let [turned_at, tracked_at] = self.indices(inputs[2], pixel);
                        add(&mut for_places, turned_at, turned);
                        match &self.room {
                            RoomPlaces::Turned => add(&mut for_places, turned_at, room),
                            RoomPlaces::Known(_) => (),
                            RoomPlaces::Tracked => add(&mut for_places, tracked_at, room),
                        }
                        for_scene[content] = gradient * parts.mask[2];
                    },
                );
            },
        );
        Ok([for_head, for_scene, for_places].map(Some))
    }
}

impl PixelParts {
    /// The pixel's value.
    #[inline(always)]
    fn mixed(&self) -> f32 {
        let weighted = self.values.iter().zip(self.mask);
        weighted.map(|(value, share)| value * share).sum()
    }

    /// Writes the gradient of the pixel's head values; gives that of the two places.
    #[inline(always)]
    fn gradient(&self, gradient: f32, frame: &[f32], for_head: &mut [f32]) -> [[f32; 2]; 2] {
        let [first, second] = [0, 1].map(|flow: usize| {
            let slopes = self.around[flow].slopes(frame);
            slopes.map(|slope| gradient * self.mask[flow] * slope)
        });
        let mixed = self.mixed();
        for_head[0] = FLOW_PX * first[0];
        for_head[1] = FLOW_PX * first[1];
        for_head[2] = FLOW_PX * second[0];
        for_head[3] = FLOW_PX * second[1];
        for part in 0..3 {
            for_head[4 + part] = gradient * self.mask[part] * (self.values[part] - mixed);
        }
        for_head[7] = gradient * self.mask[2];
        [first, second]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::nn::gradient_check::{assert_gradients, noise};

    fn composition(with_room: bool) -> Composition {
        let size = ImageSize { height: 4, width: 6 };
        let values = |count: usize, seed| noise(&[count], seed).to_vec1::<f32>().unwrap();
        Composition {
            size,
            frames: values(2 * 24, 1),
            frame_of: vec![0, 1, 1],
            room: if with_room {
                RoomPlaces::Known(values(3 * 48, 2).iter().map(|place| 2.5 * place + 2.13).collect())
            } else {
                RoomPlaces::Turned
            },
        }
    }

    #[test]
    fn gradients_agree_with_differences() {
        for with_room in [false, true] {
            let inputs = [
                (noise(&[3, 2, 3, 32], 3) * 0.3).unwrap(),
                noise(&[3, 2, 3, SCENE_CHANNELS], 4),
                noise(&[3, 24, 2], 5).affine(1.2, 1.37).unwrap(),
            ];
            assert_gradients(&inputs[..2], 1e-4, |tensors| {
                composition(with_room).compose(&tensors[0], &tensors[1], &inputs[2])
            });
            if !with_room {
                // No gradient passes through the mask to the place; inside the frame there is none.
                assert_gradients(&inputs[2..], 1e-4, |tensors| {
                    composition(with_room).compose(&inputs[0], &inputs[1], &tensors[0])
                });
            }
        }
    }

    #[test]
    fn tracked_places_of_the_room_get_gradients() {
        let inputs = [
            (noise(&[3, 2, 3, 32], 3) * 0.3).unwrap(),
            noise(&[3, 2, 3, 4], 4),
            noise(&[3, 4, 24], 5).affine(1.2, 1.37).unwrap(),
        ];
        assert_gradients(&inputs[2..], 1e-4, |tensors| {
            let tracked = Composition {
                room: RoomPlaces::Tracked,
                ..composition(false)
            };
            tracked.compose(&inputs[0], &inputs[1], &tensors[0])
        });
    }

    #[test]
    fn without_a_head_the_moved_pixels_prevail() {
        let composition = composition(false);
        let places = crate::nn::ops::sampling::own_places(composition.size);
        let places = Tensor::from_vec(places.repeat(3), (3, 24, 2), &candle_core::Device::Cpu).unwrap();
        let zeros = |last| Tensor::zeros((3, 2, 3, last), candle_core::DType::F32, places.device()).unwrap();
        let frames = composition
            .clone()
            .compose(&zeros(32), &zeros(SCENE_CHANNELS), &places)
            .unwrap();
        let share = (1.5f32.exp() + 1.0) / (1.5f32.exp() + 2.0);
        let first = frames.get(0).unwrap().to_vec1::<f32>().unwrap();
        for (found, value) in first.iter().zip(&composition.frames) {
            assert!((found - share * value).abs() < 1e-6, "{found} {value}");
        }
    }
}
