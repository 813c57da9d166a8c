//! What a driver knows at a frame, and what stands in its way.

use std::collections::{BTreeMap, VecDeque};

use super::error::DriveError;
use foreframe_core::frame::Frame;
use foreframe_core::frame::warp::CameraModel;
use foreframe_core::nn::Occupancy;
use foreframe_core::planning::ActionLimit;
use foreframe_core::registry::Model;
use foreframe_core::serving::{ConditioningInput, Task, compute_task};
use foreframe_core::types::{Action, RobotState};
use foreframe_sim::{PlanarPose, World};

/// Limits of the commands, those of the recorded drives: m/s and rad/s.
pub(super) const LIMITS: [ActionLimit; 2] = [
    ActionLimit {
        low: 0.0,
        high: 0.5,
        max_change: None,
    },
    ActionLimit {
        low: -0.8,
        high: 0.8,
        max_change: None,
    },
];
/// The distance that planning drivers keep, in metres.
pub(super) const MARGIN_M: f32 = 0.15;

/// The camera shows a robot if at least this number of its pixels is in the picture.
const SEEN_PIXELS: usize = 6;

/// What a driver knows at a frame.
pub(super) struct Situation<'a> {
    /// The world, for drivers that know more than they see.
    pub(super) world: &'a World,
    /// The frames of the model's context, oldest first.
    pub(super) frames: &'a VecDeque<Frame>,
    /// The states at them.
    pub(super) states: &'a VecDeque<RobotState>,
    /// The camera.
    pub(super) camera: CameraModel,
    /// The goal as seen from the robot: metres ahead and to the left.
    pub(super) goal_m: [f32; 2],
    /// The number of the frame.
    pub(super) frame: u64,
    /// When the camera showed others.
    pub(super) views: &'a RobotViews,
}

/// When the camera showed each of the other robots last.
#[derive(Debug, Default)]
pub(super) struct RobotViews {
    last: BTreeMap<u8, u64>,
}

impl RobotViews {
    /// `mask`: the robot of each pixel.
    pub(super) fn record(&mut self, mask: &[u8], frame: u64) {
        let mut pixels = BTreeMap::new();
        for &robot in mask.iter().filter(|&&robot| robot > 0) {
            *pixels.entry(robot).or_insert(0) += 1;
        }
        let shown = pixels.into_iter().filter(|&(_, count)| count >= SEEN_PIXELS);
        self.last.extend(shown.map(|(robot, _)| (robot, frame)));
    }

    /// Whether the camera showed a robot, by its id in the mask, at that frame or at one of the `recent` frames before it.
    pub(super) fn saw(&self, robot: usize, frame: u64, recent: u64) -> bool {
        let last = u8::try_from(robot).ok().and_then(|robot| self.last.get(&robot));
        last.is_some_and(|&last| frame - last <= recent)
    }
}

impl Situation<'_> {
    /// The context of predictions.
    pub(super) fn context(&self, model: &Model) -> Result<Task, DriveError> {
        let frames = self.frames.iter().cloned().collect();
        let past = self
            .states
            .iter()
            .take(self.states.len().saturating_sub(1))
            .cloned()
            .collect();
        Ok(Task::rollout(
            frames,
            past,
            Some(self.camera),
            Vec::new(),
            &model.manifest,
        )?)
    }

    /// What the model sees around the robot, and where it expects movers.
    pub(super) fn occupancy(&self, model: &Model) -> Result<Occupancy, DriveError> {
        let plans = vec![vec![action([0.0, 0.0])?; model.spec().horizon]];
        let inputs = ConditioningInput::of_plans(plans, self.states.back().cloned(), None, &model.manifest)?;
        let seen = compute_task(model, &self.context(model)?.with_rollouts(inputs, true))?;
        Ok(seen.occupancy.unwrap_or_default())
    }
}

/// The place in the room of what a robot with that pose has ahead and to the left, in metres.
pub(super) fn in_room(pose: PlanarPose, [ahead, left]: [f32; 2]) -> [f32; 2] {
    let (sin, cos) = pose.heading_rad.sin_cos();
    [pose.x_m + cos * ahead - sin * left, pose.y_m + sin * ahead + cos * left]
}

/// A place in the room as a robot with that pose has it: metres ahead and to the left.
pub(super) fn seen_from(pose: PlanarPose, [x, y]: [f32; 2]) -> [f32; 2] {
    in_axes_of(pose, [x - pose.x_m, y - pose.y_m])
}

/// A direction of the room as a robot with that pose has it: ahead and to the left.
pub(super) fn in_axes_of(pose: PlanarPose, [x, y]: [f32; 2]) -> [f32; 2] {
    let (sin, cos) = pose.heading_rad.sin_cos();
    [cos * x + sin * y, cos * y - sin * x]
}

pub(super) fn action(command: [f32; 2]) -> Result<Action, DriveError> {
    Ok(Action::try_from(command.to_vec())?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_robot_is_seen_where_enough_of_it_is_in_the_picture() {
        let mask = |robot: u8, pixels: usize| {
            let mut mask = vec![0; 64];
            mask[10..10 + pixels].fill(robot);
            mask
        };
        let mut views = RobotViews::default();
        views.record(&mask(2, SEEN_PIXELS), 3);
        views.record(&mask(1, SEEN_PIXELS - 1), 4);
        assert!(views.saw(2, 3, 0) && views.saw(2, 5, 2));
        assert!(!views.saw(2, 4, 0) && !views.saw(2, 6, 2));
        assert!(!views.saw(1, 4, 2) && !views.saw(300, 4, 2));
    }
}
