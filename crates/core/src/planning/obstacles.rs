//! What stands in the way, from what the network sees and expects: seen from above, on a grid.

use std::collections::{BTreeMap, BTreeSet};

use crate::frame::warp::CameraModel;
use crate::nn::Occupancy;

/// Side of a cell, in metres.
const CELL_M: f32 = 0.05;
/// Points that make a cell an obstacle. One alone is more often an error of the depth.
const FEWEST_POINTS: usize = 2;
/// What is lower is floor, as far as the depth can tell, in metres.
const LOWEST_M: f32 = 0.12;
/// What is farther ahead does not matter within a plan, and its depth is least certain, in metres.
const FARTHEST_M: f32 = 4.0;
/// Places on the way from one step to the next at which the clearance is looked at.
const PLACES_A_STEP: usize = 2;

/// A cell of the grid.
type Cell = (i32, i32);

/// What a robot would touch: what stands, and where movers will be.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Obstacles {
    /// What stands: metres ahead and left.
    fixed_m: Vec<[f32; 2]>,
    /// Movers now, then after each step; those of the last step stay where they are. Empty if nothing is known of movers.
    movers_m: Vec<Vec<[f32; 2]>>,
}

impl Obstacles {
    /// From what a camera sees that is `camera_height_m` above the floor, as high as usual if that is not known. The robot
    /// passes under what is higher than `tallest_m`.
    #[must_use]
    pub fn new(occupancy: &Occupancy, camera_height_m: Option<f32>, tallest_m: f32) -> Self {
        let camera_height_m = camera_height_m.unwrap_or(CameraModel::USUAL_HEIGHT_M);
        let mut cells: BTreeMap<Cell, usize> = BTreeMap::new();
        for &[ahead, left, up] in &occupancy.points {
            let height = up + camera_height_m;
            if (LOWEST_M..=tallest_m).contains(&height)
                && let Some(cell) = cell_of([ahead, left])
            {
                *cells.entry(cell).or_default() += 1;
            }
        }
        let fixed = cells.into_iter().filter(|(_, points)| *points >= FEWEST_POINTS);
        let movers = occupancy.movers.iter().map(|places| {
            let cells: BTreeSet<Cell> = places.iter().copied().filter_map(cell_of).collect();
            cells.into_iter().map(middle_of).collect()
        });
        Self {
            fixed_m: fixed.map(|(cell, _)| middle_of(cell)).collect(),
            movers_m: movers.collect(),
        }
    }

    /// The same, as if movers stayed where they are now.
    #[must_use]
    pub fn as_now(mut self) -> Self {
        self.movers_m.truncate(1);
        self
    }

    /// Where something stands: metres ahead and to the left.
    #[must_use]
    pub fn fixed_m(&self) -> &[[f32; 2]] {
        &self.fixed_m
    }

    /// Where movers are now, then after each step. Empty if nothing is known of movers.
    #[must_use]
    pub fn movers_m(&self) -> &[Vec<[f32; 2]>] {
        &self.movers_m
    }

    /// The distance from a round robot of that radius, which stands there after that many steps, to the nearest obstacle, in
    /// metres; below 0 inside one. Infinite if nothing is seen.
    #[must_use]
    pub fn clearance_m(&self, place: [f32; 2], steps: usize, radius_m: f32) -> f32 {
        let squared = |other: &[f32; 2]| (other[0] - place[0]).powi(2) + (other[1] - place[1]).powi(2);
        let movers = self.movers_m.get(steps).or(self.movers_m.last());
        let all = self.fixed_m.iter().chain(movers.into_iter().flatten());
        let nearest = all.map(squared).fold(f32::INFINITY, f32::min);
        nearest.sqrt() - radius_m
    }

    /// The least clearance on a way: yaw, ahead and left after each step.
    #[must_use]
    pub fn least_clearance_m(&self, way: &[[f32; 3]], radius_m: f32) -> f32 {
        let mut least = f32::INFINITY;
        let mut from = [0.0; 2];
        for (&[_, ahead, left], steps) in way.iter().zip(1..) {
            for nth in 1..=PLACES_A_STEP {
                let share = nth as f32 / PLACES_A_STEP as f32;
                let place = [from[0] + share * (ahead - from[0]), from[1] + share * (left - from[1])];
                least = least.min(self.clearance_m(place, steps, radius_m));
            }
            from = [ahead, left];
        }
        least
    }
}

/// The cell of a place; `None` if it is too far away to matter.
fn cell_of([ahead, left]: [f32; 2]) -> Option<Cell> {
    let cell = |metres: f32| (metres / CELL_M).floor() as i32;
    (ahead.hypot(left) <= FARTHEST_M).then(|| (cell(ahead), cell(left)))
}

fn middle_of((ahead, left): Cell) -> [f32; 2] {
    [ahead, left].map(|cell| (cell as f32 + 0.5) * CELL_M)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_wall_ahead_is_as_near_as_it_is() {
        let wall = (-20..20).flat_map(|left| [[1.0, left as f32 * 0.05, -0.2]; 3]);
        let floor = (0..20).flat_map(|ahead| [[ahead as f32 * 0.1, 0.0, -0.5]; 3]);
        let lamp = [[0.3, 0.0, 0.8]; 3];
        let seen = Occupancy {
            points: wall.chain(floor).chain(lamp).collect(),
            ..Occupancy::default()
        };
        let obstacles = Obstacles::new(&seen, Some(0.5), 0.6);
        assert!((obstacles.clearance_m([0.0, 0.0], 0, 0.2) - 0.825).abs() < 0.03);
        let way = [[0.0, 0.2, 0.0], [0.0, 0.9, 0.0], [0.0, 0.5, 0.0]];
        assert!(obstacles.least_clearance_m(&way, 0.2) < 0.0);
        // The way leads through the wall and back between two steps.
        let through = [[0.0, 1.9, 0.0]];
        assert!(obstacles.least_clearance_m(&through, 0.2) < 0.0);
        assert_eq!(Obstacles::default().clearance_m([0.0, 0.0], 0, 0.2), f32::INFINITY);
    }

    #[test]
    fn a_mover_is_in_the_way_only_while_it_is_there() {
        let seen = Occupancy {
            movers: vec![vec![[1.0, -0.5]], vec![[1.0, 0.0]], vec![[1.0, 0.5]]],
            ..Occupancy::default()
        };
        let obstacles = Obstacles::new(&seen, None, 0.6);
        let ahead = |metres: f32| [0.0, metres, 0.0];
        assert!(obstacles.least_clearance_m(&[ahead(0.9), ahead(1.0)], 0.2) < 0.0);
        assert!(obstacles.least_clearance_m(&[ahead(0.5), ahead(1.0)], 0.2) > 0.15);
        // Later than what is predicted, it stays where it was last.
        assert!(obstacles.clearance_m([1.0, 0.5], 7, 0.2) < 0.0);
        let now = obstacles.as_now();
        assert!(now.clearance_m([1.0, -0.5], 7, 0.2) < 0.0);
        assert!(now.clearance_m([1.0, 0.5], 2, 0.2) > 0.5);
    }
}
