//! The form of the flow network that estimates depth: what the last frame shows is placed in space, and seen from where the
//! camera will be. It remembers no place, so it serves in rooms that it never saw. All steps are computed at once.

use candle_core::{DType, Device, Tensor};

use super::blocks::sampled_blocks;
use super::depth_head::{DepthHead, SeenPlaces};
use super::depth_views::DepthViews;
use super::network::{FlowNetwork, FlowPrediction, Surroundings};
use super::occupancy::{Occupancy, OccupancyView};
use super::reprojection::{Reprojection, reproject};
use super::rollout_rows::RolloutRows;
use crate::frame::warp::CameraModel;
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
    /// Where movers are in the last frames, as logits `[contexts, P]`.
    movers: Option<Tensor>,
}

/// Where the frames after contexts are seen from, and the decoder's state of each.
struct SeenAhead {
    context_of: Vec<u32>,
    /// `[M, P, PLACE_VALUES]`.
    places: Tensor,
    seen: SeenPlaces,
    /// `[M, H/4, W/4, C]`.
    state: Tensor,
}

impl FlowNetwork {
    /// What stands around the robot at the last frames of B windows `[B, context, P]`, and where movers will be under each
    /// window's actions; `None` if this form estimates no depth. Errors: `Shape`, `Missing`.
    pub(in crate::nn) fn occupancy(
        &self,
        frames: &Tensor,
        conditioning: &ConditioningTensors,
    ) -> Result<Option<Vec<Occupancy>>, NnError> {
        let Surroundings::Seen(head) = &self.surroundings else {
            return Ok(None);
        };
        let windows: Vec<u32> = (0..frames.dim(0)? as u32).collect();
        let rows = RolloutRows::new(&self.spec, frames, &windows, conditioning)?;
        let all = windows.iter().map(|&window| {
            let window = window as usize;
            self.occupancy_of(&rows.part(window..window + 1), head)
        });
        all.collect::<Result<_, NnError>>().map(Some)
    }

    /// Of one rollout.
    fn occupancy_of(&self, row: &RolloutRows, head: &DepthHead) -> Result<Occupancy, NnError> {
        let (size, horizon) = (self.spec.image_size(), self.spec.horizon);
        let depths = self.see_depth(row, head)?;
        let camera = row.camera(0).unwrap_or(CameraModel::USUAL);
        let view = OccupancyView {
            viewer: depths.views.viewers[0],
            size,
            height_m: camera.height_m.unwrap_or(CameraModel::USUAL_HEIGHT_M),
        };
        let known = Occupancy {
            depths_m: depths.depths.flatten_all()?.to_vec1::<f32>()?,
            first_depths_m: depths.views.depths.clone(),
            ..Occupancy::default()
        };
        let Some((layers, seen)) = self.movers.as_ref().zip(depths.movers.as_ref()) else {
            return Ok(Occupancy {
                points: view.points(&known.depths_m, None),
                ..known
            });
        };
        let motion = self.motion.forward(row)?;
        let ahead = self.see_ahead(row, horizon, &depths, &motion)?;
        let coming = layers.coming(&ahead.state)?;
        let motions = motion.flatten_all()?.to_vec1::<f32>()?;
        let logits = Tensor::cat(&[seen, &coming], 0)?;
        Ok(with_values(&logits, |logits| {
            let motions = std::iter::once([0.0; 3]).chain(motions.as_chunks::<3>().0.iter().copied());
            let frames = logits.chunks_exact(size.pixels());
            let movers = frames.zip(motions).enumerate().map(|(step, (logits, motion))| {
                let depths = (step == 0).then_some(known.depths_m.as_slice());
                view.movers(logits, motion, depths)
            });
            Occupancy {
                movers: movers.collect(),
                points: view.points(&known.depths_m, logits.get(..size.pixels())),
                ..known
            }
        })?)
    }

    /// Encodes the contexts of the rollouts and estimates their depths.
    pub(super) fn see_depth(&self, rows: &RolloutRows, head: &DepthHead) -> Result<SeenDepths, NnError> {
        let contexts = rows.contexts(self.sizes.layers.frames_read);
        let mut views = DepthViews::of(&contexts);
        let features = self.encode(contexts.count(), std::mem::take(&mut views.inputs))?;
        let depths = head.forward(&features, &views)?;
        let [coarse, _] = features;
        let movers = self.movers.as_ref().map(|movers| movers.seen(&coarse)).transpose()?;
        Ok(SeenDepths {
            views,
            coarse,
            depths,
            movers,
        })
    }

    /// What the first `steps` frames of the rollouts are computed from.
    fn see_ahead(
        &self,
        rows: &RolloutRows,
        steps: usize,
        depths: &SeenDepths,
        motion: &Tensor,
    ) -> Result<SeenAhead, NnError> {
        let (size, horizon) = (self.spec.image_size(), self.spec.horizon);
        // Frames that are not asked for are not computed.
        let of_steps = |&context: &u32| std::iter::repeat_n(context, steps);
        let context_of: Vec<u32> = rows.context_of().iter().flat_map(of_steps).collect();
        let asked = |per_step: &Tensor| -> Result<Tensor, NnError> {
            let per_step = per_step.reshape((rows.count(), horizon, ()))?;
            Ok(per_step.narrow(1, 0, steps)?.flatten(0, 1)?)
        };
        let reprojection = Reprojection {
            size,
            viewers: depths.views.viewers.clone(),
            context_of: context_of.clone(),
        };
        let places = reproject(reprojection, &depths.depths, &asked(motion)?)?;
        let seen = with_values(&places, |places| SeenPlaces::of(places, size))?;
        let warped = sample_features(&depths.coarse, seen.coarse.clone(), &context_of)?;
        let beside = seen.beside_features(&depths.views, &context_of, size)?;
        let state = per_place(&self.mix, &Tensor::cat(&[&warped, &beside], 3)?)?;
        let state = self.refined(state, &asked(&self.modulate(rows, motion)?)?)?;
        Ok(SeenAhead {
            context_of,
            places,
            seen,
            state,
        })
    }

    /// All steps of the rollouts at once; gives the frames of the first `steps`.
    pub(super) fn predict_with_depth(
        &self,
        rows: &RolloutRows,
        steps: usize,
        depths: &SeenDepths,
    ) -> Result<FlowPrediction, NnError> {
        let (size, views) = (self.spec.image_size(), &depths.views);
        let motion = self.motion.forward(rows)?;
        let SeenAhead {
            context_of,
            places,
            seen,
            state,
        } = self.see_ahead(rows, steps, depths, &motion)?;
        let movers = match (&self.movers, &depths.movers) {
            (Some(head), Some(seen)) => {
                let seen = seen.index_select(&Tensor::new(rows.context_of(), &Device::Cpu)?, 0)?;
                let coming = head.coming(&state)?.reshape((rows.count(), steps, ()))?;
                Some(Tensor::cat(&[&seen.unsqueeze(1)?, &coming], 1)?)
            }
            _ => None,
        };
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
            movers,
        })
    }
}
