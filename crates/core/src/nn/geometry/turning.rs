//! Where a camera that turned saw each pixel before.
// A closure's vector instructions reach what is inlined into it, and only that.
#![allow(clippy::inline_always)]

use candle_core::{Result, Shape, Tensor};

use super::camera::{Viewer, rotated};
use super::viewer_rays::ViewerRays;
use crate::nn::fused::{FusedOperation, Operand, apply};
use crate::vectorized::vectorized;

/// Where each pixel was before the camera turned by each of the angles, in radians: `[M, P, 2]`.
pub(in crate::nn) fn turned(viewer: Viewer, yaws: &[f32]) -> Vec<f32> {
    let rays = ViewerRays::of(viewer).rays;
    let mut places = vec![0.0; yaws.len() * 2 * rays.len()];
    for (places, yaw) in places.chunks_exact_mut(2 * rays.len()).zip(yaws) {
        let (sin, cos) = yaw.sin_cos();
        vectorized(
            #[inline(always)]
            || {
                for (place, &ray) in places.as_chunks_mut::<2>().0.iter_mut().zip(rays.iter()) {
                    *place = viewer.project(rotated(ray, sin, cos));
                }
            },
        );
    }
    places
}

/// Where each pixel was before the camera turned by `yaw` `[M]`, in radians: `[M, P, 2]`. Gradients go to the yaw.
pub(in crate::nn) fn turning_places(viewer: Viewer, yaw: &Tensor) -> Result<Tensor> {
    apply(Turning(viewer), [yaw])
}

struct Turning(Viewer);

impl FusedOperation<1> for Turning {
    const NAME: &'static str = "turning-places";

    fn forward(&self, [yaw]: [Operand; 1]) -> Result<(Vec<f32>, Shape)> {
        let shape = (yaw.layout.shape().dims1()?, self.0.size().pixels(), 2);
        Ok((turned(self.0, yaw.values), Shape::from(shape)))
    }

    fn backward(&self, [yaw]: [Operand; 1], _places: Operand, gradient: Operand) -> Result<[Option<Vec<f32>>; 1]> {
        let rays = ViewerRays::of(self.0).rays;
        let items = yaw.values.iter().zip(gradient.values.chunks_exact(2 * rays.len()));
        let sums = items.map(|(yaw, gradient)| {
            let (sin, cos) = yaw.sin_cos();
            let rays = rays.iter().zip(gradient.chunks_exact(2));
            rays.map(|(&ray, gradient)| {
                let point = rotated(ray, sin, cos);
                let [column, row] = self.0.slope(point, [-point[1], point[0], 0.0]);
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
    use crate::frame::warp::{CameraModel, rotation_grid};
    use crate::nn::gradient_check::assert_gradients;
    use crate::nn::ops::sampling::ImageSize;

    const CAMERA: CameraModel = CameraModel {
        horizontal_fov_rad: 1.0,
        tilt_down_rad: 0.2,
        height_m: None,
    };
    const SIZE: ImageSize = ImageSize { height: 6, width: 8 };

    #[test]
    fn turning_agrees_with_the_warp_of_frames() {
        let places = turned(Viewer::new(CAMERA, SIZE), &[0.3]);
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
}
