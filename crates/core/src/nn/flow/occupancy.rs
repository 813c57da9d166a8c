//! What stands around a robot, and where movers will be: from the depth of the last frame, and from where movers are seen and
//! expected. A mover stands on the floor, so its lowest pixels tell how far away it is.

use crate::nn::geometry::camera::{CameraPose, Viewer};
use crate::nn::mask_loss::probability;
use crate::nn::ops::sampling::ImageSize;

/// A pixel with at least this probability belongs to a mover.
pub(super) const MOVER_PROBABILITY: f32 = 0.5;
/// Pixels of a column, one above the other, that make a mover. One alone is more often an error.
const LEAST_PIXELS: usize = 2;
/// Columns to each side whose mover counts as the same.
const COLUMNS_BESIDE: usize = 2;
/// How far a mover reaches away from the camera behind its nearest side, in metres.
const MOVER_DEPTH_M: f32 = 0.3;
/// Places of a mover from its nearest side to its farthest.
const PLACES_DEEP: usize = 3;

/// What stands around a robot, in the axes of its last frame.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Occupancy {
    /// The points that the last frame shows, but for movers: metres ahead, left and up of the camera.
    pub points: Vec<[f32; 3]>,
    /// Where movers touch the floor in the last frame, then after each step that is predicted: metres ahead and to the left. Empty
    /// if the model does not find movers.
    pub movers: Vec<Vec<[f32; 2]>>,
    /// The depth of each pixel of the last frame along the camera's axis, in metres.
    pub depths_m: Vec<f32>,
    /// The same before anything is learned: a wall around the camera, and the floor.
    pub first_depths_m: Vec<f32>,
}

/// One camera's view of a room.
pub(super) struct OccupancyView {
    pub(super) viewer: Viewer,
    pub(super) size: ImageSize,
    pub(super) height_m: f32,
}

impl OccupancyView {
    /// The points of all pixels with these depths that do not belong to a mover. `movers`: the pixels' logits.
    pub(super) fn points(&self, depths: &[f32], movers: Option<&[f32]>) -> Vec<[f32; 3]> {
        let is_fixed = |pixel: usize| movers.is_none_or(|logits| !self.is_beside_mover(logits, pixel));
        let rays = self.viewer.rays().into_iter().zip(depths).enumerate();
        rays.filter(|&(pixel, _)| is_fixed(pixel))
            .map(|(_, (ray, depth))| ray.map(|part| part * depth))
            .collect()
    }

    /// The places where movers stand, seen by a camera that has moved by yaw, ahead and left; in the axes before.
    pub(super) fn movers(&self, logits: &[f32], motion: [f32; 3]) -> Vec<[f32; 2]> {
        let rays = self.viewer.rays();
        let moved = CameraPose::default().moved(motion);
        let (sin, cos) = moved.heading.sin_cos();
        let nearest: Vec<Option<[f32; 2]>> = (0..self.size.width)
            .map(|column| self.nearest(&rays, logits, column))
            .collect();
        let mut places = Vec::new();
        for (column, place) in nearest.iter().enumerate() {
            let Some([ahead, left]) = *place else { continue };
            // At its sides, a mover often ends above the floor.
            let beside = column.saturating_sub(COLUMNS_BESIDE)..(column + COLUMNS_BESIDE + 1).min(nearest.len());
            let distances = nearest[beside].iter().flatten().map(|[ahead, left]| ahead.hypot(*left));
            let (near, length) = (distances.fold(f32::INFINITY, f32::min), ahead.hypot(left));
            for nth in 0..PLACES_DEEP {
                let distance = near + MOVER_DEPTH_M * nth as f32 / (PLACES_DEEP - 1) as f32;
                let [ahead, left] = [ahead, left].map(|part| part * distance / length);
                places.push([moved.x + cos * ahead - sin * left, moved.y + sin * ahead + cos * left]);
            }
        }
        places
    }

    /// Where the mover in a column meets the floor: metres ahead and to the left of the camera.
    fn nearest(&self, rays: &[[f32; 3]], logits: &[f32], column: usize) -> Option<[f32; 2]> {
        let pixel = |row: usize| row * self.size.width + column;
        let is_mover = |row: usize| probability(logits[pixel(row)]) >= MOVER_PROBABILITY;
        let mut rows = (LEAST_PIXELS - 1..self.size.height).rev();
        let row = rows.find(|&row| (row + 1 - LEAST_PIXELS..=row).all(is_mover))?;
        // Where the mover ends and the floor begins.
        let below = rays[pixel((row + 1).min(self.size.height - 1))];
        let [ahead, left, up] = std::array::from_fn(|axis| 0.5 * (rays[pixel(row)][axis] + below[axis]));
        (up < 0.0).then(|| [ahead, left].map(|part| part * self.height_m / -up))
    }

    /// Whether the pixel or one beside it belongs to a mover: depths at its edge are between those of both sides.
    fn is_beside_mover(&self, logits: &[f32], pixel: usize) -> bool {
        let (row, column) = (pixel / self.size.width, pixel % self.size.width);
        let around = |middle: usize, end: usize| middle.saturating_sub(1)..(middle + 2).min(end);
        around(row, self.size.height).any(|row| {
            around(column, self.size.width)
                .any(|column| probability(logits[row * self.size.width + column]) >= MOVER_PROBABILITY)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frame::warp::CameraModel;

    const SIZE: ImageSize = ImageSize { height: 64, width: 64 };

    fn view() -> OccupancyView {
        let camera = CameraModel {
            horizontal_fov_rad: 1.05,
            tilt_down_rad: 0.2,
            height_m: Some(0.3),
        };
        OccupancyView {
            viewer: Viewer::new(camera, SIZE),
            size: SIZE,
            height_m: 0.3,
        }
    }

    /// Logits of a mover whose nearest side is a wall that stands on the floor, `left` to `left + 0.3` m, that far ahead.
    fn logits(view: &OccupancyView, ahead_m: f32, left_m: f32) -> Vec<f32> {
        let rays = view.viewer.rays();
        let is_mover = |[ahead, left, up]: &[f32; 3]| {
            let depth = ahead_m / ahead;
            (left_m..=left_m + 0.3).contains(&(left * depth)) && (0.0..=0.4).contains(&(up * depth + view.height_m))
        };
        rays.iter().map(|ray| if is_mover(ray) { 5.0 } else { -5.0 }).collect()
    }

    #[test]
    fn a_mover_stands_where_its_lowest_pixels_meet_the_floor() {
        let view = view();
        let places = view.movers(&logits(&view, 1.0, -0.1), [0.0; 3]);
        assert!(places.len() > 20);
        for [ahead, left] in &places {
            assert!((0.93..1.0 + MOVER_DEPTH_M + 0.07).contains(ahead), "{ahead}");
            assert!((-0.2..0.35).contains(left), "{left}");
        }
        // A camera that has driven and turned sees it elsewhere, but it is where it is.
        let places = view.movers(&logits(&view, 1.0, -0.1), [std::f32::consts::FRAC_PI_2, 0.5, 0.2]);
        for [ahead, left] in &places {
            assert!((0.1..0.75).contains(ahead), "{ahead}");
            assert!((1.1..1.6).contains(left), "{left}");
        }
    }

    #[test]
    fn points_of_movers_are_left_out() {
        let view = view();
        let depths = vec![1.0; SIZE.pixels()];
        assert_eq!(view.points(&depths, None).len(), SIZE.pixels());
        let logits = logits(&view, 1.0, -0.1);
        let movers = logits.iter().filter(|&&logit| logit > 0.0).count();
        let fixed = view.points(&depths, Some(&logits)).len();
        assert!(
            fixed < SIZE.pixels() - movers && fixed > SIZE.pixels() - 2 * movers,
            "{fixed}"
        );
        assert!(view.movers(&vec![-5.0; SIZE.pixels()], [0.0; 3]).is_empty());
    }
}
