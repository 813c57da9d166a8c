//! What is said about the predicted frames: which errors to expect, how unlike the training data the context is, and the
//! actual errors where the true frames are there.

use crate::cli::error::CliError;
use crate::cli::process::print_line;
use foreframe_core::frame::Frame;
use foreframe_core::frame::preprocess::scale;
use foreframe_core::frame::quality;
use foreframe_core::registry::calibration::{ExpectedError, NOVELTY_LIMIT};
use foreframe_core::serving::Rollout;

/// Prints it. `truth` has the true frames after the context, as many as there are; `horizon` is the model's own.
pub(super) fn print_trust(rollout: &Rollout, truth: &[Frame], horizon: usize) -> Result<(), CliError> {
    if let Some(novelty) = rollout.novelty {
        print_line(novelty_line(novelty))?;
    }
    let actual = actual_errors(&rollout.frames, truth);
    let expected = expected_errors(rollout);
    for step in 0..actual.len().max(expected.len()) {
        print_line(step_line(step + 1, expected.get(step), actual.get(step)))?;
    }
    if rollout.frames.len() > horizon {
        print_line(format!(
            "from t+{} on, the frames are beyond what the model was trained for",
            horizon + 1
        ))?;
    }
    Ok(())
}

fn novelty_line(novelty: f32) -> String {
    let percent = novelty * 100.0;
    if novelty < NOVELTY_LIMIT {
        return format!(
            "novelty {novelty:.2}: {percent:.0} % of the validation contexts are more like the training data"
        );
    }
    format!(
        "warning: novelty {novelty:.2}: the frames, the state or the actions are unlike the training data ({percent:.0} % of the \
         validation contexts are more like it), so no expected errors are given; check the state's origin and units, or train a \
         model on frames of this camera"
    )
}

/// The expected errors; none if the context is too novel for them.
fn expected_errors(rollout: &Rollout) -> &[ExpectedError] {
    match rollout.novelty {
        Some(novelty) if novelty >= NOVELTY_LIMIT => &[],
        _ => &rollout.errors,
    }
}

/// The mean squared error of each predicted frame whose true frame is there, intensities 0…1.
fn actual_errors(predicted: &[Frame], truth: &[Frame]) -> Vec<f64> {
    let both = predicted.iter().zip(truth);
    both.map(|(predicted, truth)| quality::mse(&scale(predicted.pixels()), &scale(truth.pixels())))
        .collect()
}

fn step_line(step: usize, expected: Option<&ExpectedError>, actual: Option<&f64>) -> String {
    let expected = expected.map(|error| {
        format!(
            "expected MSE {:.5}, 90 % between {:.5} and {:.5}",
            error.mse, error.low, error.high
        )
    });
    let actual = actual.map(|mse| format!("actual MSE {mse:.5}"));
    let parts: Vec<String> = expected.into_iter().chain(actual).collect();
    format!("t+{step}: {}", parts.join("; "))
}
