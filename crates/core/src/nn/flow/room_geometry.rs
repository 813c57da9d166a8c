//! What a ray of the camera meets in a room whose six sides are learned: an upright box around all places where the robot
//! was in training. The scene field reads the point met, so that it learns the sides' appearance in the sides' own
//! coordinates, and the room's depth says how its pixels move when the camera drives.
// A closure's vector instructions reach what is inlined into it, and only that.
#![allow(clippy::inline_always)]

use std::ops::Range;

use candle_core::{Result, Shape, Tensor};

use crate::frame::warp::CameraModel;
use crate::nn::fused::{FusedOperation, Operand, apply};
use crate::nn::geometry::camera::{CameraPose, Viewer, ViewerRays, rotated};
use crate::nn::ops::gathering::SAMPLED_TOGETHER;
use crate::nn::ops::sampling::ImageSize;
use crate::nn::tensors::with_values;
use crate::vectorized::vectorized;

/// Octaves of sines and cosines of each coordinate of the point met.
pub(super) const OCTAVES: usize = 5;
/// The lowest frequency, in radians per unit of the room.
pub(super) const LOWEST: f32 = std::f32::consts::FRAC_PI_4;
const WAVES: usize = 3 * 2 * OCTAVES;
pub(super) const SIDES: usize = 6;
/// Numbers that describe one ray: waves, side met, point met, the ray itself and the distance.
pub(super) const RAY_VALUES: usize = WAVES + SIDES + 12;
/// Where the sides lie before they are learned, from the middle of the places seen in training, in units of the room.
pub(super) const FIRST_SIDES: [f32; SIDES] = [-2.6, 2.6, -2.6, 2.6, -0.8, 2.0];
/// Units of the room that one unit of the learned parameter moves a side.
pub(super) const SIDE_GAIN: f32 = 2.0;
/// Nearest that a side counts.
pub(super) const MIN_DISTANCE: f32 = 0.02;

/// The unit of a room and its origin: typical places of the robot in training.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct RoomScale {
    /// The middle of the places, in metres.
    pub(super) middle: [f32; 2],
    /// How far they spread, in metres: the unit.
    pub(super) unit: f32,
}

/// A ray in units of the room.
#[derive(Clone, Copy)]
struct RoomRay {
    origin: [f32; 3],
    direction: [f32; 3],
}

/// Where a ray meets the room.
#[derive(Clone, Copy)]
struct RoomHit {
    point: [f32; 3],
    /// Index of the side: 2 · axis, plus 1 at its far end.
    side: usize,
    /// In lengths of the ray's direction.
    time: f32,
}

/// The six sides, low and high of each axis, in units of the room.
#[derive(Clone, Copy, Debug)]
pub(super) struct RoomSides([f32; SIDES]);

impl RoomSides {
    /// From the learned parameter's values.
    fn learned(parameter: &[f32]) -> Self {
        Self(std::array::from_fn(|side| {
            FIRST_SIDES[side] + SIDE_GAIN * parameter.get(side).copied().unwrap_or(0.0)
        }))
    }

    /// From the parameter `[6]` as it is now.
    pub(super) fn of(parameter: &Tensor) -> Result<Self> {
        with_values(parameter, Self::learned)
    }

    #[inline(always)]
    fn hit(&self, ray: RoomRay) -> RoomHit {
        let (mut time, mut side) = (f32::MAX, 0);
        for axis in 0..3 {
            let speed = ray.direction[axis];
            let (far, at) = if speed > 0.0 {
                (1, self.0[2 * axis + 1])
            } else {
                (0, self.0[2 * axis])
            };
            let speed = if speed.abs() < 1e-6 { 1e-6 } else { speed };
            let until = (at - ray.origin[axis]) / speed;
            if until < time {
                (time, side) = (until, 2 * axis + far);
            }
        }
        let time = time.max(MIN_DISTANCE);
        RoomHit {
            point: [
                ray.origin[0] + time * ray.direction[0],
                ray.origin[1] + time * ray.direction[1],
                ray.origin[2] + time * ray.direction[2],
            ],
            side,
            time,
        }
    }
}

/// From where a room is seen, and by which camera.
#[derive(Clone)]
pub(super) struct ViewInRoom {
    pub(super) pose: CameraPose,
    /// How far the camera is above the height from which the room was learned, in metres.
    pub(super) above: f32,
    /// All views have the same number of rays.
    pub(super) camera: ViewerRays,
}

impl ViewInRoom {
    /// Views from these poses by these cameras. `learned_by`: the camera by which the room was learned.
    pub(super) fn of(
        poses: &[CameraPose],
        cameras: &[CameraModel],
        learned_by: CameraModel,
        size: ImageSize,
    ) -> Vec<Self> {
        let mut views: Vec<Self> = Vec::with_capacity(poses.len());
        for (index, (&pose, &camera)) in poses.iter().zip(cameras).enumerate() {
            let before = index.checked_sub(1).filter(|&before| cameras[before] == camera);
            views.push(Self {
                pose,
                above: above(camera, learned_by),
                camera: before.map_or_else(
                    || Viewer::new(camera, size).into(),
                    |before| views[before].camera.clone(),
                ),
            });
        }
        views
    }
}

/// How far a camera is above another one, in metres; 0 where a height is not known.
pub(super) fn above(camera: CameraModel, other: CameraModel) -> f32 {
    let heights = camera.height_m.zip(other.height_m);
    heights.map_or(0.0, |(own, other)| own - other)
}

/// Views of one room.
#[derive(Clone)]
pub(super) struct RoomViews {
    pub(super) scale: RoomScale,
    pub(super) views: Vec<ViewInRoom>,
}

impl RoomViews {
    /// Rays of all views.
    fn rays(&self) -> usize {
        self.views.iter().map(|view| view.camera.rays.len()).sum()
    }

    #[inline(always)]
    fn origin(&self, pose: CameraPose, above: f32) -> [f32; 3] {
        let RoomScale { middle: [x, y], unit } = self.scale;
        [(pose.x - x) / unit, (pose.y - y) / unit, above / unit]
    }

    /// Calls `visit` with each ray in the room, views one after another, and the range of its description.
    #[inline(always)]
    fn visit(&self, mut visit: impl FnMut(Range<usize>, RoomRay)) {
        let mut from = 0;
        for ViewInRoom { pose, above, camera } in &self.views {
            let origin = self.origin(*pose, *above);
            let (sin, cos) = pose.heading.sin_cos();
            for &ray in camera.rays.iter() {
                let direction = rotated(ray, sin, cos);
                visit(from..from + RAY_VALUES, RoomRay { origin, direction });
                from += RAY_VALUES;
            }
        }
    }

    /// What each ray meets, described by [`RAY_VALUES`] numbers: `[views · rays, RAY_VALUES]`. `parameter` `[6]` moves the
    /// sides, and gradients go to it.
    pub(super) fn describe(self, parameter: &Tensor) -> Result<Tensor> {
        apply(self, [parameter])
    }

    /// Where each view's pixels were seen from the pose of the same index in `before`: `[views, rays, 2]`.
    pub(super) fn places_before(&self, sides: RoomSides, viewer: Viewer, before: &[CameraPose]) -> Vec<f32> {
        let mut places = vec![0.0; 2 * self.rays()];
        let mut rest = places.as_mut_slice();
        for (ViewInRoom { pose, above, camera }, from) in self.views.iter().zip(before) {
            let (places, later) = rest.split_at_mut(2 * camera.rays.len());
            rest = later;
            let [origin, seen_from] = [pose, from].map(|pose| self.origin(*pose, *above));
            let [(sin, cos), (sin_before, cos_before)] = [pose, from].map(|pose| pose.heading.sin_cos());
            vectorized(
                #[inline(always)]
                || {
                    for (part, places) in places.chunks_mut(2 * SAMPLED_TOGETHER).enumerate() {
                        let rays = camera.together(part * SAMPLED_TOGETHER);
                        let mut points = [[0.0; SAMPLED_TOGETHER]; 3];
                        for at in 0..SAMPLED_TOGETHER {
                            let direction = rotated([rays[0][at], rays[1][at], rays[2][at]], sin, cos);
                            let [x, y, z] = sides.hit(RoomRay { origin, direction }).point;
                            let relative = [x - seen_from[0], y - seen_from[1], z - seen_from[2]];
                            [points[0][at], points[1][at], points[2][at]] = rotated(relative, -sin_before, cos_before);
                        }
                        let [x, y] = viewer.project_together(&points);
                        for (place, (x, y)) in places.as_chunks_mut::<2>().0.iter_mut().zip(x.into_iter().zip(y)) {
                            *place = [x, y];
                        }
                    }
                },
            );
        }
        places
    }
}

/// Writes a ray's description.
#[inline(always)]
fn describe(ray: RoomRay, hit: RoomHit, out: &mut [f32]) {
    for axis in 0..3 {
        let (mut sin, mut cos) = (LOWEST * hit.point[axis]).sin_cos();
        for octave in 0..OCTAVES {
            let at = 2 * (axis * OCTAVES + octave);
            out[at] = sin;
            out[at + 1] = cos;
            (sin, cos) = (2.0 * sin * cos, cos * cos - sin * sin);
        }
    }
    out[WAVES + hit.side] = 1.0;
    let rest = &mut out[WAVES + SIDES..];
    rest[..3].copy_from_slice(&hit.point);
    let [x, y, z] = ray.direction;
    let level = (x * x + y * y).sqrt().max(1e-6);
    rest[3] = ray.origin[0];
    rest[4] = ray.origin[1];
    rest[5] = x / level;
    rest[6] = y / level;
    rest[7] = z / level;
    // With the direction, the line's distance from the middle says which line it is: upright things stand on lines.
    rest[8] = (ray.origin[0] * y - ray.origin[1] * x) / level;
    let distance = hit.time * (level * level + z * z).sqrt();
    rest[9] = 0.25 * distance;
    rest[10] = 0.05 * distance * distance;
    rest[11] = 1.0 / (distance + 0.3);
}

impl FusedOperation<1> for RoomViews {
    const NAME: &'static str = "describe-rays";

    fn forward(&self, [parameter]: [Operand; 1]) -> Result<(Vec<f32>, Shape)> {
        let sides = RoomSides::learned(parameter.values);
        let rows = self.rays();
        let mut out = vec![0.0; rows * RAY_VALUES];
        self.visit(|range, ray| describe(ray, sides.hit(ray), &mut out[range]));
        Ok((out, Shape::from((rows, RAY_VALUES))))
    }

    fn backward(&self, [parameter]: [Operand; 1], y: Operand, gradient: Operand) -> Result<[Option<Vec<f32>>; 1]> {
        let sides = RoomSides::learned(parameter.values);
        let mut sums = vec![0.0; SIDES];
        self.visit(|range, ray| {
            let hit = sides.hit(ray);
            let slope = side_gradient(ray, hit, &y.values[range.clone()], &gradient.values[range]);
            sums[hit.side] += SIDE_GAIN * slope;
        });
        Ok([Some(sums)])
    }
}

/// The gradient for the side that the ray meets, in units of the room.
#[inline(always)]
fn side_gradient(ray: RoomRay, hit: RoomHit, y: &[f32], gradient: &[f32]) -> f32 {
    let speed = ray.direction[hit.side / 2];
    if speed.abs() < 1e-3 || hit.time <= MIN_DISTANCE {
        return 0.0;
    }
    let rest = WAVES + SIDES;
    let mut for_time = 0.0;
    for axis in 0..3 {
        let mut for_point = gradient[rest + axis];
        let mut frequency = LOWEST;
        for octave in 0..OCTAVES {
            let at = 2 * (axis * OCTAVES + octave);
            for_point += frequency * (gradient[at] * y[at + 1] - gradient[at + 1] * y[at]);
            frequency *= 2.0;
        }
        for_time += for_point * ray.direction[axis];
    }
    let [x, level_y, z] = ray.direction;
    let length = (x * x + level_y * level_y + z * z).sqrt();
    let distance = hit.time * length;
    let near = 1.0 / (distance + 0.3);
    for_time +=
        length * (0.25 * gradient[rest + 9] + 0.1 * distance * gradient[rest + 10] - near * near * gradient[rest + 11]);
    for_time / speed
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::nn::gradient_check::assert_gradients;
    use crate::nn::ops::sampling::own_places;

    const CAMERA: CameraModel = CameraModel {
        horizontal_fov_rad: 1.0,
        tilt_down_rad: 0.2,
        height_m: Some(0.3),
    };
    const SIZE: ImageSize = ImageSize { height: 4, width: 6 };

    fn views(cameras: &[CameraModel], poses: &[CameraPose]) -> RoomViews {
        RoomViews {
            scale: RoomScale {
                middle: [2.0, 0.5],
                unit: 0.8,
            },
            views: ViewInRoom::of(poses, cameras, CAMERA, SIZE),
        }
    }

    #[test]
    fn gradients_of_the_sides_agree_with_differences() {
        let poses = [0.3, 2.0, -1.2].map(|heading| CameraPose {
            x: 2.3,
            y: 0.2,
            heading,
        });
        let parameter = Tensor::new(&[0.02f32, -0.03, 0.01, 0.05, 0.04, -0.02], &candle_core::Device::Cpu).unwrap();
        assert_gradients(&[parameter], 2e-4, |inputs| {
            views(&[CAMERA; 3], &poses).describe(&inputs[0])
        });
    }

    #[test]
    fn an_unmoved_camera_saw_every_pixel_where_it_is() {
        let pose = CameraPose {
            x: 2.3,
            y: 0.2,
            heading: 0.7,
        };
        let viewer = Viewer::new(CAMERA, SIZE);
        let places = views(&[CAMERA], &[pose]).places_before(RoomSides::learned(&[0.0; 6]), viewer, &[pose]);
        let own = own_places(SIZE);
        assert!(places.iter().zip(own).all(|(a, b)| (a - b).abs() < 1e-3), "{places:?}");
    }

    #[test]
    fn cameras_of_their_own_see_the_same_room() {
        let pose = CameraPose {
            x: 2.3,
            y: 0.2,
            heading: 0.7,
        };
        // The lower middle looks at the floor, `-0.8` units below the height of the camera by which it was learned.
        let ray = 3 * SIZE.width + 3;
        let met = |camera: CameraModel| {
            let views = views(&[CAMERA, camera], &[pose, pose]);
            let mut points = Vec::new();
            views.visit(|_, ray| points.push(RoomSides::learned(&[0.0; 6]).hit(ray).point));
            points[SIZE.pixels() + ray]
        };
        let down = |camera: CameraModel| CameraModel {
            tilt_down_rad: 1.2,
            ..camera
        };
        let [usual, higher] = [0.3, 0.7].map(|height| {
            met(CameraModel {
                height_m: Some(height),
                ..down(CAMERA)
            })
        });
        assert!(
            (usual[2] + 0.8).abs() < 1e-5 && (higher[2] + 0.8).abs() < 1e-5,
            "{usual:?} {higher:?}"
        );
        let from = [(2.3 - 2.0) / 0.8, (0.2 - 0.5) / 0.8];
        let way = |point: [f32; 3]| (point[0] - from[0]).hypot(point[1] - from[1]);
        // Half a unit higher, above 0.8, it sees the floor farther away in that proportion.
        assert!((way(higher) / way(usual) - 1.3 / 0.8).abs() < 1e-4);
        assert_ne!(met(CAMERA), usual);
    }
}
