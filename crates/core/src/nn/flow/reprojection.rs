//! Where a camera that turned and drove saw each of its pixels before, from the depth of the last frame's pixels.
//!
//! The depth is known for the old view and needed in the new one: a pixel's depth is guessed, the point projected into the
//! old view, and the guess corrected by the depth found there, [`ROUNDS`] times.
// A closure's vector instructions reach what is inlined into it, and only that.
#![allow(clippy::inline_always)]

use candle_core::{Result, Shape, Tensor, bail};

use crate::frame::warp::MIN_DEPTH;
use crate::nn::fused::{FusedOperation, Operand, apply};
use crate::nn::geometry::camera::{Viewer, rotated};
use crate::nn::geometry::viewer_rays::ViewerRays;
use crate::nn::ops::gathering::{OfPlaces, SAMPLED_TOGETHER, write_together};
use crate::nn::ops::sampling::{ImageSize, Neighbourhood, SampledImage};
use crate::nn::recycled::buffer;
use crate::vectorized::{Instructions, vectorized_by};

/// Values of a pixel: its place before the turn, its place before turn and drive (columns and rows), its depth in metres.
pub(super) const PLACE_VALUES: usize = 5;
/// Corrections of a pixel's depth.
pub(super) const ROUNDS: usize = 3;
/// Smallest and largest factor of one correction.
pub(super) const CORRECTION: [f32; 2] = [0.5, 2.0];

/// Least change of a pixel's depth in the old view with its depth in the new one, in gradients.
pub(super) const MIN_DEEPENING: f32 = 0.2;

/// The places `[M, PLACE_VALUES, P]` of items that follow contexts with these `depths` `[contexts, P]`, after the camera's
/// `motions` `[M, 3]` (yaw, ahead, left). Gradients go to both.
pub(super) fn reproject(reprojection: Reprojection, depths: &Tensor, motions: &Tensor) -> Result<Tensor> {
    apply(reprojection, [depths, motions])
}

/// What is moved.
pub(super) struct Reprojection {
    pub(super) size: ImageSize,
    /// The camera of each context.
    pub(super) cameras: Vec<ViewerRays>,
    /// The context of each item.
    pub(super) context_of: Vec<u32>,
}

/// The motion of an item.
#[derive(Clone, Copy)]
struct Motion {
    sin: f32,
    cos: f32,
    ahead: f32,
    left: f32,
}

impl Motion {
    fn of(values: &[f32]) -> Self {
        let (sin, cos) = values[0].sin_cos();
        Self {
            sin,
            cos,
            ahead: values[1],
            left: values[2],
        }
    }

    /// The point on a ray of the new view, in the axes of the old one.
    #[inline(always)]
    fn point(self, direction: [f32; 3], depth: f32) -> [f32; 3] {
        [
            self.ahead + depth * direction[0],
            self.left + depth * direction[1],
            depth * direction[2],
        ]
    }
}

impl Motion {
    /// As [`Motion::point`], of several pixels.
    #[inline(always)]
    fn points(self, directions: &[OfPlaces; 3], depths: &OfPlaces) -> [OfPlaces; 3] {
        let mut points = [[0.0; SAMPLED_TOGETHER]; 3];
        for at in 0..SAMPLED_TOGETHER {
            let direction = [directions[0][at], directions[1][at], directions[2][at]];
            [points[0][at], points[1][at], points[2][at]] = self.point(direction, depths[at]);
        }
        points
    }
}

/// A pixel's depth after the last correction, and the pixels of the old view by which it was corrected last.
struct Found {
    depth: f32,
    around: Neighbourhood,
}

/// Of several pixels.
struct FoundTogether {
    /// Place before the turn.
    turned: [OfPlaces; 2],
    /// Where the depth was looked up for the last correction.
    corrected_at: [OfPlaces; 2],
    /// Place before turn and drive.
    room: [OfPlaces; 2],
    depth: OfPlaces,
}

/// Of the pixels from `first` on.
#[inline(always)]
fn found_together(camera: &ViewerRays, depths: SampledImage, motion: Motion, first: usize) -> FoundTogether {
    let (viewer, rays) = (camera.viewer, camera.together(first));
    let mut directions = [[0.0; SAMPLED_TOGETHER]; 3];
    for at in 0..SAMPLED_TOGETHER {
        let ray = [rays[0][at], rays[1][at], rays[2][at]];
        [directions[0][at], directions[1][at], directions[2][at]] = rotated(ray, motion.sin, motion.cos);
    }
    let turned = viewer.project_together(&directions);
    let mut found = depths.sample(&turned);
    let mut corrected_at = turned;
    for _ in 0..ROUNDS {
        let points = motion.points(&directions, &found);
        corrected_at = viewer.project_together(&points);
        let seen = depths.sample(&corrected_at);
        for at in 0..SAMPLED_TOGETHER {
            let depth = viewer.depth([points[0][at], points[1][at], points[2][at]]);
            let factor = seen[at] / depth.max(MIN_DEPTH);
            found[at] *= factor.clamp(CORRECTION[0], CORRECTION[1]);
        }
    }
    FoundTogether {
        room: viewer.project_together(&motion.points(&directions, &found)),
        turned,
        corrected_at,
        depth: found,
    }
}

impl Reprojection {
    fn check(&self, depths: Operand, motions: Operand) -> Result<()> {
        let (contexts, pixels) = depths.layout.shape().dims2()?;
        let fits = contexts == self.cameras.len()
            && pixels == self.size.pixels()
            && motions.dims() == [self.context_of.len(), 3]
            && self.context_of.iter().all(|&context| (context as usize) < contexts);
        if fits {
            return Ok(());
        }
        bail!("{:?} depths do not fit {:?} motions", depths.dims(), motions.dims())
    }

    #[inline(always)]
    fn sampled<'v>(&self, pixels: &'v [f32], instructions: Instructions) -> SampledImage<'v> {
        SampledImage {
            size: self.size,
            pixels,
            instructions,
        }
    }
}

impl FusedOperation<2> for Reprojection {
    const NAME: &'static str = "reproject";

    fn forward(&self, [depths, motions]: [Operand; 2]) -> Result<(Vec<f32>, Shape)> {
        self.check(depths, motions)?;
        let (items, pixels) = (self.context_of.len(), self.size.pixels());
        let mut out = buffer(items * pixels * PLACE_VALUES);
        let outs = out.chunks_exact_mut(pixels * PLACE_VALUES);
        for ((out, motion), &context) in outs.zip(motions.values.chunks_exact(3)).zip(&self.context_of) {
            let context = context as usize;
            let (camera, motion) = (&self.cameras[context], Motion::of(motion));
            let depths = &depths.values[context * pixels..(context + 1) * pixels];
            vectorized_by(
                #[inline(always)]
                |instructions| {
                    let depths = self.sampled(depths, instructions);
                    for first in (0..pixels).step_by(SAMPLED_TOGETHER) {
                        let found = found_together(camera, depths, motion, first);
                        let FoundTogether {
                            turned, room, depth, ..
                        } = &found;
                        let values = [&turned[0], &turned[1], &room[0], &room[1], depth];
                        for (nth, values) in values.into_iter().enumerate() {
                            write_together(values, &mut out[nth * pixels..][..pixels], first);
                        }
                    }
                },
            );
        }
        Ok((out, Shape::from((items, PLACE_VALUES, pixels))))
    }

    /// As if the surroundings of each place were equally deep, and its depth had settled.
    fn backward(
        &self,
        [depths, motions]: [Operand; 2],
        _places: Operand,
        gradient: Operand,
    ) -> Result<[Option<Vec<f32>>; 2]> {
        let pixels = self.size.pixels();
        let (mut for_depths, mut for_motions) = (vec![0.0; depths.values.len()], vec![0.0; motions.values.len()]);
        for (item, &context) in self.context_of.iter().enumerate() {
            let context = context as usize;
            let camera = &self.cameras[context];
            let motion = Motion::of(&motions.values[3 * item..]);
            let own = context * pixels..(context + 1) * pixels;
            let (depths, for_depths) = (&depths.values[own.clone()], &mut for_depths[own]);
            let gradients = &gradient.values[item * pixels * PLACE_VALUES..(item + 1) * pixels * PLACE_VALUES];
            let mut sums = [0.0f32; 3];
            vectorized_by(
                #[inline(always)]
                |instructions| {
                    let depths = self.sampled(depths, instructions);
                    for first in (0..pixels).step_by(SAMPLED_TOGETHER) {
                        let found = found_together(camera, depths, motion, first);
                        for at in 0..SAMPLED_TOGETHER.min(pixels - first) {
                            let (pixel, ray) = (first + at, camera.rays[first + at]);
                            let gradient = std::array::from_fn(
                                #[inline(always)]
                                |value| gradients[value * pixels + pixel],
                            );
                            let found = Found {
                                depth: found.depth[at],
                                around: self.size.around(found.corrected_at[0][at], found.corrected_at[1][at]),
                            };
                            let of_pixel = pixel_gradient(camera.viewer, motion, ray, &found, gradient);
                            for (sum, part) in sums.iter_mut().zip(of_pixel.motion) {
                                *sum += part;
                            }
                            for (pixel, share) in found.around.pixels.into_iter().zip(found.around.shares()) {
                                for_depths[pixel] += share * of_pixel.depth;
                            }
                        }
                    }
                },
            );
            for_motions[3 * item..3 * item + 3].copy_from_slice(&sums);
        }
        Ok([Some(for_depths), Some(for_motions)])
    }
}

/// The gradients that a pixel's places pass on: for the motion, and for the depth in the old view where the pixel was seen.
struct PixelGradient {
    motion: [f32; 3],
    depth: f32,
}

#[inline(always)]
fn pixel_gradient(viewer: Viewer, motion: Motion, ray: [f32; 3], found: &Found, gradient: [f32; 4]) -> PixelGradient {
    let direction = rotated(ray, motion.sin, motion.cos);
    let turn = [-direction[1], direction[0], 0.0];
    let room = [gradient[2], gradient[3]];
    let point = motion.point(direction, found.depth);
    // The depth in the old view, which is known, is this much of the depth in the new one.
    let deepens = viewer.depth(direction).max(MIN_DEEPENING);
    let of_depth = dot(viewer.slope(point, direction), room) / deepens;
    let along = |along: [f32; 3]| dot(viewer.slope(point, along), room) - viewer.depth(along) * of_depth;
    PixelGradient {
        motion: [
            dot(viewer.slope(direction, turn), [gradient[0], gradient[1]])
                + along([turn[0] * found.depth, turn[1] * found.depth, 0.0]),
            along([1.0, 0.0, 0.0]),
            along([0.0, 1.0, 0.0]),
        ],
        depth: of_depth,
    }
}

#[inline(always)]
fn dot(a: [f32; 2], b: [f32; 2]) -> f32 {
    a[0] * b[0] + a[1] * b[1]
}

#[cfg(test)]
mod tests {
    use candle_core::Device;

    use super::*;
    use crate::frame::warp::CameraModel;
    use crate::nn::gradient_check::assert_gradients;

    const SIZE: ImageSize = ImageSize { height: 6, width: 8 };

    fn reprojection() -> Reprojection {
        let camera = |fov: f32| CameraModel::new(fov, 0.2).unwrap();
        Reprojection {
            size: SIZE,
            cameras: [1.0, 1.3]
                .map(|fov| ViewerRays::of(Viewer::new(camera(fov), SIZE)))
                .to_vec(),
            context_of: vec![0, 1, 1],
        }
    }

    /// A wall at that depth.
    fn wall(depth: f32) -> Tensor {
        Tensor::full(depth, (2, SIZE.pixels()), &Device::Cpu).unwrap()
    }

    #[test]
    fn a_camera_that_drives_to_a_wall_saw_it_smaller() {
        let motions = Tensor::new(&[[0.0f32, 0.5, 0.0]; 3], &Device::Cpu).unwrap();
        let flat = Reprojection {
            cameras: vec![ViewerRays::of(Viewer::new(CameraModel::new(1.0, 0.0).unwrap(), SIZE)); 2],
            ..reprojection()
        };
        let places = reproject(flat, &wall(3.0), &motions).unwrap();
        let places = places.get(0).unwrap().t().unwrap().to_vec2::<f32>().unwrap();
        for (pixel, place) in places.iter().enumerate() {
            let (x, y) = ((pixel % 8) as f32 - 3.5, (pixel / 8) as f32 - 2.5);
            // The wall is 2.5 m away now and was 3 m away.
            let expected = [x + 3.5, y + 2.5, x / 1.2 + 3.5, y / 1.2 + 2.5, 2.5];
            assert!(
                place.iter().zip(expected).all(|(a, b)| (a - b).abs() < 5e-3),
                "{place:?} {expected:?}"
            );
        }
    }

    #[test]
    fn gradients_agree_with_differences() {
        let motions = Tensor::new(
            &[[0.1f32, 0.03, 0.1], [-0.2, 0.02, 0.0], [0.0, -0.01, 0.05]],
            &Device::Cpu,
        )
        .unwrap();
        assert_gradients(&[wall(2.0)], 1e-2, |inputs| {
            reproject(reprojection(), &inputs[0], &motions)?.narrow(1, 0, 4)
        });
        assert_gradients(std::slice::from_ref(&motions), 1e-2, |inputs| {
            reproject(reprojection(), &wall(2.0), &inputs[0])?.narrow(1, 0, 4)
        });
    }
}
