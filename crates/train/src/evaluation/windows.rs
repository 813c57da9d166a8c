//! Which windows are looked at.

use foreframe_core::nn::ModelSpec;
use foreframe_data::dataset::Window;
use foreframe_data::dataset::sampler::WindowShape;

/// At most `count` of the windows, evenly spread over all.
#[must_use]
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
