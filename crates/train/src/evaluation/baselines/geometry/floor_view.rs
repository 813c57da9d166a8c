//! How a camera sees a flat floor and a wall around it, before and after it moved.

use foreframe_core::frame::warp::{CameraModel, CameraView};
use foreframe_sim::PlanarPose;

use crate::evaluation::baselines::commanded_motion::ORIGIN;

/// Rays that point less downwards than this do not meet the floor.
const MIN_DOWN: f32 = 1e-6;
/// No ray ends nearer than this, in lengths of the ray.
const MIN_REACH: f32 = 0.05;
/// How often the column of the last frame, which says where the wall stands, is looked up again.
const ROUNDS: usize = 3;

/// A camera at a known height above a flat floor, and a wall around the place where it took the last frame.
///
/// The wall is a part of a cylinder in each column of the last frame. Poses are in the axes of the last frame.
pub(super) struct FloorView {
    view: CameraView,
    camera_height_m: f32,
    width: usize,
    height: usize,
    /// The ray of each pixel, row by row.
    rays: Vec<[f32; 3]>,
}

impl FloorView {
    /// None where the camera's height is not known. `width` and `height` are those of the frames.
    pub(super) fn new(camera: CameraModel, width: usize, height: usize) -> Option<Self> {
        let (camera_height_m, view) = (camera.height_m?, CameraView::new(camera, width, height));
        Some(Self {
            view,
            camera_height_m,
            width,
            height,
            rays: view.rays(width, height).collect(),
        })
    }

    /// Columns of a frame.
    pub(super) fn width(&self) -> usize {
        self.width
    }

    /// Rows of a frame.
    pub(super) fn height(&self) -> usize {
        self.height
    }

    /// For each pixel that a camera at `pose` sees, its place in the last frame. `walls_m` holds the wall's distance for each
    /// column of the last frame.
    pub(super) fn places_in_last(&self, pose: PlanarPose, walls_m: &[f32]) -> Vec<[f32; 2]> {
        let (sin, cos) = pose.heading_rad.sin_cos();
        let place = |&[ahead, left, up]: &[f32; 3]| {
            let ray = [cos * ahead - sin * left, sin * ahead + cos * left, up];
            let mut place = self.view.project(ray);
            let mut column = self.column_of(place);
            for _ in 0..ROUNDS {
                place = self.view.project(self.end(pose, ray, walls_m[column]));
                let found = self.column_of(place);
                if walls_m[found].total_cmp(&walls_m[column]).is_eq() {
                    break;
                }
                column = found;
            }
            place
        };
        self.rays.iter().map(place).collect()
    }

    /// For each pixel of the last frame, its place in the frame of a camera at `pose`, for a wall at one distance.
    pub(super) fn places_at(&self, pose: PlanarPose, wall_m: f32) -> Vec<[f32; 2]> {
        let (sin, cos) = pose.heading_rad.sin_cos();
        let place = |ray: &[f32; 3]| {
            let [x, y, up] = self.end(ORIGIN, *ray, wall_m);
            let (x, y) = (x - pose.x_m, y - pose.y_m);
            self.view.project([cos * x + sin * y, cos * y - sin * x, up])
        };
        self.rays.iter().map(place).collect()
    }

    fn column_of(&self, [column, _]: [f32; 2]) -> usize {
        // The cast cuts off, and a place left of the frame becomes 0.
        (column as usize).min(self.width - 1)
    }

    /// Where a ray from a camera at `pose` meets the floor or the wall, whichever is nearer. The ray is in the axes of the
    /// last frame.
    fn end(&self, pose: PlanarPose, ray: [f32; 3], wall_m: f32) -> [f32; 3] {
        let [x, y, up] = ray;
        let floor = if up < -MIN_DOWN {
            self.camera_height_m / -up
        } else {
            f32::INFINITY
        };
        let wall = wall_reach(pose, ray, wall_m);
        let reach = floor.min(wall).max(MIN_REACH);
        [pose.x_m + reach * x, pose.y_m + reach * y, reach * up]
    }
}

/// How many lengths of the ray it is from a camera to a wall around the origin.
fn wall_reach(pose: PlanarPose, [x, y, _]: [f32; 3], wall_m: f32) -> f32 {
    let length_squared = (x * x + y * y).max(1e-9);
    let along = pose.x_m * x + pose.y_m * y;
    let outside = pose.x_m * pose.x_m + pose.y_m * pose.y_m - wall_m * wall_m;
    // A camera that drove through the wall may look past it.
    let root = (along * along - length_squared * outside).max(0.0).sqrt();
    (root - along) / length_squared
}

#[cfg(test)]
mod tests {
    use super::*;
    use foreframe_core::frame::warp::sample;

    const SIDE: usize = 32;
    const WALL_M: f32 = 1.5;

    fn view() -> FloorView {
        let camera = CameraModel {
            horizontal_fov_rad: 1.2,
            tilt_down_rad: 0.3,
            height_m: Some(0.5),
        };
        FloorView::new(camera, SIDE, SIDE).unwrap()
    }

    /// A smooth picture of the floor and the wall, as a camera at `pose` sees it.
    fn picture(pose: PlanarPose) -> Vec<f32> {
        let (view, (sin, cos)) = (view(), pose.heading_rad.sin_cos());
        let seen = view.rays.iter().map(|&[x, y, up]| {
            let [x, y, z] = view.end(pose, [cos * x - sin * y, sin * x + cos * y, up], WALL_M);
            0.5 + 0.2 * (3.0 * x).sin() + 0.2 * (4.0 * y + z).cos()
        });
        seen.collect()
    }

    const MOVED: PlanarPose = PlanarPose {
        x_m: 0.15,
        y_m: 0.03,
        heading_rad: 0.2,
    };

    /// Between pixels, a frame is interpolated.
    const INTERPOLATION: f32 = 0.03;

    /// The largest difference over the pixels whose places are inside the frame.
    fn difference(values: &[f32], places: &[[f32; 2]], expected: &[f32]) -> f32 {
        let (sampled, inside) = sample(values, SIDE, SIDE, places);
        assert!(inside.iter().filter(|&&inside| inside).count() > SIDE * SIDE / 2);
        let pixels = sampled.iter().zip(expected).zip(&inside).filter(|(_, inside)| **inside);
        pixels.map(|((a, b), _)| (a - b).abs()).fold(0.0, f32::max)
    }

    #[test]
    fn the_last_frame_shows_what_the_moved_camera_sees() {
        let places = view().places_in_last(MOVED, &[WALL_M; SIDE]);
        let difference = difference(&picture(ORIGIN), &places, &picture(MOVED));
        assert!(difference < INTERPOLATION, "{difference}");
    }

    #[test]
    fn the_frame_of_a_moved_camera_shows_what_the_last_frame_sees() {
        let places = view().places_at(MOVED, WALL_M);
        let difference = difference(&picture(MOVED), &places, &picture(ORIGIN));
        assert!(difference < INTERPOLATION, "{difference}");
    }

    #[test]
    fn a_camera_at_an_unknown_height_sees_no_floor() {
        assert!(FloorView::new(CameraModel::new(1.0, 0.2).unwrap(), SIDE, SIDE).is_none());
    }

    #[test]
    fn a_camera_behind_the_wall_still_has_places() {
        let pose = PlanarPose { x_m: 3.0, ..ORIGIN };
        let places = view().places_in_last(pose, &[WALL_M; SIDE]);
        assert!(places.iter().flatten().all(|place| place.is_finite()));
    }
}
