//! What a ray of the camera meets in a room whose six sides are learned: an upright box around all places where the robot
//! was in training. The scene field reads the point met, so that it learns the sides' appearance in the sides' own
//! coordinates, and the room's depth says how its pixels move when the camera drives.
// A closure's vector instructions reach what is inlined into it, and only that.
#![allow(clippy::inline_always)]

use candle_core::{Result, Tensor};

use crate::frame::warp::CameraModel;
use crate::nn::geometry::camera::{CameraPose, Viewer, rotated};
use crate::nn::geometry::viewer_rays::ViewerRays;
use crate::nn::ops::gathering::SAMPLED_TOGETHER;
use crate::nn::ops::sampling::ImageSize;
use crate::nn::tensors::with_values;
use crate::vectorized::vectorized;

pub(super) const SIDES: usize = 6;
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
pub(super) struct RoomRay {
    pub(super) origin: [f32; 3],
    pub(super) direction: [f32; 3],
}

/// Where a ray meets the room.
#[derive(Clone, Copy)]
pub(super) struct RoomHit {
    pub(super) point: [f32; 3],
    /// Index of the side: 2 · axis, plus 1 at its far end.
    pub(super) side: usize,
    /// In lengths of the ray's direction.
    pub(super) time: f32,
}

/// The six sides, low and high of each axis, in units of the room.
#[derive(Clone, Copy, Debug)]
pub(super) struct RoomSides([f32; SIDES]);

impl RoomSides {
    /// From the learned parameter's values.
    pub(super) fn learned(parameter: &[f32]) -> Self {
        Self(std::array::from_fn(|side| {
            FIRST_SIDES[side] + SIDE_GAIN * parameter.get(side).copied().unwrap_or(0.0)
        }))
    }

    /// From the parameter `[6]` as it is now.
    pub(super) fn of(parameter: &Tensor) -> Result<Self> {
        with_values(parameter, Self::learned)
    }

    #[inline(always)]
    pub(super) fn hit(&self, ray: RoomRay) -> RoomHit {
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
            // The rays of large frames are not kept, so views share them.
            let before = index.checked_sub(1).filter(|&before| cameras[before] == camera);
            views.push(Self {
                pose,
                above: above(camera, learned_by),
                camera: before.map_or_else(
                    || ViewerRays::of(Viewer::new(camera, size)),
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

/// Where a view is taken from, in units of the room.
#[derive(Clone, Copy)]
pub(super) struct SeenFrom {
    origin: [f32; 3],
    sin: f32,
    cos: f32,
}

impl SeenFrom {
    /// A ray in the robot's axes, as one in the room.
    #[inline(always)]
    pub(super) fn ray(self, ray: [f32; 3]) -> RoomRay {
        RoomRay {
            origin: self.origin,
            direction: rotated(ray, self.sin, self.cos),
        }
    }

    /// A point of the room in the robot's axes.
    #[inline(always)]
    fn relative(self, [x, y, z]: [f32; 3]) -> [f32; 3] {
        let relative = [x - self.origin[0], y - self.origin[1], z - self.origin[2]];
        rotated(relative, -self.sin, self.cos)
    }
}

/// Views of one room.
#[derive(Clone)]
pub(super) struct RoomViews {
    pub(super) scale: RoomScale,
    pub(super) views: Vec<ViewInRoom>,
}

impl RoomViews {
    /// Rays of all views.
    pub(super) fn rays(&self) -> usize {
        self.views.iter().map(|view| view.camera.rays.len()).sum()
    }

    /// Where a view is taken from.
    pub(super) fn seen_from(&self, view: &ViewInRoom) -> SeenFrom {
        self.at(view.pose, view.above)
    }

    fn at(&self, pose: CameraPose, above: f32) -> SeenFrom {
        let RoomScale { middle: [x, y], unit } = self.scale;
        let (sin, cos) = pose.heading.sin_cos();
        SeenFrom {
            origin: [(pose.x - x) / unit, (pose.y - y) / unit, above / unit],
            sin,
            cos,
        }
    }

    /// Calls `visit` with each ray in the room, views one after another.
    #[inline(always)]
    pub(super) fn visit(&self, mut visit: impl FnMut(RoomRay)) {
        for view in &self.views {
            let seen_from = self.seen_from(view);
            for &ray in view.camera.rays.iter() {
                visit(seen_from.ray(ray));
            }
        }
    }

    /// Each view with its part of `out`, which has so many values of each ray.
    pub(super) fn parts<'a>(
        &'a self,
        mut out: &'a mut [f32],
        of_ray: usize,
    ) -> impl Iterator<Item = (&'a ViewInRoom, &'a mut [f32])> {
        self.views.iter().map(move |view| {
            let (part, later) = std::mem::take(&mut out).split_at_mut(of_ray * view.camera.rays.len());
            out = later;
            (view, part)
        })
    }

    /// Where each view's pixels were seen from the pose of the same index in `before`: `[views, rays, 2]`.
    pub(super) fn places_before(&self, sides: RoomSides, viewer: Viewer, before: &[CameraPose]) -> Vec<f32> {
        let mut places = vec![0.0; 2 * self.rays()];
        for ((view, places), before) in self.parts(&mut places, 2).zip(before) {
            let (now, before) = (self.seen_from(view), self.at(*before, view.above));
            vectorized(
                #[inline(always)]
                || {
                    for (part, places) in places.chunks_mut(2 * SAMPLED_TOGETHER).enumerate() {
                        let rays = view.camera.together(part * SAMPLED_TOGETHER);
                        let mut points = [[0.0; SAMPLED_TOGETHER]; 3];
                        for at in 0..SAMPLED_TOGETHER {
                            let met = sides.hit(now.ray([rays[0][at], rays[1][at], rays[2][at]]));
                            [points[0][at], points[1][at], points[2][at]] = before.relative(met.point);
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

#[cfg(test)]
mod tests {
    use super::*;
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
            views.visit(|ray| points.push(RoomSides::learned(&[0.0; 6]).hit(ray).point));
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
