//! The moving object cut out of the last frame and moved on at constant velocity over the background: what a tracker
//! before a standing camera would predict. It never sees the true mask.

use super::input::mean;
use crate::evaluation::EvaluationError;
use foreframe_core::frame::preprocess::scale;
use foreframe_data::dataset::Dataset;
use foreframe_data::dataset::background::{Background, MAX_CHANGED_SHARE, differing};

/// Smaller objects are noise; share of the frame's pixels.
const MIN_OBJECT_SHARE: f32 = 0.002;
/// An object whose size or place changes by more than this from one frame to the next is another one: factor of its
/// pixels, share of the frame's width.
const MAX_GROWTH: f32 = 2.5;
const MAX_JUMP_SHARE: f32 = 0.3;

/// The largest connected group of pixels that differ from the background.
struct MovingObject {
    /// Its pixels and those next to them.
    mask: Vec<f32>,
    pixel_count: usize,
    /// Column and row of its middle.
    centre: [f32; 2],
}

/// The background of the training split.
pub(super) struct CutOut {
    background: Vec<f32>,
    width: usize,
}

impl CutOut {
    /// Takes the median of every pixel over these frames. Errors: those of [`Dataset::pixels`].
    pub(super) fn fit(dataset: &Dataset, frames: &[usize]) -> Result<Self, EvaluationError> {
        Ok(Self {
            background: scale(&Background::of(dataset, frames)?.pixels),
            width: dataset.info().frame_width_px as usize,
        })
    }

    pub(super) fn predict(&self, inputs: &[Vec<f32>], horizon: usize) -> Vec<Vec<f32>> {
        let Some(last) = inputs.last() else {
            return Vec::new();
        };
        let background = self.background_of(inputs, last);
        let Some(object) = MovingObject::find(last, &background, self.width) else {
            // Nothing stands out, so nothing moves: the mean of the inputs has the least noise.
            return vec![mean(inputs); horizon];
        };
        let [right, down] = self.velocity(inputs, &background, &object);
        let moved = |step: usize| [right * step as f32, down * step as f32];
        (1..=horizon)
            .map(|step| self.compose(&background, last, &object.mask, moved(step)))
            .collect()
    }

    /// The training split's background where it is what the camera looks at, else the median of the inputs.
    fn background_of(&self, inputs: &[Vec<f32>], last: &[f32]) -> Vec<f32> {
        let changed = differing(last, &self.background).filter(|&differs| differs).count();
        if changed as f32 <= MAX_CHANGED_SHARE * last.len() as f32 {
            return self.background.clone();
        }
        let median = |pixel: usize| {
            let mut values: Vec<f32> = inputs.iter().map(|frame| frame[pixel]).collect();
            values.sort_by(f32::total_cmp);
            values[values.len() / 2]
        };
        (0..last.len()).map(median).collect()
    }

    /// Pixels a frame to the right and down: the least-squares line through the object's centres, as far back as it is
    /// the same object.
    fn velocity(&self, inputs: &[Vec<f32>], background: &[f32], last: &MovingObject) -> [f32; 2] {
        let mut centres = vec![last.centre];
        let mut later = (last.pixel_count, last.centre);
        for frame in inputs.iter().rev().skip(1) {
            let Some(object) = MovingObject::find(frame, background, self.width) else {
                break;
            };
            let growth = object.pixel_count as f32 / later.0 as f32;
            let jump = (object.centre[0] - later.1[0]).hypot(object.centre[1] - later.1[1]);
            if !(1.0 / MAX_GROWTH..=MAX_GROWTH).contains(&growth) || jump > MAX_JUMP_SHARE * self.width as f32 {
                break;
            }
            centres.push(object.centre);
            later = (object.pixel_count, object.centre);
        }
        let middle = (centres.len() - 1) as f32 / 2.0;
        let (mut slope, mut spread) = ([0.0, 0.0], 0.0);
        for (back, centre) in centres.iter().enumerate() {
            let time = middle - back as f32;
            spread += time * time;
            slope[0] += time * centre[0];
            slope[1] += time * centre[1];
        }
        // With a single centre, spread and slope are 0.
        slope.map(|sum| if spread > 0.0 { sum / spread } else { sum })
    }

    /// The background with the object drawn where it has moved to.
    fn compose(&self, background: &[f32], last: &[f32], mask: &[f32], [right, down]: [f32; 2]) -> Vec<f32> {
        let width = self.width;
        let height = last.len() / width;
        let inside = |x: f32, y: f32| x >= 0.0 && y >= 0.0 && x < width as f32 && y < height as f32;
        background
            .iter()
            .enumerate()
            .map(|(pixel, &behind)| {
                let x = (pixel % width) as f32 - right;
                let y = (pixel / width) as f32 - down;
                let (left, top) = (x.floor(), y.floor());
                let (across, along) = (x - left, y - top);
                let (mut cover, mut colour) = (0.0, 0.0);
                for (row, row_share) in [(top, 1.0 - along), (top + 1.0, along)] {
                    for (column, column_share) in [(left, 1.0 - across), (left + 1.0, across)] {
                        let weight = row_share * column_share;
                        if weight > 0.0 && inside(column, row) {
                            let source = row as usize * width + column as usize;
                            cover += weight * mask[source];
                            colour += weight * mask[source] * last[source];
                        }
                    }
                }
                colour + (1.0 - cover) * behind
            })
            .collect()
    }
}

impl MovingObject {
    /// None if nothing of some size differs from the background.
    fn find(frame: &[f32], background: &[f32], width: usize) -> Option<Self> {
        let mut open: Vec<bool> = differing(frame, background).collect();
        let mut largest = Vec::new();
        for start in 0..open.len() {
            if open[start] {
                let group = take_group(&mut open, start, width);
                if group.len() > largest.len() {
                    largest = group;
                }
            }
        }
        let least = (MIN_OBJECT_SHARE * frame.len() as f32).max(2.0);
        if (largest.len() as f32) < least {
            return None;
        }
        let mean = |of: fn(usize, usize) -> usize| {
            let sum: f32 = largest.iter().map(|&pixel| of(pixel, width) as f32).sum();
            sum / largest.len() as f32
        };
        let mut mask = vec![0.0; frame.len()];
        for &pixel in &largest {
            mask[pixel] = 1.0;
            for next in neighbours(pixel, width, frame.len()) {
                mask[next] = 1.0;
            }
        }
        Some(Self {
            mask,
            pixel_count: largest.len(),
            centre: [mean(|pixel, width| pixel % width), mean(|pixel, width| pixel / width)],
        })
    }
}

/// Takes a pixel out of the open ones together with all open pixels that are connected with it.
fn take_group(open: &mut [bool], start: usize, width: usize) -> Vec<usize> {
    let mut group = vec![start];
    open[start] = false;
    let mut visited = 0;
    while let Some(&pixel) = group.get(visited) {
        visited += 1;
        for next in neighbours(pixel, width, open.len()) {
            if std::mem::take(&mut open[next]) {
                group.push(next);
            }
        }
    }
    group
}

/// The up to eight pixels around one.
fn neighbours(pixel: usize, width: usize, count: usize) -> impl Iterator<Item = usize> {
    let (column, row) = (pixel % width, pixel / width);
    let columns = column.saturating_sub(1)..(column + 2).min(width);
    let rows = row.saturating_sub(1)..(row + 2).min(count / width);
    rows.flat_map(move |row| columns.clone().map(move |column| row * width + column))
        .filter(move |&next| next != pixel)
}

#[cfg(test)]
mod tests {
    use super::*;

    const WIDTH: usize = 24;

    /// A dark square of 5 pixels a side before a ramp.
    fn scene(left: usize, top: usize) -> Vec<f32> {
        let inside = |i: usize| (left..left + 5).contains(&(i % WIDTH)) && (top..top + 5).contains(&(i / WIDTH));
        (0..WIDTH * 20)
            .map(|i| if inside(i) { 0.05 } else { ramp()[i] })
            .collect()
    }

    fn ramp() -> Vec<f32> {
        (0..WIDTH * 20).map(|i| 0.5 + 0.01 * (i % WIDTH) as f32).collect()
    }

    #[test]
    fn an_object_at_constant_velocity_is_predicted_exactly() {
        let cut_out = CutOut {
            background: ramp(),
            width: WIDTH,
        };
        let inputs: Vec<Vec<f32>> = (0..4).map(|time| scene(2 + 2 * time, 3 + time)).collect();
        for (step, predicted) in cut_out.predict(&inputs, 3).iter().enumerate() {
            let truth = scene(2 + 2 * (4 + step), 3 + 4 + step);
            // The pixels around the object bring a little of the old background along.
            let worst = predicted
                .iter()
                .zip(&truth)
                .map(|(a, b)| (a - b).abs())
                .fold(0.0, f32::max);
            assert!(worst < 0.1, "{worst}");
        }
    }

    #[test]
    fn the_largest_connected_group_is_the_object() {
        let mut frame = scene(10, 8);
        frame[0] = 0.0;
        let object = MovingObject::find(&frame, &ramp(), WIDTH).unwrap();
        assert_eq!((object.pixel_count, object.centre), (25, [12.0, 10.0]));
        assert!(MovingObject::find(&ramp(), &ramp(), WIDTH).is_none());
    }

    #[test]
    fn an_object_that_leaves_the_frame_leaves_the_background() {
        let cut_out = CutOut {
            background: ramp(),
            width: WIDTH,
        };
        let inputs: Vec<Vec<f32>> = [10, 14].map(|left| scene(left, 8)).to_vec();
        let gone = cut_out.predict(&inputs, 4).remove(3);
        assert!(gone.iter().zip(ramp()).all(|(a, b)| (a - b).abs() < 1e-6));
    }
}
