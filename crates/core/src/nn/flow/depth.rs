//! The form of the flow network that estimates depth: what the last frame shows is placed in space, and seen from where the
//! camera will be. Without a memory it knows no place, so it serves in rooms that it never saw.

use candle_core::{DType, Device, Tensor};
use rayon::prelude::*;

use super::depth_head::{DepthHead, SeenPlaces};
use super::depth_views::{DepthViews, FrameLevels};
use super::memory::{Memory, Recalled, known_poses};
use super::network::{FlowNetwork, Surroundings};
use super::occupancy::{Occupancy, OccupancyView};
use super::reprojection::{Reprojection, reproject};
use super::rollout_rows::RolloutRows;
use super::steps_ahead::{PredictedAhead, StepsAhead};
use crate::frame::warp::CameraModel;
use crate::nn::conditioning::ConditioningTensors;
use crate::nn::error::NnError;
use crate::nn::geometry::camera::Viewer;
use crate::nn::ops::compose::{Composition, RoomPlaces};
use crate::nn::ops::joining::joined;
use crate::nn::ops::linear::per_place;
use crate::nn::ops::sampling::sample_features;

/// What the network sees of contexts, for all rollouts that follow them.
pub(super) struct SeenDepths {
    views: DepthViews,
    /// The encoder's features.
    coarse: Tensor,
    /// Of each pixel of the last frames `[contexts, P]`, in metres.
    depths: Tensor,
    /// Where movers are in the last frames, as logits `[contexts, P]`.
    pub(super) movers: Option<Tensor>,
}

/// Where the frames after contexts are seen from, and the decoder's state of each.
struct SeenAhead {
    context_of: Vec<u32>,
    seen: SeenPlaces,
    /// `[M, H/4, W/4, C]`.
    state: Tensor,
}

/// What the network sees around the robot at the last frame of one rollout.
pub(super) struct SeenAround {
    /// Of each pixel, in metres.
    pub(super) depths_m: Vec<f32>,
    /// The same before anything is learned.
    pub(super) first_depths_m: Vec<f32>,
    /// `None` if the model does not find movers.
    pub(super) movers: Option<SeenMovers>,
}

/// Where movers are.
pub(super) struct SeenMovers {
    /// Logits of the pixels of the last frame, then of each predicted one.
    pub(super) logits: Vec<f32>,
    /// Yaw, ahead and left of the camera at each predicted frame.
    pub(super) motions: Vec<f32>,
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
        let rows = self.see_speeds(&RolloutRows::new(&self.spec, frames, &windows, conditioning)?)?;
        let all = windows.iter().map(|&window| {
            let window = window as usize;
            self.occupancy_of(&rows.part(window..window + 1), head)
        });
        all.collect::<Result<_, NnError>>().map(Some)
    }

    /// Of one rollout.
    fn occupancy_of(&self, row: &RolloutRows, head: &DepthHead) -> Result<Occupancy, NnError> {
        let size = self.spec.image_size();
        let camera = row.camera(0).unwrap_or(CameraModel::USUAL);
        let view = OccupancyView {
            viewer: Viewer::new(camera, size),
            size,
            height_m: camera.height_m.unwrap_or(CameraModel::USUAL_HEIGHT_M),
        };
        let SeenAround {
            depths_m,
            first_depths_m,
            movers,
        } = if self.is_plain {
            self.plain_look_around(row, head)?
        } else {
            self.look_around(row, head)?
        };
        let logits = movers.as_ref().and_then(|movers| movers.logits.get(..size.pixels()));
        Ok(Occupancy {
            points: view.points(&depths_m, logits),
            movers: movers.map_or_else(Vec::new, |movers| {
                let motions = movers.motions.as_chunks::<3>().0.iter().copied();
                let motions = std::iter::once([0.0; 3]).chain(motions);
                let frames = movers.logits.chunks_exact(size.pixels());
                let places = frames.zip(motions).enumerate().map(|(step, (logits, motion))| {
                    let depths = (step == 0).then_some(depths_m.as_slice());
                    view.movers(logits, motion, depths)
                });
                places.collect()
            }),
            depths_m,
            first_depths_m,
        })
    }

    fn look_around(&self, row: &RolloutRows, head: &DepthHead) -> Result<SeenAround, NnError> {
        let depths = self.see_depth(row, head)?;
        let movers = match self.movers.as_ref().zip(depths.movers.as_ref()) {
            None => None,
            Some((layers, seen)) => {
                let ahead = self.known_ahead(row)?;
                let each = (0..self.spec.horizon).into_par_iter().map(|step| {
                    let seen = self.see_ahead(&StepsAhead::new(row, step..step + 1, &ahead), &depths)?;
                    layers.coming(&seen.state)
                });
                let coming = Tensor::cat(&each.collect::<Result<Vec<_>, NnError>>()?, 0)?;
                Some(SeenMovers {
                    logits: Tensor::cat(&[seen, &coming], 0)?.flatten_all()?.to_vec1()?,
                    motions: ahead.motion.flatten_all()?.to_vec1()?,
                })
            }
        };
        Ok(SeenAround {
            depths_m: depths.depths.flatten_all()?.to_vec1()?,
            first_depths_m: depths.views.depths,
            movers,
        })
    }

    /// Encodes the contexts of the rollouts and estimates their depths.
    pub(super) fn see_depth(&self, rows: &RolloutRows, head: &DepthHead) -> Result<SeenDepths, NnError> {
        let mut contexts = rows.contexts(self.sizes.layers.frames_read);
        let mut views = DepthViews::of(&contexts);
        let remembered = match &self.memory {
            Some(memory) => Some(memory.now(&mut contexts, &FrameLevels::of(&views.levels)?)?),
            None => None,
        };
        let inputs = std::mem::take(&mut views.inputs);
        let features = self.encode(contexts.count(), inputs, remembered.as_ref())?;
        let depths = head.forward(&features, &views)?;
        let [coarse, _] = features;
        let movers = self.movers.as_ref().filter(|_| !rows.only_frames);
        let movers = movers.map(|movers| movers.seen(&coarse)).transpose()?;
        Ok(SeenDepths {
            views,
            coarse,
            depths,
            movers,
        })
    }

    /// What the frames of these steps are computed from.
    fn see_ahead(&self, ahead: &StepsAhead, depths: &SeenDepths) -> Result<SeenAhead, NnError> {
        let size = self.spec.image_size();
        let context_of = ahead.context_of();
        let reprojection = Reprojection {
            size,
            cameras: depths.views.cameras.clone(),
            context_of: context_of.clone(),
        };
        let places = reproject(reprojection, &depths.depths, &ahead.motion()?)?;
        let seen = SeenPlaces::of(places, size)?;
        let warped = sample_features(&depths.coarse, seen.coarse.clone(), &context_of)?;
        let beside = seen.beside_features(&depths.views, &context_of, size)?;
        let mixed = joined([&warped, &beside])?;
        let state = per_place(&self.mix, &mixed)?;
        self.recycle([&warped, &mixed])?;
        let state = self.refined(state, &ahead.modulation()?)?;
        Ok(SeenAhead {
            context_of,
            seen,
            state,
        })
    }

    /// The frames of these steps.
    pub(super) fn predict_with_depth(
        &self,
        ahead: &StepsAhead,
        depths: &SeenDepths,
    ) -> Result<PredictedAhead, NnError> {
        let (size, views) = (self.spec.image_size(), &depths.views);
        let shape = (ahead.rows.count(), ahead.steps(), size.pixels());
        let SeenAhead {
            context_of,
            seen,
            state,
        } = self.see_ahead(ahead, depths)?;
        let movers = self.movers.as_ref().filter(|_| !ahead.rows.only_frames);
        let movers = movers.map(|movers| movers.coming(&state)).transpose()?;
        let moved = seen.moved_blocks(&views.frames, &context_of, size)?;
        let levels: Vec<[f32; 2]> = context_of
            .iter()
            .map(|&context| views.levels[context as usize])
            .collect();
        let levels = FrameLevels::of(&levels)?;
        let memory = self.memory.as_ref();
        let recalled = memory.map(|memory| recall(memory, ahead, &levels)).transpose()?;
        let beside = seen.beside_pixels(views, &context_of, size)?;
        let fine = self.fine(
            &state,
            [&moved, &beside],
            recalled.as_ref().map(|recalled| &recalled.fine),
        )?;
        let head = self.head(&fine)?;

        let half = size.shrunk(2);
        let no_content = Tensor::zeros((context_of.len(), half.height, half.width, 4), DType::F32, &Device::Cpu)?;
        let composition = Composition {
            size,
            frames: views.frames.clone(),
            frame_of: context_of.clone(),
            room: RoomPlaces::Tracked,
        };
        let mut frames = composition.compose(&head, &no_content, &seen.places)?;
        if let (Some(memory), Some(recalled)) = (memory, &recalled) {
            frames = memory.mix(&frames, &fine, recalled)?;
        }
        self.recycle([&state, &fine, &head, &seen.places])?;
        let frames = levels.intensities(&frames)?;
        Ok(PredictedAhead {
            frames: frames.reshape(shape)?,
            scene: recalled
                .filter(|_| !ahead.rows.only_frames)
                .map(|recalled| recalled.intensities.reshape(shape))
                .transpose()?,
            movers: movers.map(|movers| movers.reshape(shape)).transpose()?,
        })
    }
}

/// The room at these steps, as it is remembered.
fn recall(memory: &Memory, ahead: &StepsAhead, levels: &FrameLevels) -> Result<Recalled, NnError> {
    let [_, mut poses] = ahead.poses()?;
    let is_known = known_poses(&mut poses);
    let scene = memory
        .scene
        .forward(ahead.rows, &ahead.row_of(), &ahead.motion()?, &poses)?;
    memory.recall(&scene, is_known, levels)
}
