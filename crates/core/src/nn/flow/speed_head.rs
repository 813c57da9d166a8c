//! The layers that estimate from the frames how fast the camera drives and turns, for robots that do not tell.
//!
//! Each place of the quarter grid votes for both speeds and says how much its vote counts. It reads the frames as they are, and how
//! far its pixels would shift if the camera turned or drove by a little.

use candle_core::{Device, Tensor};

use super::depth_views::{KNOWN_VALUES, count_from, depths_before_learning, known, levels, put, put_blocks, shift};
use super::encoder_views::EncoderViews;
use crate::frame::warp::CameraModel;
use crate::nn::error::NnError;
use crate::nn::geometry::camera::{Viewer, rotated};
use crate::nn::geometry::viewer_rays::ViewerRays;
use crate::nn::model_tensors::ModelTensors;
use crate::nn::ops::activated_convolution::{Activation, activated_convolution};
use crate::nn::ops::convolution::Convolution3;
use crate::nn::ops::image_geometry::ConvShape;
use crate::nn::ops::linear::{Linear, per_place};
use crate::nn::ops::modulation::silu;
use crate::nn::ops::sampling::ImageSize;
use crate::nn::precision::Precision;

/// Channels of the layers.
pub(super) const SPEED_CHANNELS: usize = 32;
/// Numbers of a place: a vote for each speed, and the logarithm of how much each counts.
pub(super) const VOTE_VALUES: usize = 4;
/// The speeds, in m/s and rad/s, that one unit of a vote stands for.
const VOTE_UNITS: [f32; 2] = [0.5, 1.0];
/// The motions whose shifts are read: a turn in radians, and a way ahead in metres.
const SHIFTING: [[f32; 2]; 2] = [[0.1, 0.0], [0.0, 0.1]];

/// Channels that the layers read: 2×2 blocks of the frames, the shifts of both motions, and what is known of the block.
pub(super) fn speed_channels(frames_read: usize) -> usize {
    4 * frames_read + 2 * SHIFTING.len() + KNOWN_VALUES
}

/// The layers.
#[derive(Clone, Debug)]
pub(super) struct SpeedHead {
    pub(super) halving: Convolution3,
    pub(super) blocks: [Convolution3; 2],
    pub(super) votes: Linear,
}

impl SpeedHead {
    pub(super) fn new(tensors: &ModelTensors) -> Self {
        let block = |index: usize| {
            let name = format!("flow.speeds.{index}");
            tensors.convolution(&name, ConvShape::dilated(2 << index))
        };
        Self {
            halving: tensors.convolution("flow.speeds.halving", ConvShape::HALVING),
            blocks: [block(0), block(1)],
            votes: tensors.linear("flow.speeds.votes"),
        }
    }

    /// Packs the layers' weights for prediction.
    pub(super) fn pack(&mut self, precision: Precision) -> Result<(), NnError> {
        for convolution in self.blocks.iter_mut().chain([&mut self.halving]) {
            convolution.pack(precision)?;
        }
        Ok(self.votes.pack(precision.at_least_bf16())?)
    }

    /// Forward speed in m/s and yaw rate in rad/s at the last frame of each context `[contexts, 2]`.
    pub(super) fn forward(&self, contexts: &EncoderViews) -> Result<Tensor, NnError> {
        let half = contexts.spec.image_size().shrunk(2);
        let shape = (contexts.count(), half.height, half.width, ());
        let inputs = Tensor::from_vec(speed_inputs(contexts), shape, &Device::Cpu)?;
        let mut features = activated_convolution(&self.halving, &inputs, Activation::None, None)?;
        for block in &self.blocks {
            features = activated_convolution(block, &features, Activation::Silu, Some(&features))?;
        }
        let votes = per_place(&self.votes, &silu(&features)?)?;
        Ok(counted(&votes.flatten(1, 2)?.transpose(1, 2)?.contiguous()?)?)
    }
}

/// The speeds `[contexts, 2]` that the votes `[contexts, VOTE_VALUES, places]` give: their means, weighted by how much each counts.
pub(super) fn counted(votes: &Tensor) -> candle_core::Result<Tensor> {
    let weights = candle_nn::ops::softmax(&votes.narrow(1, 2, 2)?.contiguous()?, 2)?;
    let speeds = (votes.narrow(1, 0, 2)?.contiguous()? * weights)?.sum(2)?;
    speeds.broadcast_mul(&Tensor::new(&VOTE_UNITS, votes.device())?)
}

/// What the layers read of each context `[contexts, H/2, W/2, channels]`.
pub(super) fn speed_inputs(contexts: &EncoderViews) -> Vec<f32> {
    let size = contexts.spec.image_size();
    let (half, pixels) = (size.shrunk(2), size.pixels());
    let (frames_read, channels) = (contexts.frames_read, speed_channels(contexts.frames_read));
    let mut all = vec![0.0; contexts.count() * half.pixels() * channels];
    for (index, inputs) in all.chunks_exact_mut(half.pixels() * channels).enumerate() {
        let camera = contexts.cameras[index].unwrap_or(CameraModel::USUAL);
        let height_m = camera.height_m.unwrap_or(CameraModel::USUAL_HEIGHT_M);
        let camera = ViewerRays::of(Viewer::new(camera, size));
        let depths = depths_before_learning(&camera.rays, height_m);
        let mut frame = contexts.last_frames[index * pixels..(index + 1) * pixels].to_vec();
        let levels = levels(&frame);
        count_from(&mut frame, levels);
        put_blocks(&frame, size, inputs, 0);
        for back in 1..frames_read {
            let first = (index * (frames_read - 1) + back - 1) * pixels;
            frame.copy_from_slice(&contexts.earlier[first..first + pixels]);
            count_from(&mut frame, levels);
            put_blocks(&frame, size, inputs, 4 * back);
        }
        for (nth, motion) in SHIFTING.into_iter().enumerate() {
            put(
                &shifts(&camera, size, &depths, motion),
                2,
                inputs,
                4 * frames_read + 2 * nth,
            );
        }
        put(&known(size, &depths), KNOWN_VALUES, inputs, channels - KNOWN_VALUES);
    }
    all
}

/// How far each 2×2 block would shift if the camera turned and drove ahead, at those depths.
fn shifts(camera: &ViewerRays, size: ImageSize, depths: &[f32], [turn, ahead]: [f32; 2]) -> Vec<f32> {
    let half = size.shrunk(2);
    let mut shifts = vec![0.0; half.pixels() * 2];
    let (sin, cos) = (-turn).sin_cos();
    for (pixel, (ray, depth)) in camera.rays.iter().zip(depths).enumerate() {
        let (row, column) = (pixel / size.width, pixel % size.width);
        let point = [depth * ray[0] - ahead, depth * ray[1], depth * ray[2]];
        let [x, y] = camera.viewer.project(rotated(point, sin, cos));
        let block = row / 2 * half.width + column / 2;
        shifts[2 * block] += shift(x - column as f32);
        shifts[2 * block + 1] += shift(y - row as f32);
    }
    shifts
}
