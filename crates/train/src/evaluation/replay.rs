//! The simulated world of a data set's trial, as it was at its frames.

use super::EvaluationError;
use super::inference::Inference;
use super::windows::true_frame;
use foreframe_core::frame::preprocess::scale;
use foreframe_core::frame::{Frame, quality};
use foreframe_core::nn::ModelSpec;
use foreframe_core::types::Action;
use foreframe_data::dataset::{Dataset, DatasetInfo, Window};
use foreframe_sim::camera::Camera;
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
    let last = window.first_frame + inference.spec().context - 1;
    replayed_to(inference.dataset, world, window.episode, last)
}

/// What one frame of a trial shows.
pub(super) struct ReplayedView {
    pub(super) camera: Camera,
    /// How far away what each pixel shows is, along the camera's axis, in metres.
    pub(super) depths_m: Vec<f32>,
    /// The id of the robot that each pixel shows; 0 for the rest.
    pub(super) robots: Vec<u8>,
}

/// What all frames of a window show, `frames` in number. `None` and errors: as [`replayed`].
pub(super) fn replayed_views(
    dataset: &Dataset,
    world: &WorldConfig,
    window: Window,
    frames: usize,
) -> Result<Option<Vec<ReplayedView>>, EvaluationError> {
    let Some(mut replay) = replayed_to(dataset, world, window.episode, window.first_frame)? else {
        return Ok(None);
    };
    let mut views = Vec::with_capacity(frames);
    for frame in window.first_frame..window.first_frame + frames {
        if frame > window.first_frame {
            replay.step(&action(dataset, frame - 1)?)?;
        }
        let seen = replay.observe();
        if differs(&seen.frame, dataset, frame)? {
            return Ok(None);
        }
        views.push(ReplayedView {
            camera: replay.camera(),
            depths_m: replay.depths(),
            robots: seen.mask,
        });
    }
    Ok(Some(views))
}

/// Replays a trial up to one of its frames. `None` and errors: as [`replayed`].
fn replayed_to(
    dataset: &Dataset,
    world: &WorldConfig,
    episode: usize,
    last: usize,
) -> Result<Option<World>, EvaluationError> {
    let episode = &dataset.episodes()[episode];
    let Some(trial) = &episode.trial else {
        return Ok(None);
    };
    let mut replay = World::from_parameters(trial.clone(), world)?;
    for frame in episode.first_frame..last {
        replay.step(&action(dataset, frame)?)?;
    }
    let differs = differs(&replay.observe().frame, dataset, last)?;
    Ok((!differs).then_some(replay))
}

/// Whether a replayed frame is not the recorded one.
fn differs(replayed: &Frame, dataset: &Dataset, frame: usize) -> Result<bool, EvaluationError> {
    let recorded = true_frame(dataset, frame)?;
    let replayed = scale(&dataset.in_its_light(replayed.pixels()));
    Ok(quality::mse(&replayed, &recorded) > REPLAY_TOLERANCE)
}

/// Whether frames need no resizing, which masks and depths do not get.
pub(super) fn has_size_of(info: &DatasetInfo, spec: &ModelSpec) -> bool {
    (info.frame_width_px, info.frame_height_px) == (spec.frame_width_px, spec.frame_height_px)
}

/// The action that was carried out from a frame on.
pub(super) fn action(dataset: &Dataset, frame: usize) -> Result<Action, EvaluationError> {
    Action::try_from(dataset.action(frame).to_vec()).map_err(EvaluationError::Action)
}
