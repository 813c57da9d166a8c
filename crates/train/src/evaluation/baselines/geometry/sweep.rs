//! Plane sweep: the distance of the wall in each column of the last frame, from how well each distance explains the earlier
//! frames under the known past motion.

use foreframe_core::frame::warp::sample;
use foreframe_sim::PlanarPose;

use super::floor_view::FloorView;
use super::{WALL_RATIO, WALLS, walls_m as candidates_m};
use crate::evaluation::baselines::commanded_motion::ORIGIN;

/// A larger difference between two frames counts as this large, so that movers and what is hidden count little.
const MAX_DIFFERENCE: f32 = 0.1;
/// Columns to each side whose costs count too.
const REACH: usize = 3;
/// What a step to the next distance between neighbouring columns costs, as a mean difference of pixels.
const STEP_COST: f32 = 0.002;
/// What a step away from the usual distance costs: only so much that it decides where the frames say nothing.
const UNUSUAL_COST: f32 = 1e-5;

/// A frame before the last one.
pub(super) struct EarlierFrame<'a> {
    pub(super) values: &'a [f32],
    /// The pose of its camera, in the axes of the last frame.
    pub(super) pose: PlanarPose,
}

/// What each distance of the wall costs in a column.
type ColumnCosts = [f32; WALLS];

/// The distance of the wall in each column of the last frame. Where the frames do not say, it is the usual one.
pub(super) fn walls_m(view: &FloorView, last: &[f32], earlier: &[EarlierFrame], usual_m: f32) -> Vec<f32> {
    let candidates = candidates_m();
    let costs = pooled(&costs(view, last, earlier));
    let steps_off = candidates.map(|wall_m| (wall_m / usual_m).ln().abs() / WALL_RATIO.ln());
    let costs: Vec<ColumnCosts> = costs
        .iter()
        .map(|column| std::array::from_fn(|wall| column[wall] + UNUSUAL_COST * steps_off[wall]))
        .collect();
    cheapest_path(&costs).into_iter().map(|wall| candidates[wall]).collect()
}

/// The mean difference to the earlier frames in each column, for each distance, without what is the same for all distances.
fn costs(view: &FloorView, last: &[f32], earlier: &[EarlierFrame]) -> Vec<ColumnCosts> {
    let mut costs = vec![[0.0; WALLS]; view.width()];
    // From the same place, a frame shows the same for every distance.
    let elsewhere: Vec<&EarlierFrame> = earlier.iter().filter(|frame| frame.pose != ORIGIN).collect();
    for (wall, wall_m) in candidates_m().into_iter().enumerate() {
        let mut sums = vec![0.0; view.width()];
        for frame in &elsewhere {
            let places = view.places_at(frame.pose, wall_m);
            let (seen, inside) = sample(frame.values, view.width(), view.height(), &places);
            let pixels = seen.iter().zip(&inside).zip(last);
            for (pixel, ((seen, inside), now)) in pixels.enumerate() {
                let difference = if *inside {
                    (seen - now).abs().min(MAX_DIFFERENCE)
                } else {
                    0.0
                };
                sums[pixel % view.width()] += difference;
            }
        }
        let count = (view.height() * earlier.len().max(1)) as f32;
        for (column, sum) in costs.iter_mut().zip(sums) {
            column[wall] = sum / count;
        }
    }
    costs
}

/// The mean over neighbouring columns.
fn pooled(costs: &[ColumnCosts]) -> Vec<ColumnCosts> {
    let columns = 0..costs.len();
    columns
        .map(|column| {
            let near = &costs[column.saturating_sub(REACH)..(column + REACH + 1).min(costs.len())];
            std::array::from_fn(|wall| near.iter().map(|costs| costs[wall]).sum::<f32>() / near.len() as f32)
        })
        .collect()
}

/// One distance for each column so that the sum of costs and steps is least, by dynamic programming.
fn cheapest_path(costs: &[ColumnCosts]) -> Vec<usize> {
    let mut totals: ColumnCosts = [0.0; WALLS];
    let mut came_from: Vec<[usize; WALLS]> = Vec::with_capacity(costs.len());
    for column in costs {
        let from: [usize; WALLS] = std::array::from_fn(|wall| {
            let total = |other: usize| totals[other] + STEP_COST * wall.abs_diff(other) as f32;
            cheapest((0..WALLS).map(total))
        });
        totals = std::array::from_fn(|wall| {
            totals[from[wall]] + STEP_COST * wall.abs_diff(from[wall]) as f32 + column[wall]
        });
        came_from.push(from);
    }
    // Backwards from the cheapest end.
    let mut path = Vec::with_capacity(costs.len());
    let mut wall = cheapest(totals.into_iter());
    for from in came_from.iter().rev() {
        path.push(wall);
        wall = from[wall];
    }
    path.reverse();
    path
}

/// The place of the least value.
fn cheapest(values: impl Iterator<Item = f32>) -> usize {
    let least = values.enumerate().min_by(|one, other| one.1.total_cmp(&other.1));
    least.map_or(0, |(place, _)| place)
}

#[cfg(test)]
mod tests {
    use super::*;
    use foreframe_core::frame::warp::CameraModel;

    const SIDE: usize = 32;
    const USUAL_M: f32 = 3.0;

    fn view() -> FloorView {
        let camera = CameraModel {
            horizontal_fov_rad: 1.2,
            tilt_down_rad: 0.0,
            height_m: Some(0.5),
        };
        FloorView::new(camera, SIDE, SIDE).unwrap()
    }

    fn last() -> Vec<f32> {
        let pixel = |index: usize| {
            let (column, row) = ((index % SIDE) as f32, (index / SIDE) as f32);
            0.5 + 0.2 * (column * 0.9).sin() + 0.2 * (row * 0.7 + column * 0.3).cos()
        };
        (0..SIDE * SIDE).map(pixel).collect()
    }

    #[test]
    fn the_distance_that_explains_an_earlier_frame_is_found() {
        let (view, last) = (view(), last());
        let pose = PlanarPose {
            x_m: -0.3,
            y_m: 0.0,
            heading_rad: 0.1,
        };
        let wall_m = candidates_m()[6];
        let (values, _) = sample(&last, SIDE, SIDE, &view.places_in_last(pose, &[wall_m; SIDE]));
        let earlier = [EarlierFrame { values: &values, pose }];
        let found = walls_m(&view, &last, &earlier, USUAL_M);
        let near = found.iter().filter(|&&found| (found / wall_m).ln().abs() < 0.01);
        assert!(near.count() > SIDE * 3 / 4, "{found:?} {wall_m}");
    }

    #[test]
    fn a_camera_that_stood_still_says_nothing() {
        let last = last();
        let still = EarlierFrame {
            values: &last,
            pose: PlanarPose {
                x_m: 0.0,
                y_m: 0.0,
                heading_rad: 0.0,
            },
        };
        for earlier in [vec![], vec![still]] {
            let found = walls_m(&view(), &last, &earlier, USUAL_M);
            let steps = found.iter().map(|found| (found / USUAL_M).ln().abs());
            assert!(steps.fold(0.0, f32::max) < WALL_RATIO.ln(), "{found:?}");
        }
    }

    #[test]
    fn a_column_that_differs_a_little_follows_its_neighbours() {
        let mut costs = vec![[0.1; WALLS]; 5];
        for column in &mut costs {
            column[4] = 0.05;
        }
        costs[2][9] = 0.049;
        assert_eq!(cheapest_path(&costs), [4; 5]);
        costs[2][9] = 0.0;
        assert_eq!(cheapest_path(&costs)[2], 9);
    }
}
