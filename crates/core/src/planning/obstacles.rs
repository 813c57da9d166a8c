//! What stands in the way, from the depth that the network sees: seen from above, on a grid.

use std::collections::BTreeMap;

use crate::frame::warp::CameraModel;

/// Side of a cell, in metres.
const CELL_M: f32 = 0.05;
/// Points that make a cell an obstacle. One alone is more often an error of the depth.
const FEWEST_POINTS: usize = 2;
/// What is lower is floor, as far as the depth can tell, in metres.
const LOWEST_M: f32 = 0.12;
/// What is farther ahead does not matter within a plan, and its depth is least certain, in metres.
const FARTHEST_M: f32 = 4.0;

/// Where the last frame shows something that a robot would touch.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Obstacles {
    /// Ahead and left, in metres.
    places_m: Vec<[f32; 2]>,
}

impl Obstacles {
    /// From points ahead, left and up of a camera that is `camera_height_m` above the floor, as high as usual if that is not known.
    /// The robot passes under what is higher than `tallest_m`.
    #[must_use]
    pub fn new(points: &[[f32; 3]], camera_height_m: Option<f32>, tallest_m: f32) -> Self {
        let camera_height_m = camera_height_m.unwrap_or(CameraModel::USUAL_HEIGHT_M);
        let mut cells: BTreeMap<(i32, i32), usize> = BTreeMap::new();
        for [ahead, left, up] in points {
            let height = up + camera_height_m;
            if (LOWEST_M..=tallest_m).contains(&height) && ahead.hypot(*left) <= FARTHEST_M {
                let cell = |metres: f32| (metres / CELL_M).floor() as i32;
                *cells.entry((cell(*ahead), cell(*left))).or_default() += 1;
            }
        }
        let middle = |cell: i32| (cell as f32 + 0.5) * CELL_M;
        let places = cells.into_iter().filter(|(_, points)| *points >= FEWEST_POINTS);
        Self {
            places_m: places.map(|((ahead, left), _)| [middle(ahead), middle(left)]).collect(),
        }
    }

    /// Where they are: metres ahead and to the left.
    #[must_use]
    pub fn places_m(&self) -> &[[f32; 2]] {
        &self.places_m
    }

    /// The distance from a round robot of that radius to the nearest obstacle, in metres; below 0 inside one. Infinite if
    /// nothing is seen.
    #[must_use]
    pub fn clearance_m(&self, [ahead, left]: [f32; 2], radius_m: f32) -> f32 {
        let squared = |place: &[f32; 2]| (place[0] - ahead).powi(2) + (place[1] - left).powi(2);
        let nearest = self.places_m.iter().map(squared).fold(f32::INFINITY, f32::min);
        nearest.sqrt() - radius_m
    }

    /// The least clearance on a way: yaw, ahead and left after each step.
    #[must_use]
    pub fn least_clearance_m(&self, way: &[[f32; 3]], radius_m: f32) -> f32 {
        let clearance = |[_, ahead, left]: &[f32; 3]| self.clearance_m([*ahead, *left], radius_m);
        way.iter().map(clearance).fold(f32::INFINITY, f32::min)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_wall_ahead_is_as_near_as_it_is() {
        let wall = (-20..20).flat_map(|left| [[1.0, left as f32 * 0.05, -0.2]; 3]);
        let floor = (0..20).flat_map(|ahead| [[ahead as f32 * 0.1, 0.0, -0.5]; 3]);
        let lamp = [[0.3, 0.0, 0.8]; 3];
        let points: Vec<[f32; 3]> = wall.chain(floor).chain(lamp).collect();
        let obstacles = Obstacles::new(&points, Some(0.5), 0.6);
        assert!((obstacles.clearance_m([0.0, 0.0], 0.2) - 0.825).abs() < 0.03);
        let way = [[0.0, 0.2, 0.0], [0.0, 0.9, 0.0], [0.0, 0.5, 0.0]];
        assert!(obstacles.least_clearance_m(&way, 0.2) < 0.0);
        assert_eq!(Obstacles::default().clearance_m([0.0, 0.0], 0.2), f32::INFINITY);
    }
}
