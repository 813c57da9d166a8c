//! The ranges that a model's specification must keep.

use crate::nn::error::NnError;

/// Largest width and height of a model's frames, in pixels.
pub const MAX_MODEL_SIDE_PX: u32 = 512;
/// Largest frame period, in seconds; the smallest is [`MIN_FRAME_PERIOD_S`].
pub const MAX_FRAME_PERIOD_S: f64 = 3600.0;
/// Smallest frame period, in seconds.
pub const MIN_FRAME_PERIOD_S: f64 = 1e-4;
/// Largest number of context frames, and of predicted frames.
pub const MAX_STEPS: usize = 256;
/// Largest number of features of a frame.
pub const MAX_FEATURES: usize = 4096;
/// Largest number of hidden units of an LSTM.
pub const MAX_HIDDEN: usize = 4096;
/// Largest number of components of an action, and of a state.
pub const MAX_CHANNELS: usize = 64;
/// Largest standard deviation of the smoothing, in pixels.
pub const MAX_BLUR_SIGMA_PX: f32 = 16.0;
/// Largest number of parameters of a model (1 GiB in f32).
pub const MAX_PARAMETERS: u64 = 1 << 28;

/// Errors: `OutOfRange` if the value is NaN or not in the range.
pub(in crate::nn) fn in_range(field: &'static str, value: f64, min: f64, max: f64) -> Result<(), NnError> {
    if (min..=max).contains(&value) {
        return Ok(());
    }
    Err(NnError::OutOfRange { field, value, min, max })
}
