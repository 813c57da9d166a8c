//! The body of a plan from a context.

use serde::Deserialize;

use crate::server::config::ServerConfig;
use crate::server::http::extract::ResponseFormat;
use crate::server::http::multipart::WithFrames;
use crate::server::http::problem::ApiError;
use crate::server::images::{ImageBytes, ImageFormat, ImageInput};
use crate::server::plans::request::{GivenToPlanner, PlanGoal, PlanReading, PlanSearch, present_plan};
use crate::server::plans::response::PlanForm;
use crate::server::request_inputs;
use crate::server::routes::picture;
use foreframe_core::frame::Frame;
use foreframe_core::frame::resize::Resize;
use foreframe_core::frame::warp::CameraModel;
use foreframe_core::planning::PlannerInput;
use foreframe_core::registry::Manifest;
use foreframe_core::serving::Task;

/// A context and a goal.
#[derive(Debug, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub(super) struct PlanRequest {
    /// The images of the context, oldest first; in a form, its parts `frames`.
    #[serde(default)]
    frames: Vec<ImageBytes>,
    /// How the images are encoded, here and in the answer (`jpeg` is answered with `png`).
    #[serde(default)]
    format: ImageFormat,
    /// How an image of another size is resized; without it, another size is an error.
    resize: Option<Resize>,
    /// The robot's state at the last frame.
    state: Option<Vec<f32>>,
    /// The robot's state at each frame, instead of `state`.
    states: Option<Vec<Vec<f32>>>,
    /// The camera that took the images, for a model that estimates depth. Default: the model's.
    camera: Option<CameraModel>,
    /// What to reach.
    goal: PlanGoal,
    /// How to search, and what counts.
    #[serde(default)]
    search: PlanSearch,
    /// The plan that the robot follows now; it is always one of the plans tried, and the search begins there. Its last action is held.
    #[schema(max_items = 256)]
    #[serde(default)]
    present: Vec<Vec<f32>>,
    /// The action before the plan, from which `max_change` is counted first.
    action: Option<Vec<f32>>,
    /// Whether the answer has the predicted frames.
    #[serde(default)]
    with_frames: bool,
    /// Whether the answer has what stands in the way, and where movers will be.
    #[serde(default)]
    with_obstacles: bool,
}

impl WithFrames for PlanRequest {
    fn push_frame(&mut self, file: Vec<u8>) {
        self.frames.push(ImageBytes(file));
    }
}

impl PlanRequest {
    /// How the answer is given.
    pub(super) fn form(&self) -> PlanForm {
        PlanForm {
            format: self.format.answer(),
            with_frames: self.with_frames,
            with_obstacles: self.with_obstacles,
        }
    }

    /// The context, also as frames if the answer shows it, and what the search starts from.
    pub(super) fn into_search(
        self,
        wanted: ResponseFormat,
        manifest: &Manifest,
        config: &ServerConfig,
    ) -> Result<(Vec<Frame>, Task, PlannerInput), ApiError> {
        let images = ImageInput {
            format: self.format,
            resize: self.resize,
        };
        let frames = request_inputs::decode_frames(self.frames, images, manifest, config.max_frames)?;
        let (past_states, state) = request_inputs::states(self.state, self.states, frames.len())?;
        let seen = picture::context_for(wanted, &frames);
        let task = Task::rollout(frames, past_states, self.camera, Vec::new(), manifest)?;
        let given = GivenToPlanner {
            state,
            camera: self.camera,
            present: present_plan(self.present, config)?,
            action: self.action,
        };
        let reading = PlanReading {
            images,
            manifest,
            config,
        };
        let input = given.input(self.goal, self.search, reading)?;
        Ok((seen, task, input))
    }
}
