//! What a baseline may look at.

use foreframe_core::frame::warp::CameraModel;
use foreframe_data::dataset::sampler::WindowShape;
use foreframe_data::dataset::{Dataset, Window};

/// What a baseline may look at. Frames hold intensities 0…1 in the camera's space.
#[derive(Default)]
pub(in crate::evaluation) struct BaselineInput<'a> {
    /// The input frames, oldest first; at least one.
    pub(super) inputs: &'a [Vec<f32>],
    /// The action that led to the last input frame; the first of `actions` where only one frame is known.
    pub(super) previous_action: &'a [f32],
    /// The actions that lead to each predicted frame.
    pub(super) actions: Vec<&'a [f32]>,
    /// The state at the last input frame.
    pub(super) state: &'a [f32],
    /// The states at the input frames before the last one, oldest first.
    pub(super) past_states: Vec<&'a [f32]>,
    /// The camera that took the frames; none where it is not known.
    pub(super) camera: Option<CameraModel>,
}

impl<'a> BaselineInput<'a> {
    /// The input of a window of that shape, whose first frames are `inputs`.
    pub(in crate::evaluation) fn of_window(
        dataset: &'a Dataset,
        window: Window,
        shape: WindowShape,
        inputs: &'a [Vec<f32>],
    ) -> Self {
        let last = window.first_frame + shape.context - 1;
        Self {
            inputs,
            previous_action: dataset.action(last.saturating_sub(1).max(window.first_frame)),
            actions: (last..last + shape.horizon)
                .map(|frame| dataset.action(frame))
                .collect(),
            state: dataset.state(last),
            past_states: (window.first_frame..last).map(|frame| dataset.state(frame)).collect(),
            camera: dataset.camera(window.episode),
        }
    }
}

/// The mean of the frames, pixel by pixel.
pub(super) fn mean(frames: &[Vec<f32>]) -> Vec<f32> {
    let mut sum = vec![0.0; frames.first().map_or(0, Vec::len)];
    for frame in frames {
        for (sum, value) in sum.iter_mut().zip(frame) {
            *sum += value;
        }
    }
    for value in &mut sum {
        *value /= frames.len() as f32;
    }
    sum
}
