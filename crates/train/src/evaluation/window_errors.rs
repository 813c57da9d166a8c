//! How well single windows are predicted, without a report: to estimate a camera and to compare a model before and after.

use std::sync::atomic::{AtomicBool, Ordering};

use super::EvaluationError;
use super::inference::{ActionSource, Inference};
use super::windows::{true_frame, window_shape};
use foreframe_core::frame::quality;
use foreframe_core::registry::Model;
use foreframe_data::dataset::sampler::{Split, Splits};
use foreframe_data::dataset::{Dataset, DatasetError, Window};

/// Windows that are predicted together.
const TOGETHER: usize = 16;

/// The windows of a split that the model can predict, in order; none if no segment is long enough.
/// Errors: those of [`Splits::windows`].
pub fn windows_of(loaded: &Model, dataset: &Dataset, split: Split) -> Result<Vec<Window>, EvaluationError> {
    let shape = window_shape(loaded.spec());
    let splits = Splits::new(dataset, loaded.manifest.dataset.split_seed);
    match splits.windows(dataset, split, shape, 1) {
        Err(DatasetError::WindowTooLong { .. }) => Ok(Vec::new()),
        windows => Ok(windows?),
    }
}

/// The mean squared error of each window's first `steps` predicted frames, intensities 0…1. Errors: `Cancelled`, those of the network and
/// of [`Dataset::pixels`].
pub fn window_errors(
    loaded: &Model,
    dataset: &Dataset,
    windows: &[Window],
    steps: usize,
    cancelled: &AtomicBool,
) -> Result<Vec<f64>, EvaluationError> {
    let inference = Inference { loaded, dataset };
    let each = loaded.spec().horizon * loaded.spec().pixels();
    let mut errors = Vec::with_capacity(windows.len());
    for windows in windows.chunks(TOGETHER) {
        if cancelled.load(Ordering::Acquire) {
            return Err(EvaluationError::Cancelled);
        }
        let predicted = inference.predict(windows, ActionSource::Recorded)?;
        for (&window, frames) in windows.iter().zip(predicted.frames.chunks_exact(each)) {
            let all = inference.step_errors(window, frames)?;
            errors.push(all.iter().take(steps).sum::<f64>() / steps as f64);
        }
    }
    Ok(errors)
}

/// The same of the last frame as the prediction of all that follow. Errors: those of [`Dataset::pixels`].
pub fn copied_errors(loaded: &Model, dataset: &Dataset, windows: &[Window]) -> Result<Vec<f64>, EvaluationError> {
    let (context, horizon) = (loaded.spec().context, loaded.spec().horizon);
    let of_window = |window: &Window| -> Result<f64, EvaluationError> {
        let first = window.first_frame + context;
        let last = true_frame(dataset, first - 1)?;
        let mut sum = 0.0;
        for frame in first..first + horizon {
            sum += quality::mse(&last, &true_frame(dataset, frame)?);
        }
        Ok(sum / horizon as f64)
    };
    windows.iter().map(of_window).collect()
}
