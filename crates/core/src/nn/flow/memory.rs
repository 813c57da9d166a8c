//! What the depth form remembers of the one room that a robot lives in, beside what the context shows: the scene, seen from where the
//! state says that the camera stands and will stand.
//!
//! The encoder reads what the room looks like at the last frame, the fine layers what it will look like, and each pixel of the result
//! is mixed with the remembered one. Where the pose is not known, the memory counts for nothing.

use candle_core::{Device, Result as TensorResult, Tensor};

use super::blocks::{BLOCK_PIXELS, content_blocks, content_frames};
use super::depth_views::FrameLevels;
use super::encoder_views::EncoderViews;
use super::scene::Scene;
use crate::nn::error::NnError;
use crate::nn::geometry::camera::CameraPose;
use crate::nn::model_tensors::ModelTensors;
use crate::nn::ops::activated_convolution::{Activation, activated_convolution};
use crate::nn::ops::compose::SCENE_FEATURES;
use crate::nn::ops::convolution::Convolution3;
use crate::nn::ops::image_geometry::ConvShape;
use crate::nn::ops::pixel_shuffle::pixel_shuffle;
use crate::nn::precision::Precision;
use crate::nn::spec::ModelSpec;

/// Subtracted from the logit of the remembered pixel's share, so that an untrained memory hardly counts.
pub(super) const SHARE_LOGIT: f64 = 3.0;

/// The scene, and the layers that read it.
#[derive(Clone, Debug)]
pub(super) struct Memory {
    pub(super) scene: Scene,
    /// From the content at the last frame to what the encoder's first layer adds.
    pub(super) seen: Convolution3,
    /// From the scene at a predicted frame to what the fine layer adds.
    pub(super) fine: Convolution3,
    /// From the fine layer to the logits of how much the remembered pixels count.
    pub(super) share: Convolution3,
}

/// The room as it is remembered at predicted frames.
pub(super) struct Recalled {
    /// Pixels `[M, P]`, counted as the last frames are.
    pub(super) content: Tensor,
    /// The same as intensities.
    pub(super) intensities: Tensor,
    /// What the fine layer adds, `[M, H/2, W/2, …]`.
    pub(super) fine: Tensor,
    /// 1 for items whose pose is known, else 0, `[M, 1]`.
    pub(super) is_known: Tensor,
}

impl Memory {
    /// `None` where the model has none.
    pub(super) fn of(spec: &ModelSpec, tensors: &ModelTensors) -> Option<Self> {
        let flow = spec.flow().filter(|flow| flow.layers.memory)?;
        let layer = |name: &str| tensors.convolution(&format!("flow.memory.{name}"), ConvShape::PLAIN);
        Some(Self {
            scene: Scene::new(spec, flow.camera, tensors),
            seen: layer("seen"),
            fine: layer("fine"),
            share: layer("share"),
        })
    }

    /// Packs the layers' weights for prediction.
    pub(super) fn pack(&mut self, precision: Precision) -> Result<(), NnError> {
        self.scene.pack(precision)?;
        for layer in [&mut self.seen, &mut self.fine, &mut self.share] {
            layer.pack(precision)?;
        }
        Ok(())
    }

    /// What the encoder's first layer adds for these contexts, `[contexts, H/2, W/2, …]`.
    pub(super) fn now(&self, contexts: &mut EncoderViews, levels: &FrameLevels) -> Result<Tensor, NnError> {
        let is_known = known_poses(&mut contexts.poses);
        let half = contexts.spec.image_size().shrunk(2);
        let count = contexts.count();
        let content = self.scene.content_now(contexts)?;
        let content = Tensor::from_vec(content, (count, half.height, half.width, BLOCK_PIXELS), &Device::Cpu)?;
        let added = activated_convolution(&self.seen, &levels.counted(&content)?, Activation::None, None)?;
        Ok(added.broadcast_mul(&Tensor::from_vec(is_known, (count, 1, 1, 1), &Device::Cpu)?)?)
    }

    /// What the scene `[M, H/2, W/2, SCENE_CHANNELS]` at the items, seen from [`known_poses`], gives to their frames.
    pub(super) fn recall(&self, scene: &Tensor, is_known: Vec<f32>, levels: &FrameLevels) -> Result<Recalled, NnError> {
        let count = is_known.len();
        let is_known = Tensor::from_vec(is_known, (count, 1), &Device::Cpu)?;
        let counted = levels.counted(&content_blocks(scene)?)?;
        let read = Tensor::cat(&[&scene.narrow(3, 0, SCENE_FEATURES)?, &counted], 3)?;
        let fine = activated_convolution(&self.fine, &read, Activation::None, None)?;
        Ok(Recalled {
            content: pixel_shuffle(&counted)?.flatten_from(1)?,
            intensities: content_frames(scene)?,
            fine: fine.broadcast_mul(&is_known.reshape((count, 1, 1, 1))?)?,
            is_known,
        })
    }

    /// The frames `[M, P]` with what is remembered mixed in, as the fine layer's values `[M, H/2, W/2, …]` say.
    pub(super) fn mix(&self, frames: &Tensor, fine: &Tensor, recalled: &Recalled) -> Result<Tensor, NnError> {
        let logits = activated_convolution(&self.share, fine, Activation::Silu, None)?;
        let logits = pixel_shuffle(&logits)?.flatten_from(1)?;
        Ok(mixed(frames, &logits, &recalled.content, &recalled.is_known)?)
    }
}

/// Frames and remembered pixels, mixed by the logits; all `[M, P]`, and `is_known` `[M, 1]`.
pub(super) fn mixed(frames: &Tensor, logits: &Tensor, content: &Tensor, is_known: &Tensor) -> TensorResult<Tensor> {
    // The sigmoid by a function that graphics cards have too.
    let share = (logits - SHARE_LOGIT)?.affine(0.5, 0.0)?.tanh()?.affine(0.5, 0.5)?;
    let share = share.broadcast_mul(is_known)?;
    frames + (share * (content - frames)?)?
}

/// Puts the origin where a pose is not known. 1 for each that is, else 0.
pub(super) fn known_poses(poses: &mut [CameraPose]) -> Vec<f32> {
    let each = poses.iter_mut().map(|pose| {
        let is_known = [pose.x, pose.y, pose.heading].iter().all(|part| part.is_finite());
        if !is_known {
            *pose = CameraPose::default();
        }
        f32::from(u8::from(is_known))
    });
    each.collect()
}
