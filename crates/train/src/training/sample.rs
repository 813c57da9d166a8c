//! A picture that shows how a training gets on: the true frames of a window above the predicted ones.

use super::TrainError;
use foreframe_core::frame::{Frame, quality};
use foreframe_data::dataset::sampler::WindowShape;
use foreframe_data::dataset::{Dataset, Window};

/// White between the frames, in pixels.
const GAP_PX: usize = 2;
/// Among how many windows the one is chosen.
const CANDIDATES: usize = 16;

/// Of some of the windows, the one in which the picture changes most: where nothing moves, every model is right. Errors: those of
/// the data set.
pub(super) fn liveliest<'a>(
    dataset: &Dataset,
    windows: &'a [Window],
    shape: WindowShape,
) -> Result<Option<&'a Window>, TrainError> {
    let stride = windows.len().div_ceil(CANDIDATES).max(1);
    let mut most = None;
    for window in windows.iter().step_by(stride) {
        let seen = dataset.frame(window.first_frame + shape.context - 1)?;
        let last = dataset.frame(window.first_frame + shape.frames() - 1)?;
        let change = quality::mse(&intensities(&seen), &intensities(&last));
        if most.is_none_or(|(most, _)| change > most) {
            most = Some((change, window));
        }
    }
    Ok(most.map(|(_, window)| window))
}

fn intensities(frame: &Frame) -> Vec<f32> {
    frame.pixels().iter().map(|&pixel| f32::from(pixel) / 255.0).collect()
}

/// The frames in two rows, one column for each step. Errors: `Frame` if the picture gets too large.
pub(super) fn side_by_side(truth: &[Frame], predicted: &[Frame]) -> Result<Option<Frame>, TrainError> {
    let Some(first) = truth.first() else { return Ok(None) };
    let (width, height) = (first.width() as usize, first.height() as usize);
    let columns = truth.len().max(predicted.len());
    let (all_width, all_height) = (columns * (width + GAP_PX) - GAP_PX, 2 * height + GAP_PX);
    let mut pixels = vec![u8::MAX; all_width * all_height];
    for (row, frames) in [truth, predicted].into_iter().enumerate() {
        for (column, frame) in frames.iter().enumerate() {
            let corner = row * (height + GAP_PX) * all_width + column * (width + GAP_PX);
            for (line, values) in frame.pixels().chunks_exact(width).enumerate() {
                let start = corner + line * all_width;
                pixels[start..start + width].copy_from_slice(values);
            }
        }
    }
    Ok(Some(Frame::new(all_width as u32, all_height as u32, pixels)?))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn true_frames_stand_above_predicted_ones() {
        let frame = |level| Frame::new(2, 1, vec![level; 2]).unwrap();
        let picture = side_by_side(&[frame(1), frame(2)], &[frame(3), frame(4)])
            .unwrap()
            .unwrap();
        let white = [255; 6];
        let expected = [&[1, 1, 255, 255, 2, 2][..], &white, &white, &[3, 3, 255, 255, 4, 4]].concat();
        assert_eq!(
            (picture.width(), picture.height(), picture.pixels()),
            (6, 4, &expected[..])
        );
        assert!(side_by_side(&[], &[]).unwrap().is_none());
    }
}
