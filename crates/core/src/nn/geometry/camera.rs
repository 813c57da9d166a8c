//! The camera's geometry as the flow network uses it: the ray of each pixel, where a turning camera saw it before, and
//! where a moving one did.
//!
//! Axes as in ROS: x ahead, y to the left, z up. Places are columns and rows, 0 at the first pixel's middle.
// A closure's vector instructions reach what is inlined into it, and only that.
#![allow(clippy::inline_always)]

use std::sync::Arc;

use candle_core::{Result, Shape, Tensor};

use crate::frame::warp::{CameraModel, CameraView, MIN_DEPTH};
use crate::nn::fused::{FusedOperation, Operand, apply};
use crate::nn::ops::gathering::{OfPlaces, SAMPLED_TOGETHER};
use crate::nn::ops::sampling::ImageSize;
use crate::vectorized::vectorized;

/// Where a camera stands on the floor and where it looks.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(in crate::nn) struct CameraPose {
    /// Metres along the world's x.
    pub(in crate::nn) x: f32,
    /// Metres along the world's y.
    pub(in crate::nn) y: f32,
    /// Counter-clockwise from x, in radians.
    pub(in crate::nn) heading: f32,
}

impl CameraPose {
    /// The pose after driving that far ahead and to the left, then turning.
    pub(in crate::nn) fn moved(self, [yaw, ahead, left]: [f32; 3]) -> Self {
        let (sin, cos) = self.heading.sin_cos();
        Self {
            x: self.x + cos * ahead - sin * left,
            y: self.y + sin * ahead + cos * left,
            heading: self.heading + yaw,
        }
    }

    /// How to get from here to there: yaw in −π…π, ahead, left.
    pub(in crate::nn) fn motion_to(self, there: Self) -> [f32; 3] {
        use std::f32::consts::{PI, TAU};
        let (sin, cos) = self.heading.sin_cos();
        let (x, y) = (there.x - self.x, there.y - self.y);
        let yaw = (there.heading - self.heading + PI).rem_euclid(TAU) - PI;
        [yaw, cos * x + sin * y, cos * y - sin * x]
    }
}

/// A camera that takes frames of some size.
#[derive(Clone, Copy, Debug)]
pub(in crate::nn) struct Viewer {
    view: CameraView,
    size: ImageSize,
}

impl Viewer {
    pub(in crate::nn) fn new(camera: CameraModel, size: ImageSize) -> Self {
        Self {
            view: CameraView::new(camera, size.width, size.height),
            size,
        }
    }

    /// The size of its frames.
    pub(in crate::nn) fn size(self) -> ImageSize {
        self.size
    }

    /// The ray of each pixel in the robot's axes, row by row; 1 long along the camera's axis.
    pub(in crate::nn) fn rays(self) -> Vec<[f32; 3]> {
        // Not by one iterator over all pixels, which the compiler would not turn into vector instructions.
        let ImageSize { height, width } = self.size;
        let mut rays = Vec::with_capacity(self.size.pixels());
        for row in 0..height {
            rays.extend((0..width).map(|column| self.view.ray(column, row)));
        }
        rays
    }

    /// The place of a point in the robot's axes.
    #[inline(always)]
    pub(in crate::nn) fn project(self, point: [f32; 3]) -> [f32; 2] {
        let [depth, down] = self.view.depth_and_down(point);
        let scale = 1.0 / (depth.max(MIN_DEPTH) * self.view.pixel_size);
        [
            (self.size.width as f32 - 1.0) / 2.0 - point[1] * scale,
            (self.size.height as f32 - 1.0) / 2.0 + down * scale,
        ]
    }

    /// As [`Viewer::project`], of several points.
    #[inline(always)]
    pub(in crate::nn) fn project_together(self, points: &[OfPlaces; 3]) -> [OfPlaces; 2] {
        let mut places = [[0.0; SAMPLED_TOGETHER]; 2];
        for at in 0..SAMPLED_TOGETHER {
            [places[0][at], places[1][at]] = self.project([points[0][at], points[1][at], points[2][at]]);
        }
        places
    }

    /// Where each pixel was before the camera turned by each of the angles, in radians: `[M, P, 2]`.
    pub(in crate::nn) fn turned(self, yaws: &[f32]) -> Vec<f32> {
        let rays = self.rays();
        let mut places = vec![0.0; yaws.len() * 2 * rays.len()];
        for (places, yaw) in places.chunks_exact_mut(2 * rays.len()).zip(yaws) {
            let (sin, cos) = yaw.sin_cos();
            vectorized(
                #[inline(always)]
                || {
                    for (place, &ray) in places.chunks_exact_mut(2).zip(&rays) {
                        place.copy_from_slice(&self.project(rotated(ray, sin, cos)));
                    }
                },
            );
        }
        places
    }

    /// Depth of a point in the robot's axes; of a direction, how the depth changes along it.
    #[inline(always)]
    pub(in crate::nn) fn depth(self, point: [f32; 3]) -> f32 {
        self.view.depth_and_down(point)[0]
    }

    /// How the place of a point changes when the point moves along a direction.
    #[inline(always)]
    pub(in crate::nn) fn slope(self, point: [f32; 3], along: [f32; 3]) -> [f32; 2] {
        let [depth, down] = self.view.depth_and_down(point);
        if depth <= MIN_DEPTH {
            return [0.0; 2];
        }
        let [depth_slope, down_slope] = self.view.depth_and_down(along);
        let scale = 1.0 / (depth * depth * self.view.pixel_size);
        [
            -(along[1] * depth - point[1] * depth_slope) * scale,
            (down_slope * depth - down * depth_slope) * scale,
        ]
    }
}

/// A camera with the ray of each of its pixels, which are computed once.
#[derive(Clone, Debug)]
pub(in crate::nn) struct ViewerRays {
    pub(in crate::nn) viewer: Viewer,
    pub(in crate::nn) rays: Arc<[[f32; 3]]>,
    /// The same, each axis on its own, and zeros after the last pixel.
    axes: Arc<[Vec<f32>; 3]>,
}

impl From<Viewer> for ViewerRays {
    fn from(viewer: Viewer) -> Self {
        let rays = viewer.rays();
        let axis = |axis: usize| {
            let mut values = Vec::with_capacity(rays.len() + SAMPLED_TOGETHER);
            values.extend(rays.iter().map(|ray| ray[axis]));
            values.resize(rays.len() + SAMPLED_TOGETHER, 0.0);
            values
        };
        Self {
            viewer,
            axes: Arc::new([axis(0), axis(1), axis(2)]),
            rays: rays.into(),
        }
    }
}

impl ViewerRays {
    /// The rays of neighbouring pixels, from one on, by axis.
    #[inline(always)]
    #[expect(clippy::expect_used, reason = "there are so many zeros after the last pixel")]
    pub(in crate::nn) fn together(&self, first: usize) -> [&OfPlaces; 3] {
        // Not `map`, which is not inlined.
        let [x, y, z] = &*self.axes;
        let x = x[first..].first_chunk().expect("a ray after the last pixel is a bug");
        let y = y[first..].first_chunk().expect("a ray after the last pixel is a bug");
        let z = z[first..].first_chunk().expect("a ray after the last pixel is a bug");
        [x, y, z]
    }
}

/// A direction turned counter-clockwise about the vertical.
#[inline(always)]
pub(in crate::nn) fn rotated([ahead, left, up]: [f32; 3], sin: f32, cos: f32) -> [f32; 3] {
    [cos * ahead - sin * left, sin * ahead + cos * left, up]
}

/// Where each pixel was before the camera turned by `yaw` `[M]`, in radians: `[M, P, 2]`. Gradients go to the yaw.
pub(in crate::nn) fn turning_places(viewer: Viewer, yaw: &Tensor) -> Result<Tensor> {
    apply(viewer, [yaw])
}

impl FusedOperation<1> for Viewer {
    const NAME: &'static str = "turning-places";

    fn forward(&self, [yaw]: [Operand; 1]) -> Result<(Vec<f32>, Shape)> {
        let shape = (yaw.layout.shape().dims1()?, self.size.pixels(), 2);
        Ok((self.turned(yaw.values), Shape::from(shape)))
    }

    fn backward(&self, [yaw]: [Operand; 1], _places: Operand, gradient: Operand) -> Result<[Option<Vec<f32>>; 1]> {
        let rays = self.rays();
        let items = yaw.values.iter().zip(gradient.values.chunks_exact(2 * rays.len()));
        let sums = items.map(|(yaw, gradient)| {
            let (sin, cos) = yaw.sin_cos();
            let rays = rays.iter().zip(gradient.chunks_exact(2));
            rays.map(|(&ray, gradient)| {
                let point = rotated(ray, sin, cos);
                let [column, row] = self.slope(point, [-point[1], point[0], 0.0]);
                column * gradient[0] + row * gradient[1]
            })
            .sum::<f32>()
        });
        Ok([Some(sums.collect())])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frame::warp::rotation_grid;
    use crate::nn::gradient_check::assert_gradients;

    const CAMERA: CameraModel = CameraModel {
        horizontal_fov_rad: 1.0,
        tilt_down_rad: 0.2,
        height_m: None,
    };
    const SIZE: ImageSize = ImageSize { height: 6, width: 8 };

    #[test]
    fn turning_agrees_with_the_warp_of_frames() {
        let viewer = Viewer::new(CAMERA, SIZE);
        let places = viewer.turned(&[0.3]);
        let expected = rotation_grid(CAMERA, SIZE.width, SIZE.height, 0.3);
        for (place, expected) in places.chunks_exact(2).zip(expected) {
            assert!((place[0] + 0.5 - expected[0]).abs() < 1e-4 && (place[1] + 0.5 - expected[1]).abs() < 1e-4);
        }
    }

    #[test]
    fn gradients_of_the_yaw_agree_with_differences() {
        let viewer = Viewer::new(CAMERA, SIZE);
        let yaw = Tensor::new(&[0.1f32, -0.4, 0.0], &candle_core::Device::Cpu).unwrap();
        assert_gradients(&[yaw], 1e-3, |inputs| turning_places(viewer, &inputs[0]));
    }

    #[test]
    fn a_motion_leads_from_one_pose_to_the_other() {
        let here = CameraPose {
            x: 1.0,
            y: -2.0,
            heading: 3.0,
        };
        let motion = [0.4, 0.3, -0.1];
        let found = here.motion_to(here.moved(motion));
        assert!(found.iter().zip(motion).all(|(a, b)| (a - b).abs() < 1e-5), "{found:?}");
    }
}
