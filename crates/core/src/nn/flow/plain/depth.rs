//! The form that estimates depth, as [`super::super::depth`] says.

use candle_core::Tensor;

use super::ItemsAhead;
use super::cameras::Cameras;
use super::composition::moved_blocks;
use super::depth_views::SeenViews;
use super::reprojection::{Reprojected, reproject};
use crate::frame::warp::CameraModel;
use crate::nn::error::NnError;
use crate::nn::flow::depth::{SeenAround, SeenMovers};
use crate::nn::flow::depth_head::{DepthHead, LEAST_DEPTH_M, MAX_LOGARITHM, MAX_OUTSIDE, OUTSIDE_PX};
use crate::nn::flow::network::{FlowNetwork, FlowPrediction};
use crate::nn::flow::rollout_rows::RolloutRows;
use crate::nn::ops::linear::Linear;
use crate::nn::ops::sampling::ImageSize;
use crate::nn::plain::convolution::convolution;
use crate::nn::plain::layers::{linear_per_place, pixel_shuffle};
use crate::nn::plain::sampling::{at_least, at_most, sample_features};

/// What the network sees of contexts, and of their rollouts' steps before the frames are composed.
struct SeenSteps {
    views: SeenViews,
    /// The encoder's features of the contexts.
    coarse: Tensor,
    /// Of each pixel of the contexts' last frames `[contexts, P]`, in metres.
    depths: Tensor,
    ahead: ItemsAhead,
    /// Where the items' pixels were.
    seen: Reprojected,
    /// Column, row and inverse depth of each 2×2 block of the items.
    known: Tensor,
    /// The items' states.
    state: Tensor,
}

impl FlowNetwork {
    pub(super) fn plain_predict_with_depth(
        &self,
        rows: &RolloutRows,
        head: &DepthHead,
        steps: usize,
    ) -> Result<FlowPrediction, NnError> {
        let size = self.spec.image_size();
        let steps = self.see_steps(rows, head, steps)?;
        let SeenSteps { views, ahead, seen, .. } = &steps;
        let last = ahead.of_contexts(&views.frames)?;
        let moved = moved_blocks(&last, size, &seen.places.room)?;
        let beside = beside_pixels(&steps.known, seen, size)?;
        let memory = self.memory.as_ref();
        let recalled = memory
            .map(|memory| memory.plain_recall(rows, ahead, views))
            .transpose()?;
        let added = recalled.as_ref().map(|recalled| &recalled.fine);
        let fine = self.plain_fine(&steps.state, [&moved, &beside], added)?;
        let head = self.plain_head(&fine)?;
        let mut frames = seen.places.compose(&last, size, &head, &last.zeros_like()?)?;
        if let (Some(memory), Some(recalled)) = (memory, &recalled) {
            frames = memory.plain_mix(&frames, &fine, recalled)?;
        }
        let frames = frames
            .broadcast_mul(&ahead.of_contexts(&views.spread)?)?
            .broadcast_add(&ahead.of_contexts(&views.mean)?)?;
        Ok(FlowPrediction {
            frames: ahead.in_rows(&frames)?,
            scene: recalled
                .map(|recalled| ahead.in_rows(&recalled.intensities))
                .transpose()?,
            movers: self.plain_movers(&steps)?,
            speeds: rows.seen_speeds().map(|seen| seen.tensor.clone()),
            motion: steps.ahead.motion,
        })
    }

    /// What stands around the robot of one rollout.
    pub(in crate::nn::flow) fn plain_look_around(
        &self,
        row: &RolloutRows,
        head: &DepthHead,
    ) -> Result<SeenAround, NnError> {
        let steps = self.see_steps(row, head, self.spec.horizon)?;
        let values = |tensor: &Tensor| tensor.flatten_all()?.to_vec1::<f32>();
        let movers = match self.plain_movers(&steps)? {
            None => None,
            Some(logits) => Some(SeenMovers {
                logits: values(&logits)?,
                motions: values(&steps.ahead.motion)?,
            }),
        };
        Ok(SeenAround {
            depths_m: values(&steps.depths)?,
            first_depths_m: values(&steps.views.depths)?,
            movers,
        })
    }

    fn see_steps(&self, rows: &RolloutRows, head: &DepthHead, steps: usize) -> Result<SeenSteps, NnError> {
        let size = self.spec.image_size();
        let contexts = rows.contexts(self.sizes.layers.frames_read);
        let views = SeenViews::of(&contexts, self.device())?;
        let memory = self.memory.as_ref();
        let remembered = memory.map(|memory| memory.plain_now(&contexts, &views)).transpose()?;
        let features = self.plain_encode(&views.inputs, remembered.as_ref())?;
        let depths = (head.depth_factors(&features)? * &views.depths)?;
        let [coarse, _] = features;
        let ahead = self.ahead(rows, steps)?;

        let of_item = |&context: &u32| views.cameras[context as usize];
        let cameras: Vec<CameraModel> = ahead.context_of.iter().map(of_item).collect();
        let cameras = Cameras::new(&cameras, size, self.device())?;
        let seen = reproject(&cameras, size, &ahead.of_contexts(&depths)?, &ahead.item_motion)?;
        let known = ahead.of_contexts(&views.known)?;
        let (places, quarter) = (seen.places.room.detach().coarse(size)?, size.shrunk(4));
        let is_seen = places.inside(quarter, 0.5)?;
        let warped = sample_features(&ahead.of_contexts(&coarse)?, &places)?;
        let is_seen = is_seen.reshape((is_seen.dim(0)?, 1, quarter.height, quarter.width))?;
        let mixed = Tensor::cat(&[warped, corners(&known, size.shrunk(2))?, is_seen], 1)?;
        Ok(SeenSteps {
            state: self.plain_state(&mixed, &ahead.modulation)?,
            views,
            coarse,
            depths,
            ahead,
            seen,
            known,
        })
    }

    /// Where movers are in the last frame and in the steps of each rollout, as logits `[N, 1 + steps, P]`; `None` if the model does not
    /// tell.
    fn plain_movers(&self, steps: &SeenSteps) -> Result<Option<Tensor>, NnError> {
        let Some(layers) = &self.movers else { return Ok(None) };
        let SeenSteps {
            coarse, ahead, state, ..
        } = steps;
        let seen = ahead.in_rows(&ahead.of_contexts(&logits(&layers.seen, coarse)?)?)?;
        let coming = ahead.in_rows(&logits(&layers.coming, state)?)?;
        Ok(Some(Tensor::cat(&[&seen.narrow(1, 0, 1)?, &coming], 1)?))
    }
}

impl DepthHead {
    /// The depth of each pixel of the last frames `[contexts, P]`, over that before anything is learned.
    fn depth_factors(&self, [coarse, first]: &[Tensor; 2]) -> candle_core::Result<Tensor> {
        let enlarged = pixel_shuffle(&linear_per_place(&self.enlarge, &coarse.silu()?)?)?.silu()?;
        let logarithm = convolution(&self.output, &Tensor::cat(&[&enlarged, first], 1)?)?;
        let logarithm = pixel_shuffle(&logarithm)?.flatten_from(1)?;
        (logarithm.tanh()? * MAX_LOGARITHM)?.exp()
    }
}

/// The logits of movers `[…, P]` from features on the grid of a quarter of the sides.
fn logits(layer: &Linear, features: &Tensor) -> candle_core::Result<Tensor> {
    let blocks = linear_per_place(layer, &features.silu()?)?;
    pixel_shuffle(&pixel_shuffle(&blocks)?)?.flatten_from(1)
}

/// What the fine layers read beside the moved pixels, `[M, FINE_VALUES, H/2, W/2]`: of each block's upper left pixel.
fn beside_pixels(known: &Tensor, seen: &Reprojected, size: ImageSize) -> candle_core::Result<Tensor> {
    let image = |values: &Tensor| values.reshape((values.dim(0)?, 1, size.height, size.width));
    let inverse = at_least(&seen.depths, LEAST_DEPTH_M.into())?.recip()?;
    let outside = (seen.places.room.detach().outside(size)? * (1.0 / f64::from(OUTSIDE_PX)))?;
    let outside = at_most(&outside, MAX_OUTSIDE.into())?;
    let of_blocks = |values: &Tensor| corners(&image(values)?, size);
    Tensor::cat(&[known, &of_blocks(&inverse)?, &of_blocks(&outside)?], 1)
}

/// The upper left of each four places of images of that size: half the sides.
fn corners(images: &Tensor, size: ImageSize) -> candle_core::Result<Tensor> {
    let (items, channels, _, _) = images.dims4()?;
    let half = size.shrunk(2);
    let blocks = images.reshape(&[items, channels, half.height, 2, half.width, 2][..])?;
    let upper_left = blocks.narrow(3, 0, 1)?.narrow(5, 0, 1)?;
    upper_left.reshape((items, channels, half.height, half.width))
}
