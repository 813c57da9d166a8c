//! The simulated world of a data set's trial, as it was at one of its frames.

use super::EvaluationError;
use super::inference::Inference;
use super::windows::true_frame;
use foreframe_core::frame::preprocess::scale;
use foreframe_core::frame::quality;
use foreframe_core::types::Action;
use foreframe_data::dataset::{Dataset, Window};
use foreframe_sim::{World, WorldConfig};

/// A replayed frame that differs by more than this mean squared error is not the recorded one.
const REPLAY_TOLERANCE: f64 = 1e-4;

/// Replays the trial up to the last frame of a window's context. `None` if there is no trial, or the simulator no longer gives
/// the frame that was recorded. Errors: those of the simulator and the data set.
pub(super) fn replayed(
    inference: Inference,
    world: &WorldConfig,
    window: Window,
) -> Result<Option<World>, EvaluationError> {
    let dataset = inference.dataset;
    let episode = &dataset.episodes()[window.episode];
    let Some(trial) = &episode.trial else {
        return Ok(None);
    };
    let last = window.first_frame + inference.spec().context - 1;
    let recorded = true_frame(dataset, last)?;
    let mut replay = World::from_parameters(trial.clone(), world)?;
    for frame in episode.first_frame..last {
        replay.step(&action(dataset, frame)?)?;
    }
    let differs = quality::mse(&scale(replay.observe().frame.pixels()), &recorded) > REPLAY_TOLERANCE;
    Ok((!differs).then_some(replay))
}

/// The action that was carried out from a frame on.
pub(super) fn action(dataset: &Dataset, frame: usize) -> Result<Action, EvaluationError> {
    Action::try_from(dataset.action(frame).to_vec()).map_err(EvaluationError::Action)
}
