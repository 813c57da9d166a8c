//! The form of the flow network that estimates depth: what the last frame shows is placed in space, and seen from where the
//! camera will be. It remembers no place, so it serves in rooms that it never saw. All steps are computed at once.

use candle_core::{DType, Device, Tensor};

use super::blocks::sampled_blocks;
use super::depth_head::{DepthHead, SeenPlaces};
use super::depth_views::DepthViews;
use super::network::{FlowNetwork, FlowPrediction, Surroundings};
use super::reprojection::{Reprojection, reproject};
use super::rollout_rows::RolloutRows;
use crate::nn::conditioning::ConditioningTensors;
use crate::nn::error::NnError;
use crate::nn::ops::compose::{Composition, RoomPlaces};
use crate::nn::ops::linear::per_place;
use crate::nn::ops::sampling::sample_features;
use crate::nn::tensors::with_values;

/// What the network sees of contexts, for all rollouts that follow them.
pub(super) struct SeenDepths {
    views: DepthViews,
    /// The encoder's features.
    coarse: Tensor,
    /// Of each pixel of the last frames `[contexts, P]`, in metres.
    depths: Tensor,
}

impl FlowNetwork {
    /// The points that the last frames of B windows `[B, context, P]` show, one for each pixel: ahead, left and up of each
    /// camera, in metres. Empty if this form estimates no depth. Errors: `Shape`, `Missing`.
    pub(in crate::nn) fn seen_points(
        &self,
        frames: &Tensor,
        conditioning: &ConditioningTensors,
    ) -> Result<Vec<Vec<[f32; 3]>>, NnError> {
        let Surroundings::Seen(head) = &self.surroundings else {
            return Ok(Vec::new());
        };
        let windows: Vec<u32> = (0..frames.dim(0)? as u32).collect();
        let rows = RolloutRows::new(&self.spec, frames, &windows, conditioning)?;
        let SeenDepths { views, depths, .. } = self.see_depth(&rows, head)?;
        let points = with_values(&depths, |depths| {
            let of_frames = depths.chunks_exact(self.spec.pixels()).zip(&views.viewers);
            of_frames
                .map(|(depths, viewer)| {
                    let points = viewer.rays().into_iter().zip(depths);
                    points.map(|(ray, depth)| ray.map(|part| part * depth)).collect()
                })
                .collect()
        })?;
        Ok(points)
    }

    /// Encodes the contexts of the rollouts and estimates their depths.
    pub(super) fn see_depth(&self, rows: &RolloutRows, head: &DepthHead) -> Result<SeenDepths, NnError> {
        let contexts = rows.contexts(self.sizes.layers.frames_read);
        let mut views = DepthViews::of(&contexts);
        let features = self.encode(contexts.count(), std::mem::take(&mut views.inputs))?;
        let depths = head.forward(&features, &views)?;
        let [coarse, _] = features;
        Ok(SeenDepths { views, coarse, depths })
    }

    /// All steps of the rollouts at once; gives the frames of the first `steps`.
    pub(super) fn predict_with_depth(
        &self,
        rows: &RolloutRows,
        steps: usize,
        SeenDepths { views, coarse, depths }: &SeenDepths,
    ) -> Result<FlowPrediction, NnError> {
        let (size, horizon) = (self.spec.image_size(), self.spec.horizon);
        let motion = self.motion.forward(rows)?;

        // Frames that are not asked for are not computed.
        let of_steps = |&context: &u32| std::iter::repeat_n(context, steps);
        let context_of: Vec<u32> = rows.context_of().iter().flat_map(of_steps).collect();
        let asked = |per_step: &Tensor| -> Result<Tensor, NnError> {
            let per_step = per_step.reshape((rows.count(), horizon, ()))?;
            Ok(per_step.narrow(1, 0, steps)?.flatten(0, 1)?)
        };
        let reprojection = Reprojection {
            size,
            viewers: views.viewers.clone(),
            context_of: context_of.clone(),
        };
        let places = reproject(reprojection, depths, &asked(&motion)?)?;
        let seen = with_values(&places, |places| SeenPlaces::of(places, size))?;
        let warped = sample_features(coarse, seen.coarse.clone(), &context_of)?;
        let mixed = Tensor::cat(&[&warped, &seen.beside_features(views, &context_of, size)?], 3)?;
        let state = per_place(&self.mix, &mixed)?;
        let state = self.refined(state, &asked(&self.modulate(rows, &motion)?)?)?;
        let moved = sampled_blocks(&views.frames, &context_of, &seen.room, size)?;
        let head = self.head(&state, &moved, &seen.beside_pixels(views, &context_of, size)?)?;

        let half = size.shrunk(2);
        let no_content = Tensor::zeros((context_of.len(), half.height, half.width, 4), DType::F32, &Device::Cpu)?;
        let composition = Composition {
            size,
            frames: views.frames.clone(),
            frame_of: context_of.clone(),
            room: RoomPlaces::Tracked,
        };
        let frames = composition.compose(&head, &no_content, &places)?;
        let level = |part: usize| -> Result<Tensor, NnError> {
            let levels: Vec<f32> = context_of
                .iter()
                .map(|&context| views.levels[context as usize][part])
                .collect();
            Ok(Tensor::from_vec(levels, (context_of.len(), 1), &Device::Cpu)?)
        };
        let frames = frames.broadcast_mul(&level(1)?)?.broadcast_add(&level(0)?)?;
        Ok(FlowPrediction {
            frames: frames.reshape((rows.count(), steps, size.pixels()))?,
            scene: None,
            motion,
        })
    }
}
