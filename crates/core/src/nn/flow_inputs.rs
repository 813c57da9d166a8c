//! What the flow network reads, laid out: the futures of a batch, the contexts they follow, and frames cut into blocks.

use std::ops::Range;
use std::sync::Arc;

use candle_core::{Device, Tensor};

use super::conditioned::ConditioningTensors;
use super::motion::StateChannels;
use super::rays::{CameraPose, Viewer, own_places};
use super::sampling::ImageSize;
use super::tensors::with_values;
use super::{ModelSpec, NnError};

/// The futures to predict: windows, actions and states in their own units.
pub(super) struct FutureRows {
    /// Frames of all windows `[B, context, P]`.
    frames: Arc<Vec<f32>>,
    /// The window of each future.
    windows: Vec<u32>,
    /// `[N, horizon, A]`; empty without conditioning.
    actions: Vec<f32>,
    /// `[N, S]`; empty without state.
    states: Vec<f32>,
    action_count: usize,
    state_count: usize,
}

impl FutureRows {
    /// Errors: `Shape`, `Missing` where the conditioning does not fit; `Tensor` if a window does not exist.
    pub(super) fn new(
        spec: &ModelSpec,
        frames: &Tensor,
        windows: &[u32],
        conditioning: &ConditioningTensors,
    ) -> Result<Self, NnError> {
        let count = frames.dim(0)?;
        if let Some(window) = windows.iter().find(|&&window| window as usize >= count) {
            return Err(candle_core::Error::Msg(format!("there is no window {window}; there are {count}")).into());
        }
        let (actions, states) = conditioning.raw(spec, windows.len())?;
        Ok(Self {
            frames: Arc::new(with_values(frames, <[f32]>::to_vec)?),
            windows: windows.to_vec(),
            actions,
            states,
            action_count: spec.action_inputs().unwrap_or(0),
            state_count: spec.state_inputs().unwrap_or(0),
        })
    }

    /// Number of futures, N.
    pub(super) fn count(&self) -> usize {
        self.windows.len()
    }

    /// Some of the futures.
    pub(super) fn part(&self, range: Range<usize>) -> Self {
        let all = self.count();
        let cut = |values: &[f32]| {
            let each = values.len() / all;
            values[range.start * each..range.end * each].to_vec()
        };
        Self {
            frames: Arc::clone(&self.frames),
            windows: self.windows[range.clone()].to_vec(),
            actions: cut(&self.actions),
            states: cut(&self.states),
            ..*self
        }
    }

    /// The state of a future, empty where the model takes none.
    pub(super) fn state(&self, row: usize) -> &[f32] {
        &self.states[row * self.state_count..(row + 1) * self.state_count]
    }

    /// The actions of a future, step after step; empty where the model takes none.
    pub(super) fn actions(&self, row: usize) -> &[f32] {
        let each = self.actions.len() / self.count();
        &self.actions[row * each..(row + 1) * each]
    }

    /// Components of an action that the model takes.
    pub(super) fn action_count(&self) -> usize {
        self.action_count
    }

    /// Where the state says that the camera stands at the last frame of a future's context.
    pub(super) fn pose(&self, spec: &ModelSpec, row: usize) -> CameraPose {
        StateChannels::of(spec).pose_in(self.state(row))
    }

    /// Where the camera will stand at each step of each future.
    pub(super) fn future_poses(&self, spec: &ModelSpec, motions: &[[f32; 3]]) -> Vec<CameraPose> {
        let pose = |(item, &motion): (usize, &[f32; 3])| self.pose(spec, item / spec.horizon).moved(motion);
        motions.iter().enumerate().map(pose).collect()
    }

    /// State and all actions of each future, scaled, `[N, S + horizon · A]`.
    pub(super) fn scaled(&self, spec: &ModelSpec) -> Result<Tensor, NnError> {
        let rows: Vec<f32> = (0..self.count()).flat_map(|row| self.scaled_row(spec, row)).collect();
        let width = self.state_count + spec.horizon * self.action_count;
        Ok(Tensor::from_vec(rows, (self.count(), width), &Device::Cpu)?)
    }

    /// The scaled state of each future.
    pub(super) fn scaled_states(&self, spec: &ModelSpec) -> Vec<Vec<f32>> {
        (0..self.count())
            .map(|row| spec.scaled_state(self.state(row)))
            .collect()
    }

    fn scaled_row(&self, spec: &ModelSpec, row: usize) -> Vec<f32> {
        let state = self.state(row).iter().zip(&spec.states);
        let actions = self.actions(row).iter().zip(spec.actions.iter().cycle());
        state
            .chain(actions)
            .map(|(value, channel)| channel.scaled(*value))
            .collect()
    }

    /// Per item: the scaled state, the scaled actions up to the step (zero after it) and which step it is, `[M, …]`.
    pub(super) fn step_inputs(&self, spec: &ModelSpec) -> Result<Tensor, NnError> {
        let horizon = spec.horizon;
        let width = self.state_count + horizon * self.action_count + horizon;
        let mut values = Vec::with_capacity(self.count() * horizon * width);
        for row in 0..self.count() {
            let scaled = self.scaled_row(spec, row);
            for step in 0..horizon {
                let taken = self.state_count + (step + 1) * self.action_count;
                values.extend(
                    scaled
                        .iter()
                        .enumerate()
                        .map(|(at, value)| if at < taken { *value } else { 0.0 }),
                );
                values.extend((0..horizon).map(|other| f32::from(u8::from(other == step))));
            }
        }
        Ok(Tensor::from_vec(values, (self.count() * horizon, width), &Device::Cpu)?)
    }

    /// The contexts that the futures follow. Futures of one window and state share one.
    pub(super) fn contexts(&self, spec: &ModelSpec) -> EncoderViews {
        let size = spec.image_size();
        let (pixels, context, frames_read) = (size.pixels(), spec.context, spec.flow_layers().frames_read);
        let (mut row_of, mut firsts) = (Vec::with_capacity(self.count()), Vec::<usize>::new());
        for row in 0..self.count() {
            let same =
                |&first: &usize| self.windows[first] == self.windows[row] && self.state(first) == self.state(row);
            let known = firsts.last().as_ref().is_some_and(|first| same(first));
            if !known {
                firsts.push(row);
            }
            row_of.push((firsts.len() - 1) as u32);
        }
        let mut views = EncoderViews {
            row_of,
            frames_read,
            last_frames: Vec::with_capacity(firsts.len() * pixels),
            earlier: Vec::new(),
            states: Vec::new(),
            poses: Vec::new(),
        };
        for &row in &firsts {
            let frame = |back: usize| {
                let place = self.windows[row] as usize * context + (context - 1).saturating_sub(back);
                &self.frames[place * pixels..(place + 1) * pixels]
            };
            views.last_frames.extend_from_slice(frame(0));
            for back in 1..frames_read {
                views.earlier.extend_from_slice(frame(back));
            }
            views.states.push(self.state(row).to_vec());
            views.poses.push(self.pose(spec, row));
        }
        views
    }
}

/// For each item (`steps` for each row) the value of its row.
pub(super) fn repeated(row_of: &[u32], steps: usize) -> Vec<u32> {
    row_of.iter().flat_map(|&row| std::iter::repeat_n(row, steps)).collect()
}

/// The contexts that are encoded, each once.
pub(super) struct EncoderViews {
    /// The context of each future.
    pub(super) row_of: Vec<u32>,
    /// How many frames are read of each.
    frames_read: usize,
    /// The last frame of each `[contexts, P]`.
    pub(super) last_frames: Vec<f32>,
    /// The frames before it, latest first `[contexts, frames_read - 1, P]`; the oldest repeats where the context is shorter.
    earlier: Vec<f32>,
    /// The state at the last frame of each.
    pub(super) states: Vec<Vec<f32>>,
    /// Where the camera stands then.
    pub(super) poses: Vec<CameraPose>,
}

impl EncoderViews {
    /// Number of contexts.
    pub(super) fn count(&self) -> usize {
        self.poses.len()
    }

    /// Channels of [`EncoderViews::inputs`]: 2×2 blocks of the frames read and of the scene, and the place in the frame.
    pub(super) fn channels(frames_read: usize) -> usize {
        4 * (frames_read + 1) + 2
    }

    /// The encoder's inputs `[contexts, H/2, W/2, channels]`: blocks of the last frames, the earlier ones turned into the
    /// last one's view by the measured yaw rate, and of what the scene looks like without what moves (`seen`,
    /// `[contexts, H/2, W/2, 4]`).
    pub(super) fn inputs(&self, spec: &ModelSpec, seen: &[f32]) -> Vec<f32> {
        let size = spec.image_size();
        let (half, pixels) = (size.shrunk(2), size.pixels());
        let own = own_places(size);
        let (frames_read, channels) = (self.frames_read, Self::channels(self.frames_read));
        let mut inputs = vec![0.0; self.count() * half.pixels() * channels];
        for (index, inputs) in inputs.chunks_exact_mut(half.pixels() * channels).enumerate() {
            let turns = StateChannels::of(spec)
                .yaw_rate_in(&self.states[index])
                .zip(spec.camera);
            write_blocks(&self.last_frames[index * pixels..], size, &own, inputs, 0);
            for back in 1..frames_read {
                let frame = &self.earlier[(index * (frames_read - 1) + back - 1) * pixels..];
                let places = turns.map(|(rate, camera)| {
                    let viewer = Viewer::new(camera, size);
                    viewer.turned(&viewer.rays(), rate * spec.frame_period_s as f32 * back as f32)
                });
                write_blocks(frame, size, places.as_ref().unwrap_or(&own), inputs, 4 * back);
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

/// A column or row as −1 to 1.
pub(super) fn centred(at: usize, side: usize) -> f32 {
    (2.0 * at as f32 + 1.0) / side as f32 - 1.0
}

/// Samples a frame at `places` `[P, 2]` and writes each 2×2 block to four channels of its place, from channel `first` on.
fn write_blocks(frame: &[f32], size: ImageSize, places: &[f32], out: &mut [f32], first: usize) {
    let half = size.shrunk(2);
    let channels = out.len() / half.pixels();
    for (row, places) in places.chunks_exact(2 * size.width).enumerate() {
        let out = &mut out[row / 2 * half.width * channels..][..half.width * channels];
        for (out, pair) in out.chunks_exact_mut(channels).zip(places.chunks_exact(4)) {
            let out = &mut out[first + row % 2 * 2..][..2];
            out[0] = size.around(pair[0], pair[1]).sample(frame);
            out[1] = size.around(pair[2], pair[3]).sample(frame);
        }
    }
}

/// The last frames `[contexts, P]` sampled at the items' places `[M, P, 2]`: per 2×2 block its four pixels and the share
/// that lies inside the frame, `[M, H/2, W/2, 5]`.
pub(super) fn sampled_blocks(frames: &[f32], frame_of: &[u32], places: &[f32], size: ImageSize) -> Vec<f32> {
    const CHANNELS: usize = 5;
    let (half, pixels) = (size.shrunk(2), size.pixels());
    let mut out = vec![0.0; frame_of.len() * half.pixels() * CHANNELS];
    let items = out
        .chunks_exact_mut(half.pixels() * CHANNELS)
        .zip(places.chunks_exact(pixels * 2));
    for ((out, places), &frame) in items.zip(frame_of) {
        write_blocks(&frames[frame as usize * pixels..], size, places, out, 0);
        for (row, places) in places.chunks_exact(2 * size.width).enumerate() {
            let out = &mut out[row / 2 * half.width * CHANNELS..][..half.width * CHANNELS];
            for (out, pair) in out.chunks_exact_mut(CHANNELS).zip(places.chunks_exact(4)) {
                let inside = pair.chunks_exact(2).filter(|place| {
                    (0.0..=size.width as f32 - 1.0).contains(&place[0])
                        && (0.0..=size.height as f32 - 1.0).contains(&place[1])
                });
                out[CHANNELS - 1] += 0.25 * inside.count() as f32;
            }
        }
    }
    out
}

/// 2×2 blocks of pixels `[M, H/2, W/2, 4]` as frames `[M, P]`.
pub(super) fn fold_pixels(blocks: &Tensor) -> Result<Tensor, NnError> {
    let frames = super::pixel_shuffle::pixel_shuffle(blocks)?;
    Ok(frames.flatten_from(1)?)
}
