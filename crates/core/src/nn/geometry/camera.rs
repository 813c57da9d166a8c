//! Where a camera stands, the ray of each pixel, and the place of each point.
//!
//! Axes as in ROS: x ahead, y to the left, z up. Places are columns and rows, 0 at the first pixel's middle.
// A closure's vector instructions reach what is inlined into it, and only that.
#![allow(clippy::inline_always)]

use crate::frame::warp::{CameraModel, CameraView, MIN_DEPTH};
use crate::nn::ops::gathering::{OfPlaces, SAMPLED_TOGETHER};
use crate::nn::ops::sampling::ImageSize;

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
    camera: CameraModel,
    view: CameraView,
    size: ImageSize,
}

impl Viewer {
    pub(in crate::nn) fn new(camera: CameraModel, size: ImageSize) -> Self {
        Self {
            camera,
            view: CameraView::new(camera, size.width, size.height),
            size,
        }
    }

    /// The camera that takes the frames.
    pub(super) fn camera(self) -> CameraModel {
        self.camera
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

/// A direction turned counter-clockwise about the vertical.
#[inline(always)]
pub(in crate::nn) fn rotated([ahead, left, up]: [f32; 3], sin: f32, cos: f32) -> [f32; 3] {
    [cos * ahead - sin * left, sin * ahead + cos * left, up]
}

#[cfg(test)]
mod tests {
    use super::*;

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
