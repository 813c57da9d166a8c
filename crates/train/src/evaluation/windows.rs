//! Which windows are looked at, and their true frames.

use foreframe_core::frame::preprocess::scale;
use foreframe_core::nn::ModelSpec;
use foreframe_data::dataset::sampler::WindowShape;
use foreframe_data::dataset::{Dataset, DatasetError, Window};

/// At most `count` of the windows, evenly spread over all.
pub(super) fn evenly(windows: &[Window], count: usize) -> Vec<Window> {
    if windows.len() <= count {
        return windows.to_vec();
    }
    (0..count).map(|i| windows[i * windows.len() / count]).collect()
}

/// The windows that a model of that specification takes.
pub(super) fn window_shape(spec: &ModelSpec) -> WindowShape {
    WindowShape {
        context: spec.context,
        horizon: spec.horizon,
    }
}

/// A frame of the data set as the camera saw it, intensities 0…1.
pub(super) fn true_frame(dataset: &Dataset, frame: usize) -> Result<Vec<f32>, DatasetError> {
    Ok(scale(&dataset.pixels(frame)?))
}
