//! The direct form of the flow network: every step starts from the last true frame, so all steps are computed at once.

use candle_core::{Device, Tensor};

use super::blocks::{MOVED_CHANNELS, fold_pixels, sampled_blocks};
use super::network::{FlowNetwork, FlowPrediction};
use super::rollout_rows::RolloutRows;
use crate::nn::error::NnError;
use crate::nn::geometry::camera::{CameraPose, Viewer, turning_places};
use crate::nn::ops::compose::{Composition, SCENE_CHANNELS, SCENE_FEATURES};
use crate::nn::ops::pixel_shuffle::pixel_unshuffle;
use crate::nn::ops::sampling::{own_places, sample_features};
use crate::nn::spec::ModelSpec;
use crate::nn::tensors::with_values;

impl FlowNetwork {
    /// All steps of the rollouts at once; gives the frames of the first `steps`.
    pub(super) fn predict_directly(
        &self,
        spec: &ModelSpec,
        rows: &RolloutRows,
        steps: usize,
    ) -> Result<FlowPrediction, NnError> {
        let (count, horizon, size) = (rows.count(), spec.horizon, spec.image_size());
        let (half, quarter) = (size.shrunk(2), size.shrunk(4));
        let motion = self.motion.forward(spec, rows)?;
        let contexts = rows.contexts(spec, self.sizes.layers.frames_read);
        let coarse = self.encode(spec, &contexts)?;

        let motions = with_values(&motion, motion_rows)?;
        let poses = rows.rollout_poses(spec, &motions);
        let scene = self.scene.forward(spec, rows, &motion, &poses)?;

        let geometry = self.places(spec, rows, &motion.flatten(0, 1)?, &poses)?;
        let context_of = repeated(&contexts.row_of, horizon);
        let warped = sample_features(&coarse, geometry.coarse, &context_of)?;
        let moved = sampled_blocks(&contexts.last_frames, &context_of, &geometry.room_or_turned, size);
        let moved = Tensor::from_vec(
            moved,
            (count * horizon, half.height, half.width, MOVED_CHANNELS),
            &Device::Cpu,
        )?;
        let modulation = self.modulate(spec, rows, &motion)?;
        let features = scene.narrow(3, 0, SCENE_FEATURES)?.contiguous()?;
        let mixed = Tensor::cat(&[&warped, &pixel_unshuffle(&features)?], 3)?;
        let state = self.refined(Self::per_place(&self.mix, &mixed, quarter)?, &modulation)?;
        let head = self.head(&state, &moved, &scene, quarter)?;

        let composition = Composition {
            size,
            frames: contexts.last_frames,
            frame_of: context_of,
            room_places: geometry.room,
        };
        let frames = composition.compose(&head, &scene, &geometry.turned)?;
        let content = fold_pixels(&scene.narrow(3, SCENE_FEATURES, SCENE_CHANNELS - SCENE_FEATURES)?)?;
        Ok(FlowPrediction {
            frames: frames.reshape((count, horizon, size.pixels()))?.narrow(1, 0, steps)?,
            scene: content.reshape((count, horizon, size.pixels()))?,
            motion,
        })
    }

    /// Where each item's pixels were in the last frame.
    fn places(
        &self,
        spec: &ModelSpec,
        rows: &RolloutRows,
        motion: &Tensor,
        poses: &[CameraPose],
    ) -> Result<ItemPlaces, NnError> {
        let size = spec.image_size();
        let quarter = size.shrunk(4);
        let Some(camera) = self.sizes.camera.filter(|_| self.motion.is_moving()) else {
            return self.places_without_camera(spec, motion);
        };
        let viewer = Viewer::new(camera, size);
        let yaw = motion.narrow(1, 0, 1)?.flatten_all()?;
        let turned = turning_places(viewer, &viewer.rays(), &yaw)?;
        let coarse_viewer = Viewer::new(camera, quarter);
        let coarse_rays = coarse_viewer.rays();
        let coarse = with_values(&yaw, |yaw| {
            yaw.iter()
                .flat_map(|&yaw| coarse_viewer.turned(&coarse_rays, yaw))
                .collect()
        })?;
        let before: Vec<CameraPose> = (0..poses.len())
            .map(|item| rows.pose(spec, item / spec.horizon))
            .collect();
        let room = self.scene.room_places(viewer, poses, &before)?;
        let room_or_turned = match &room {
            Some(places) => places.clone(),
            None => turned.flatten_all()?.to_vec1()?,
        };
        Ok(ItemPlaces {
            turned,
            coarse,
            room,
            room_or_turned,
        })
    }

    /// As [`FlowNetwork::places`] where nothing is known of the camera: an affine map of the image learned from the motion,
    /// or every pixel where it is.
    fn places_without_camera(&self, spec: &ModelSpec, motion: &Tensor) -> Result<ItemPlaces, NnError> {
        let size = spec.image_size();
        let quarter = size.shrunk(4);
        let items = motion.dim(0)?;
        let own = Tensor::from_vec(own_places(size), (1, size.pixels(), 2), &Device::Cpu)?;
        let turned = match self.motion.affine_places(spec, motion, &own)? {
            Some(places) => places,
            None => own.broadcast_as((items, size.pixels(), 2))?.contiguous()?,
        };
        let values: Vec<f32> = turned.flatten_all()?.to_vec1()?;
        // The coarse places are the means of their blocks.
        let mut coarse = Vec::with_capacity(items * quarter.pixels() * 2);
        for item in values.chunks_exact(size.pixels() * 2) {
            for row in 0..quarter.height {
                for column in 0..quarter.width {
                    for axis in 0..2 {
                        let at =
                            |dy: usize, dx: usize| item[((4 * row + dy) * size.width + 4 * column + dx) * 2 + axis];
                        let middle = (at(1, 1) + at(2, 2) + at(1, 2) + at(2, 1)) / 4.0;
                        coarse.push((middle - 1.5) / 4.0);
                    }
                }
            }
        }
        Ok(ItemPlaces {
            turned,
            coarse,
            room: None,
            room_or_turned: values,
        })
    }
}

/// Where each item's pixels were in the last frame, columns and rows.
struct ItemPlaces {
    /// Before the camera turned, `[M, P, 2]`; gradients go to the motion.
    turned: Tensor,
    /// The same on the grid of a quarter of the sides.
    coarse: Vec<f32>,
    /// Before the camera turned and drove, for pixels of the room.
    room: Option<Vec<f32>>,
    /// The better guess of both.
    room_or_turned: Vec<f32>,
}

fn motion_rows(values: &[f32]) -> Vec<[f32; 3]> {
    values
        .chunks_exact(3)
        .map(|motion| [motion[0], motion[1], motion[2]])
        .collect()
}

/// For each item (`steps` for each row) the value of its row.
fn repeated(row_of: &[u32], steps: usize) -> Vec<u32> {
    row_of.iter().flat_map(|&row| std::iter::repeat_n(row, steps)).collect()
}
