//! What stands around a robot, and where movers will be: from the depth of the last frame, and from where movers are seen and
//! expected. A mover stands on the floor, so its lowest pixels tell how far away it is.

use crate::nn::geometry::camera::{CameraPose, Viewer};
use crate::nn::ops::sampling::ImageSize;

/// A pixel whose logit is above this belongs to a mover: it is more likely than not.
const MOVER_LOGIT: f32 = 0.0;
/// Pixels of a column, one above the other, that make a mover. One alone is more often an error.
const LEAST_PIXELS: usize = 2;
/// A mover whose feet are below the picture stands at this share of the distance at which the camera sees the floor, if no
/// depth tells.
const CUT_OFF_SHARE: f32 = 0.6;
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
    /// The points of all pixels with these depths that do not belong to a mover whose place is known. `movers`: the pixels' logits.
    pub(super) fn points(&self, depths: &[f32], movers: Option<&[f32]>) -> Vec<[f32; 3]> {
        let rays = self.viewer.rays();
        let has_place: Vec<bool> = match movers {
            Some(logits) => (0..self.size.width)
                .map(|column| self.nearest(&rays, logits, column, None).is_some())
                .collect(),
            None => vec![false; self.size.width],
        };
        let is_mover = |row: usize, column: usize| {
            has_place[column] && movers.is_some_and(|logits| logits[row * self.size.width + column] > MOVER_LOGIT)
        };
        // Depths at the edge of a mover are between those of both sides.
        let is_beside_mover = |pixel: usize| {
            let (row, column) = (pixel / self.size.width, pixel % self.size.width);
            let around = |middle: usize, end: usize| middle.saturating_sub(1)..(middle + 2).min(end);
            around(row, self.size.height).any(|row| around(column, self.size.width).any(|column| is_mover(row, column)))
        };
        let points = rays.into_iter().zip(depths).enumerate();
        points
            .filter(|&(pixel, _)| !is_beside_mover(pixel))
            .map(|(_, (ray, depth))| ray.map(|part| part * depth))
            .collect()
    }

    /// The places where movers stand, seen by a camera that has moved by yaw, ahead and left; in the axes before. `depths`: of the
    /// pixels, where they are known.
    pub(super) fn movers(&self, logits: &[f32], motion: [f32; 3], depths: Option<&[f32]>) -> Vec<[f32; 2]> {
        let rays = self.viewer.rays();
        let moved = CameraPose::default().moved(motion);
        let (sin, cos) = moved.heading.sin_cos();
        let nearest: Vec<Option<[f32; 2]>> = (0..self.size.width)
            .map(|column| self.nearest(&rays, logits, column, depths))
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
    fn nearest(&self, rays: &[[f32; 3]], logits: &[f32], column: usize, depths: Option<&[f32]>) -> Option<[f32; 2]> {
        let pixel = |row: usize| row * self.size.width + column;
        let is_mover = |row: usize| logits[pixel(row)] > MOVER_LOGIT;
        let mut rows = (LEAST_PIXELS - 1..self.size.height).rev();
        let row = rows.find(|&row| (row + 1 - LEAST_PIXELS..=row).all(is_mover))?;
        // Where the mover ends and the floor begins.
        let below = rays[pixel((row + 1).min(self.size.height - 1))];
        let ray: [f32; 3] = std::array::from_fn(|axis| 0.5 * (rays[pixel(row)][axis] + below[axis]));
        let [ahead, left, up] = ray;
        if up >= 0.0 {
            return None;
        }
        let mut depth = self.height_m / -up;
        if row + 1 == self.size.height {
            // It stands nearer than the camera sees the floor.
            depth = match depths {
                Some(depths) => depth.min(depths[pixel(row)]),
                None => depth * CUT_OFF_SHARE,
            };
        }
        Some([ahead, left].map(|part| part * depth))
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
        let places = view.movers(&logits(&view, 1.0, -0.1), [0.0; 3], None);
        assert!(places.len() > 20);
        for [ahead, left] in &places {
            assert!((0.93..1.0 + MOVER_DEPTH_M + 0.07).contains(ahead), "{ahead}");
            assert!((-0.2..0.35).contains(left), "{left}");
        }
        // A camera that has driven and turned sees it elsewhere, but it is where it is.
        let places = view.movers(&logits(&view, 1.0, -0.1), [std::f32::consts::FRAC_PI_2, 0.5, 0.2], None);
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
        assert!(view.movers(&vec![-5.0; SIZE.pixels()], [0.0; 3], None).is_empty());
        // One false pixel is no mover, and takes no points away.
        let mut lone = vec![-5.0; SIZE.pixels()];
        lone[40 * SIZE.width + 20] = 5.0;
        assert_eq!(view.points(&depths, Some(&lone)).len(), SIZE.pixels());
    }

    #[test]
    fn a_mover_whose_feet_are_below_the_picture_is_near() {
        let view = view();
        let near = logits(&view, 0.25, -0.1);
        assert!(near[63 * SIZE.width + 32] > 0.0, "it reaches the lower edge");
        let least = |places: Vec<[f32; 2]>| places.iter().map(|place| place[0]).fold(f32::INFINITY, f32::min);
        assert!(least(view.movers(&near, [0.0; 3], None)) < 0.3);
        let depths = vec![0.2; SIZE.pixels()];
        assert!(least(view.movers(&near, [0.0; 3], Some(&depths))) < 0.26);
    }
}
