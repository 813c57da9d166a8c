//! The camera's geometry as the flow network uses it: the ray of each pixel, where a turning camera saw it before, and
//! where a moving one did.
//!
//! Axes as in ROS: x ahead, y to the left, z up. Places are columns and rows, 0 at the first pixel's middle.
// A closure's vector instructions reach what is inlined into it, and only that.
#![allow(clippy::inline_always)]

use candle_core::{CpuStorage, CustomOp1, Layout, Result, Shape, Tensor, bail};

use crate::frame::warp::CameraModel;
use crate::nn::ops::sampling::ImageSize;
use crate::nn::tensors::{slice, with_values};
use crate::vectorized::vectorized;

/// Depths below this count as this deep, so that what is behind the camera lands far outside the frame.
const MIN_DEPTH: f32 = 1e-3;

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
    tilt_sin: f32,
    tilt_cos: f32,
    /// Size of a pixel at depth 1.
    pixel: f32,
    size: ImageSize,
}

impl Viewer {
    pub(in crate::nn) fn new(camera: CameraModel, size: ImageSize) -> Self {
        let (tilt_sin, tilt_cos) = camera.tilt_down_rad.sin_cos();
        Self {
            tilt_sin,
            tilt_cos,
            pixel: 2.0 * (camera.horizontal_fov_rad / 2.0).tan() / size.width as f32,
            size,
        }
    }

    /// The ray of each pixel in the robot's axes, row by row; 1 long along the camera's axis.
    pub(in crate::nn) fn rays(self) -> Vec<[f32; 3]> {
        let ImageSize { height, width } = self.size;
        let pixels = (0..height).flat_map(|row| (0..width).map(move |column| (column, row)));
        pixels
            .map(|(column, row)| {
                let right = (column as f32 + 0.5 - width as f32 / 2.0) * self.pixel;
                let down = (row as f32 + 0.5 - height as f32 / 2.0) * self.pixel;
                [
                    self.tilt_cos - down * self.tilt_sin,
                    -right,
                    -self.tilt_sin - down * self.tilt_cos,
                ]
            })
            .collect()
    }

    /// Depth of a point in the robot's axes, and how far it lies below the camera's axis.
    #[inline(always)]
    fn depth_and_down(self, [ahead, _, up]: [f32; 3]) -> [f32; 2] {
        [
            self.tilt_cos * ahead - self.tilt_sin * up,
            -(self.tilt_sin * ahead + self.tilt_cos * up),
        ]
    }

    /// The place of a point in the robot's axes.
    #[inline(always)]
    pub(in crate::nn) fn project(self, point: [f32; 3]) -> [f32; 2] {
        let [depth, down] = self.depth_and_down(point);
        let scale = 1.0 / (depth.max(MIN_DEPTH) * self.pixel);
        [
            (self.size.width as f32 - 1.0) / 2.0 - point[1] * scale,
            (self.size.height as f32 - 1.0) / 2.0 + down * scale,
        ]
    }

    /// Where each pixel was before the camera turned by `yaw`, `[P, 2]`.
    pub(in crate::nn) fn turned(self, rays: &[[f32; 3]], yaw: f32) -> Vec<f32> {
        let mut places = vec![0.0; 2 * rays.len()];
        self.write_turned(rays, yaw, &mut places);
        places
    }

    /// As [`Viewer::turned`], into `places`.
    fn write_turned(self, rays: &[[f32; 3]], yaw: f32, places: &mut [f32]) {
        let (sin, cos) = yaw.sin_cos();
        vectorized(
            #[inline(always)]
            || {
                for (place, &ray) in places.chunks_exact_mut(2).zip(rays) {
                    place.copy_from_slice(&self.project(rotated(ray, sin, cos)));
                }
            },
        );
    }
}

/// A direction turned counter-clockwise about the vertical.
#[inline(always)]
pub(in crate::nn) fn rotated([ahead, left, up]: [f32; 3], sin: f32, cos: f32) -> [f32; 3] {
    [cos * ahead - sin * left, sin * ahead + cos * left, up]
}

/// Where each pixel was before the camera turned by `yaw` `[M]`, in radians: `[M, P, 2]`. Gradients go to the yaw.
pub(in crate::nn) fn turning_places(viewer: Viewer, rays: &[[f32; 3]], yaw: &Tensor) -> Result<Tensor> {
    let yaw = yaw.contiguous()?;
    let operation = Turning {
        viewer,
        rays: rays.to_vec(),
    };
    if yaw.track_op() {
        yaw.apply_op1(operation)
    } else {
        yaw.apply_op1_no_bwd(&operation)
    }
}

struct Turning {
    viewer: Viewer,
    rays: Vec<[f32; 3]>,
}

impl CustomOp1 for Turning {
    fn name(&self) -> &'static str {
        "turning-places"
    }

    fn cpu_fwd(&self, yaw: &CpuStorage, layout: &Layout) -> Result<(CpuStorage, Shape)> {
        let yaw = slice(yaw, layout)?;
        if layout.dims().len() != 1 {
            bail!("yaw has shape {:?}; it must be [M]", layout.dims());
        }
        let of_item = 2 * self.rays.len();
        let mut places = vec![0.0; yaw.len() * of_item];
        for (places, &yaw) in places.chunks_exact_mut(of_item).zip(yaw) {
            self.viewer.write_turned(&self.rays, yaw, places);
        }
        Ok((CpuStorage::F32(places), Shape::from((yaw.len(), self.rays.len(), 2))))
    }

    fn bwd(&self, yaw: &Tensor, _places: &Tensor, gradient: &Tensor) -> Result<Option<Tensor>> {
        let Viewer {
            tilt_sin,
            tilt_cos,
            pixel,
            ..
        } = self.viewer;
        let slope = |ray: [f32; 3], sin: f32, cos: f32| {
            let point = rotated(ray, sin, cos);
            let [depth, down] = self.viewer.depth_and_down(point);
            if depth <= MIN_DEPTH {
                return [0.0; 2];
            }
            let [ahead, left, _] = point;
            // Of ahead, left, depth and down with the yaw: −left, ahead, and so on.
            let (depth_slope, down_slope) = (-tilt_cos * left, tilt_sin * left);
            let scale = 1.0 / (depth * depth * pixel);
            [
                -(ahead * depth - left * depth_slope) * scale,
                (down_slope * depth - down * depth_slope) * scale,
            ]
        };
        let sums: Vec<f32> = with_values(yaw, |yaw| {
            with_values(gradient, |gradient| {
                yaw.iter()
                    .zip(gradient.chunks_exact(2 * self.rays.len()))
                    .map(|(yaw, gradient)| {
                        let (sin, cos) = yaw.sin_cos();
                        let rays = self.rays.iter().zip(gradient.chunks_exact(2));
                        rays.map(|(&ray, gradient)| {
                            let [column, row] = slope(ray, sin, cos);
                            column * gradient[0] + row * gradient[1]
                        })
                        .sum()
                    })
                    .collect()
            })
        })??;
        Ok(Some(Tensor::from_vec(sums, yaw.dims(), yaw.device())?))
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
        let places = viewer.turned(&viewer.rays(), 0.3);
        let expected = rotation_grid(CAMERA, SIZE.width, SIZE.height, 0.3);
        for (place, expected) in places.chunks_exact(2).zip(expected) {
            assert!((place[0] + 0.5 - expected[0]).abs() < 1e-4 && (place[1] + 0.5 - expected[1]).abs() < 1e-4);
        }
    }

    #[test]
    fn gradients_of_the_yaw_agree_with_differences() {
        let viewer = Viewer::new(CAMERA, SIZE);
        let yaw = Tensor::new(&[0.1f32, -0.4, 0.0], &candle_core::Device::Cpu).unwrap();
        assert_gradients(&[yaw], 1e-3, |inputs| {
            turning_places(viewer, &viewer.rays(), &inputs[0])
        });
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
