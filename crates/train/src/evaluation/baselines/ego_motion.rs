//! The last frame warped by the rotation that the commanded actions bring about, through the episode's camera model.

use super::commanded_motion::CommandedMotion;
use super::input::BaselineInput;
use foreframe_core::frame::warp::{rotation_grid, sample};
use foreframe_data::dataset::Dataset;

/// How far a camera turns under commanded actions.
pub(super) struct CameraTurn {
    width: usize,
    height: usize,
    motion: CommandedMotion,
}

impl CameraTurn {
    /// None unless the camera of every episode is known and an action component has the unit rad/s.
    pub(super) fn of(dataset: &Dataset) -> Option<Self> {
        let info = dataset.info();
        let mut episodes = dataset.episodes().iter();
        if !episodes.all(|episode| dataset.camera(episode.index).is_some()) {
            return None;
        }
        Some(Self {
            width: info.frame_width_px as usize,
            height: info.frame_height_px as usize,
            motion: CommandedMotion::of(info)?,
        })
    }

    /// One frame for each action of the input; none where the camera is not known.
    pub(super) fn predict(&self, input: &BaselineInput, last: &[f32]) -> Vec<Vec<f32>> {
        let Some(camera) = input.camera else {
            return Vec::new();
        };
        let poses = self.motion.poses(input).into_iter();
        poses
            .map(|pose| {
                if pose.heading_rad == 0.0 {
                    return last.to_vec();
                }
                let grid = rotation_grid(camera, self.width, self.height, pose.heading_rad);
                sample(last, self.width, self.height, &grid).0
            })
            .collect()
    }
}
