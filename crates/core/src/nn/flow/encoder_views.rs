//! The contexts that the encoder reads, in the view of their last frames.

use super::blocks::write_blocks;
use crate::frame::warp::CameraModel;
use crate::nn::geometry::camera::{CameraPose, Viewer};
use crate::nn::geometry::state_channels::StateChannels;
use crate::nn::geometry::turning::turned;
use crate::nn::ops::sampling::{PixelPlaces, centred, own_places};
use crate::nn::spec::ModelSpec;

/// The contexts that are encoded, each once.
pub(super) struct EncoderViews<'a> {
    pub(super) spec: &'a ModelSpec,
    /// How many frames are read of each.
    pub(super) frames_read: usize,
    /// The last frame of each `[contexts, P]`.
    pub(super) last_frames: Vec<f32>,
    /// The frames before it, latest first `[contexts, frames_read - 1, P]`; the oldest repeats where the context is shorter.
    pub(super) earlier: Vec<f32>,
    /// The state at the last frame of each.
    pub(super) states: Vec<Vec<f32>>,
    /// Where the camera stands then.
    pub(super) poses: Vec<CameraPose>,
    /// Where it stood at the earlier frames, as seen from there `[contexts, frames_read - 1]`: yaw, ahead, left.
    pub(super) motions_back: Vec<[f32; 3]>,
    /// The camera, where it is known.
    pub(super) cameras: Vec<Option<CameraModel>>,
}

impl EncoderViews<'_> {
    /// Number of contexts.
    pub(super) fn count(&self) -> usize {
        self.poses.len()
    }

    /// Channels of [`EncoderViews::inputs`]: 2×2 blocks of the frames read and of the scene, and the place in the frame.
    pub(super) fn channels(frames_read: usize) -> usize {
        4 * (frames_read + 1) + 2
    }

    /// The inputs of the encoder `[contexts, H/2, W/2, channels]`: blocks of the last frames, then of the scene without movers
    /// (`seen`, `[contexts, H/2, W/2, 4]`). Earlier frames are turned into the last one's view by the measured yaw rate.
    pub(super) fn inputs(&self, camera: Option<CameraModel>, seen: &[f32]) -> Vec<f32> {
        let size = self.spec.image_size();
        let (half, pixels) = (size.shrunk(2), size.pixels());
        let own = own_places(size);
        let (frames_read, channels) = (self.frames_read, Self::channels(self.frames_read));
        let mut inputs = vec![0.0; self.count() * half.pixels() * channels];
        for (index, inputs) in inputs.chunks_exact_mut(half.pixels() * channels).enumerate() {
            let yaw_rate = StateChannels::of(self.spec).yaw_rate_in(&self.states[index]);
            write_blocks(
                &self.last_frames[index * pixels..][..pixels],
                size,
                PixelPlaces::Pairs(&own),
                inputs,
                0,
            );
            for back in 1..frames_read {
                let frame = &self.earlier[(index * (frames_read - 1) + back - 1) * pixels..][..pixels];
                let before = yaw_rate.zip(camera).map(|(rate, camera)| {
                    let yaw = rate * self.spec.frame_period_s as f32 * back as f32;
                    turned(Viewer::new(camera, size), &[yaw])
                });
                let places = PixelPlaces::Pairs(before.as_ref().unwrap_or(&own));
                write_blocks(frame, size, places, inputs, 4 * back);
            }
            let seen = &seen[index * half.pixels() * 4..(index + 1) * half.pixels() * 4];
            for (place, (out, seen)) in inputs.chunks_exact_mut(channels).zip(seen.chunks_exact(4)).enumerate() {
                out[4 * frames_read..4 * frames_read + 4].copy_from_slice(seen);
                out[channels - 2] = centred(place % half.width, half.width);
                out[channels - 1] = centred(place / half.width, half.height);
            }
        }
        inputs
    }
}
