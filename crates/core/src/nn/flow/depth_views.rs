//! The encoder's inputs for depth: the context's frames, moved into the view of the last one with a first guess of the depth, and
//! how much each would shift at a greater depth.
//!
//! Subtracts the last frame's mean from all frames and divides by its standard deviation, so that a darker or brighter room
//! looks the same.
// A closure's vector instructions reach what is inlined into it, and only that.
#![allow(clippy::inline_always)]

use candle_core::{Device, Result, Tensor};
use rayon::prelude::*;

use super::encoder_views::EncoderViews;
use crate::frame::warp::CameraModel;
use crate::nn::geometry::camera::{Viewer, rotated};
use crate::nn::geometry::viewer_rays::ViewerRays;
use crate::nn::ops::gathering::{OfPlaces, SAMPLED_TOGETHER, read_together, write_together};
use crate::nn::ops::sampling::{ImageSize, SampledImage, centred};
use crate::vectorized::vectorized_by;

/// Distance of everything that the floor does not explain, before anything is learned.
pub(super) const WALL_M: f32 = 2.2;
/// The change of depth whose shift the encoder reads.
pub(super) const FARTHER: f32 = 1.25;
/// Pixels of shift that count as 1.
pub(super) const SHIFT_PX: f32 = 4.0;
/// The most that counts of them: what is behind the camera would shift without end.
pub(super) const MAX_SHIFT: f32 = 4.0;
/// Smallest spread of a frame's intensities.
pub(super) const MIN_SPREAD: f32 = 0.04;
/// What is known of a 2×2 block: column, row, inverse of the depth before anything is learned.
pub(super) const KNOWN_VALUES: usize = 3;

/// The contexts as the encoder reads them.
pub(super) struct DepthViews {
    /// `[contexts, H/2, W/2, channels]`.
    pub(super) inputs: Vec<f32>,
    /// The last frames, from mean and in spread `[contexts, P]`.
    pub(super) frames: Vec<f32>,
    /// Mean and spread of the last frames.
    pub(super) levels: Vec<[f32; 2]>,
    /// Depth before anything is learned `[contexts, P]`, in metres.
    pub(super) depths: Vec<f32>,
    /// Column, row and inverse depth of each 2×2 block `[contexts, H/2, W/2, KNOWN_VALUES]`.
    pub(super) known: Vec<f32>,
    /// The cameras.
    pub(super) cameras: Vec<ViewerRays>,
}

impl DepthViews {
    /// Channels of the inputs: 2×2 blocks of the frames read, the shift of each earlier one, and the place.
    pub(super) fn channels(frames_read: usize) -> usize {
        4 * frames_read + 2 * (frames_read - 1) + KNOWN_VALUES
    }

    pub(super) fn of(contexts: &EncoderViews) -> Self {
        let size = contexts.spec.image_size();
        let (half, pixels) = (size.shrunk(2), size.pixels());
        let channels = Self::channels(contexts.frames_read);
        let mut views = Self {
            inputs: vec![0.0; contexts.count() * half.pixels() * channels],
            frames: contexts.last_frames.clone(),
            levels: Vec::new(),
            depths: Vec::new(),
            known: Vec::new(),
            cameras: Vec::new(),
        };
        let earlier = contexts.frames_read - 1;
        for index in 0..contexts.count() {
            let camera = contexts.cameras[index].unwrap_or(CameraModel::USUAL);
            let height_m = camera.height_m.unwrap_or(CameraModel::USUAL_HEIGHT_M);
            let camera = ViewerRays::of(Viewer::new(camera, size));
            let depths = depths_before_learning(&camera.rays, height_m);
            let frame = &mut views.frames[index * pixels..(index + 1) * pixels];
            let levels = levels(frame);
            count_from(frame, levels);
            let known = known(size, &depths);
            let inputs = &mut views.inputs[index * half.pixels() * channels..][..half.pixels() * channels];
            put_blocks(frame, size, inputs, 0);
            let each = (0..earlier).into_par_iter().map(|back| {
                let first = (index * earlier + back) * pixels;
                let mut seen = contexts.earlier[first..first + pixels].to_vec();
                count_from(&mut seen, levels);
                let motion = contexts.motions_back[index * earlier + back];
                moved_back(&camera, size, &depths, motion, [frame, &seen])
            });
            for (back, (moved, shifts)) in each.collect::<Vec<_>>().into_iter().enumerate() {
                put_blocks(&moved, size, inputs, 4 * (back + 1));
                put(&shifts, 2, inputs, 4 * (earlier + 1) + 2 * back);
            }
            put(&known, KNOWN_VALUES, inputs, channels - KNOWN_VALUES);
            views.levels.push(levels);
            views.depths.extend(depths);
            views.known.extend(known);
            views.cameras.push(camera);
        }
        views
    }
}

/// Means and spreads of last frames as tensors, one for each item, `[M, 1]`.
pub(super) struct FrameLevels {
    mean: Tensor,
    spread: Tensor,
}

impl FrameLevels {
    pub(super) fn of(levels: &[[f32; 2]]) -> Result<Self> {
        let part = |part: usize| {
            let values: Vec<f32> = levels.iter().map(|levels| levels[part]).collect();
            Tensor::from_vec(values, (levels.len(), 1), &Device::Cpu)
        };
        Ok(Self {
            mean: part(0)?,
            spread: part(1)?,
        })
    }

    /// Intensities of blocks `[M, H/2, W/2, …]`, counted from the mean in the spread.
    pub(super) fn counted(&self, blocks: &Tensor) -> Result<Tensor> {
        let over_blocks = |level: &Tensor| level.unsqueeze(2)?.unsqueeze(3);
        blocks
            .broadcast_sub(&over_blocks(&self.mean)?)?
            .broadcast_div(&over_blocks(&self.spread)?)
    }

    /// Frames `[M, P]` that were counted so, as intensities.
    pub(super) fn intensities(&self, counted: &Tensor) -> Result<Tensor> {
        counted.broadcast_mul(&self.spread)?.broadcast_add(&self.mean)
    }
}

/// Mean and spread of a frame.
pub(super) fn levels(frame: &[f32]) -> [f32; 2] {
    let count = frame.len() as f32;
    let mean = sum_of(frame, |value| value) / count;
    let variance = sum_of(frame, |value| (value - mean).powi(2)) / count;
    [mean, variance.sqrt().max(MIN_SPREAD)]
}

/// The sum of a function of each value, as several sums, which do not wait for each other.
fn sum_of(values: &[f32], of: impl Fn(f32) -> f32) -> f32 {
    let (vectors, rest) = values.as_chunks::<SAMPLED_TOGETHER>();
    let mut sums = [0.0; SAMPLED_TOGETHER];
    for vector in vectors {
        for (sum, &value) in sums.iter_mut().zip(vector) {
            *sum += of(value);
        }
    }
    sums.iter().sum::<f32>() + rest.iter().map(|&value| of(value)).sum::<f32>()
}

pub(super) fn count_from(frame: &mut [f32], [mean, spread]: [f32; 2]) {
    for value in frame {
        *value = (*value - mean) / spread;
    }
}

/// The depth of each pixel, in metres, if there were only the floor and a wall around the camera.
pub(super) fn depths_before_learning(rays: &[[f32; 3]], height_m: f32) -> Vec<f32> {
    let depth = |&[ahead, left, up]: &[f32; 3]| {
        // The bits of glibc's `hypotf`, without a call.
        let level = (f64::from(ahead).powi(2) + f64::from(left).powi(2)).sqrt() as f32;
        let wall = WALL_M / level.max(1e-3);
        if up < 0.0 { wall.min(height_m / -up) } else { wall }
    };
    rays.iter().map(depth).collect()
}

/// Column, row and inverse depth of each 2×2 block.
pub(super) fn known(size: ImageSize, depths: &[f32]) -> Vec<f32> {
    let half = size.shrunk(2);
    let mut known = Vec::with_capacity(half.pixels() * KNOWN_VALUES);
    for row in 0..half.height {
        for column in 0..half.width {
            let depth = |dy: usize, dx: usize| 1.0 / depths[(2 * row + dy) * size.width + 2 * column + dx];
            let inverse = (depth(0, 0) + depth(0, 1) + depth(1, 0) + depth(1, 1)) / 4.0;
            known.extend([centred(column, half.width), centred(row, half.height), inverse]);
        }
    }
    known
}

/// An earlier frame in the view of the last one, for those depths; the last one's pixel where it saw nothing. Beside it,
/// how far each block would shift if it were farther away.
fn moved_back(
    camera: &ViewerRays,
    size: ImageSize,
    depths: &[f32],
    motion: [f32; 3],
    [last, earlier]: [&[f32]; 2],
) -> (Vec<f32>, Vec<f32>) {
    let (half, width) = (size.shrunk(2), size.width);
    let earlier_view = EarlierView::new(camera.viewer, motion);
    let (mut moved, mut shifts) = (last.to_vec(), vec![0.0; half.pixels() * 2]);
    vectorized_by(
        #[inline(always)]
        |instructions| {
            let earlier = SampledImage {
                size,
                pixels: earlier,
                instructions,
            };
            for (row, moved) in moved.chunks_exact_mut(width).enumerate() {
                let first = (row * width..(row + 1) * width).step_by(SAMPLED_TOGETHER);
                let blocks = shifts[row / 2 * width..][..width].chunks_mut(SAMPLED_TOGETHER);
                for ((first, moved), shifts) in first.zip(moved.chunks_mut(SAMPLED_TOGETHER)).zip(blocks) {
                    let (rays, depths) = (camera.together(first), read_together(depths, first));
                    let near = earlier_view.places(rays, &depths, 1.0);
                    let far = earlier_view.places(rays, &depths, FARTHER);
                    put_shown(earlier, &near, moved);
                    add_shifts([&near, &far], shifts);
                }
            }
        },
    );
    (moved, shifts)
}

/// An earlier frame's camera, and how it has moved since.
struct EarlierView {
    viewer: Viewer,
    sin: f32,
    cos: f32,
    ahead: f32,
    left: f32,
}

impl EarlierView {
    fn new(viewer: Viewer, [yaw, ahead, left]: [f32; 3]) -> Self {
        let (sin, cos) = (-yaw).sin_cos();
        Self {
            viewer,
            sin,
            cos,
            ahead,
            left,
        }
    }

    /// Where it shows what some neighbouring rays meet at these depths, `farther` times as deep.
    #[inline(always)]
    fn places(&self, rays: [&OfPlaces; 3], depths: &OfPlaces, farther: f32) -> [OfPlaces; 2] {
        let mut points = [[0.0; SAMPLED_TOGETHER]; 3];
        for at in 0..SAMPLED_TOGETHER {
            let depth = farther * depths[at];
            let point = [
                depth * rays[0][at] - self.ahead,
                depth * rays[1][at] - self.left,
                depth * rays[2][at],
            ];
            [points[0][at], points[1][at], points[2][at]] = rotated(point, self.sin, self.cos);
        }
        self.viewer.project_together(&points)
    }
}

/// Writes the pixels at places of a frame, if it shows them.
#[inline(always)]
fn put_shown(frame: SampledImage, places: &[OfPlaces; 2], moved: &mut [f32]) {
    let mut shown = read_together(moved, 0);
    let sampled = frame.sample(places);
    for at in 0..SAMPLED_TOGETHER {
        if frame.size.shows([places[0][at], places[1][at]]) {
            shown[at] = sampled[at];
        }
    }
    write_together(&shown, moved, 0);
}

/// Adds how far some pixels of a row shift from near to far to the shifts of their blocks.
#[inline(always)]
fn add_shifts([near, far]: [&[OfPlaces; 2]; 2], shifts: &mut [f32]) {
    for axis in 0..2 {
        let mut of_pixels = [0.0; SAMPLED_TOGETHER];
        for at in 0..SAMPLED_TOGETHER {
            of_pixels[at] = shift(far[axis][at] - near[axis][at]);
        }
        for (shifts, pair) in shifts.chunks_exact_mut(2).zip(of_pixels.as_chunks::<2>().0) {
            shifts[axis] += pair[0];
            shifts[axis] += pair[1];
        }
    }
}

/// What a pixel's shift adds to the mean of its block's four.
#[inline(always)]
pub(super) fn shift(pixels: f32) -> f32 {
    (pixels / SHIFT_PX).clamp(-MAX_SHIFT, MAX_SHIFT) / 4.0
}

/// Writes each 2×2 block of a frame to four channels of its place, from channel `first` on.
pub(super) fn put_blocks(frame: &[f32], size: ImageSize, out: &mut [f32], first: usize) {
    let half = size.shrunk(2);
    let channels = out.len() / half.pixels();
    for (row, pixels) in frame.chunks_exact(size.width).enumerate() {
        let blocks = out[row / 2 * half.width * channels..].chunks_exact_mut(channels);
        for (block, pair) in blocks.zip(pixels.as_chunks::<2>().0) {
            block[first + row % 2 * 2..][..2].copy_from_slice(pair);
        }
    }
}

/// Writes `each` values of each place to its channels from `first` on.
pub(super) fn put(values: &[f32], each: usize, out: &mut [f32], first: usize) {
    let places = values.chunks_exact(each);
    let channels = out.len() / places.len();
    for (out, values) in out.chunks_exact_mut(channels).zip(places) {
        out[first..first + each].copy_from_slice(values);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: ImageSize = ImageSize { height: 8, width: 8 };

    #[test]
    fn the_floor_is_as_deep_as_the_camera_is_high() {
        let camera = CameraModel::new(1.0, 0.3).unwrap();
        let viewer = Viewer::new(camera, SIZE);
        let depths = depths_before_learning(&viewer.rays(), 0.5);
        let lowest = viewer.rays()[SIZE.pixels() - 1];
        assert!((depths[SIZE.pixels() - 1] * lowest[2] + 0.5).abs() < 1e-5);
        assert!((depths[0] * level_length(viewer.rays()[0]) - WALL_M).abs() < 1e-4);
    }

    fn level_length([ahead, left, _]: [f32; 3]) -> f32 {
        ahead.hypot(left)
    }

    #[test]
    fn a_frame_seen_from_the_same_place_stays() {
        let camera = ViewerRays::of(Viewer::new(CameraModel::new(1.0, 0.3).unwrap(), SIZE));
        let frame: Vec<f32> = (0..64).map(|pixel| pixel as f32).collect();
        let depths = depths_before_learning(&camera.rays, 0.5);
        let (moved, shifts) = moved_back(&camera, SIZE, &depths, [0.0; 3], [&[0.0; 64], &frame]);
        assert!(moved.iter().zip(&frame).all(|(a, b)| (a - b).abs() < 1e-3));
        assert!(shifts.iter().all(|shift| shift.abs() < 1e-4));
    }

    #[test]
    fn a_moved_camera_gives_the_bits_of_each_pixel_alone() {
        let size = ImageSize { height: 8, width: 20 };
        let camera = ViewerRays::of(Viewer::new(CameraModel::new(1.0, 0.3).unwrap(), size));
        let depths = depths_before_learning(&camera.rays, 0.5);
        let [last, earlier] = [3, 7].map(|step| (0..160).map(|pixel| (pixel * step % 11) as f32).collect::<Vec<f32>>());
        let [yaw, ahead, left] = [-0.15, -0.2, 0.05];
        let (moved, shifts) = moved_back(&camera, size, &depths, [yaw, ahead, left], [&last, &earlier]);
        let (sin, cos) = (-yaw).sin_cos();
        let place = |pixel: usize, farther: f32| {
            let [x, y, z] = camera.rays[pixel].map(|part| farther * depths[pixel] * part);
            camera.viewer.project(rotated([x - ahead, y - left, z], sin, cos))
        };
        let mut expected = vec![0.0; shifts.len()];
        let mut shown = 0;
        for pixel in 0..size.pixels() {
            let (near, far) = (place(pixel, 1.0), place(pixel, FARTHER));
            let is_shown = size.shows(near);
            shown += usize::from(is_shown);
            let value = if is_shown {
                size.around(near[0], near[1]).sample(&earlier)
            } else {
                last[pixel]
            };
            assert_eq!(moved[pixel], value, "{pixel}");
            let block = pixel / size.width / 2 * (size.width / 2) + pixel % size.width / 2;
            for axis in 0..2 {
                expected[2 * block + axis] += shift(far[axis] - near[axis]);
            }
        }
        assert!(shown > 80 && shown < 160, "{shown}");
        assert_eq!(shifts, expected);
    }
}
