//! How a sprite goes on: across and down by the same layers, step by step.

use candle_core::{Device, Tensor};

use super::layers::{AXES, STEP_VALUES};
use crate::nn::error::NnError;
use crate::nn::model_tensors::ModelTensors;
use crate::nn::ops::linear::Linear;
use crate::nn::ops::modulation::perceptron;
use crate::nn::ops::sampling::ImageSize;
use crate::nn::precision::Precision;
use crate::nn::tensors::with_values;

/// Frames back over which a sprite's last speed is measured.
const SPEED_FRAMES: usize = 3;
/// The number that stands for a speed of one unit per frame.
const SPEED_SCALE: f32 = 5.0;

/// The layers: those that make the first memory, and those of each step.
#[derive(Clone, Debug)]
pub(super) struct SpriteMotion {
    memory: [Linear; 2],
    step: [Linear; 3],
}

/// Where sprites are on each axis, one row for each sprite and axis, in units of the axis. A unit is a quarter of the frame's side.
struct Known {
    /// All that the memory is made of, `[2 · M, …]`.
    inputs: Tensor,
    places: Tensor,
    speeds: Tensor,
}

/// How sprites will have moved since the last frame, and how wide they are spread: to the right and down in pixels, both `[M, steps, 2]`.
pub(super) struct Ways {
    pub(super) moves: Tensor,
    pub(super) widths: Tensor,
}

impl SpriteMotion {
    pub(super) fn new(tensors: &ModelTensors) -> Self {
        let linear = |name: &str| tensors.linear(&format!("sprites.{name}"));
        Self {
            memory: ["inputs", "output"].map(|part| linear(&format!("memory.{part}"))),
            step: ["inputs", "hidden", "output"].map(|part| linear(&format!("step.{part}"))),
        }
    }

    /// Packs the weights of all layers as they are now, for fast prediction.
    pub(super) fn pack(&mut self, precision: Precision) -> Result<(), NnError> {
        for linear in self.memory.iter_mut().chain(&mut self.step) {
            linear.pack(precision.at_least_bf16())?;
        }
        Ok(())
    }

    /// How sprites `[M, H, W]` go on that were, in the earlier frames, as far away as `earlier` says `[M, context − 1, 2]`. No gradients go to either.
    pub(super) fn ways(
        &self,
        sprites: &Tensor,
        earlier: &Tensor,
        size: ImageSize,
        steps: usize,
    ) -> Result<Ways, NnError> {
        let units = [size.width, size.height].map(|side| side as f32 / 4.0);
        let known = Known::new(sprites, earlier, size, units)?;
        let (mut place, mut speed) = (known.places.clone(), known.speeds);
        let mut memory = perceptron(&self.memory, &known.inputs)?;
        let (mut moves, mut widths) = (Vec::new(), Vec::new());
        for _ in 0..steps {
            let told = perceptron(
                &self.step,
                &Tensor::cat(&[&(&place * 2.0)?, &(&speed * 2.0)?, &memory], 1)?,
            )?;
            let number = |at: usize| told.narrow(1, at, 1);
            speed = (speed + number(0)?)?;
            place = (place + ((&speed + number(1)?)? / f64::from(SPEED_SCALE))?)?;
            memory = (memory + told.narrow(1, STEP_VALUES, told.dim(1)? - STEP_VALUES)?)?;
            moves.push((&place - &known.places)?);
            widths.push((softplus(&((number(2)? * 2.0)? - 2.0)?)? + 1.0)?);
        }
        let by_step = |values: &[Tensor]| -> candle_core::Result<Tensor> {
            let values = Tensor::cat(values, 1)?.reshape(((), AXES, steps))?;
            values.transpose(1, 2)?.contiguous()
        };
        let units = Tensor::new(&units, &Device::Cpu)?.reshape((1, 1, AXES))?;
        Ok(Ways {
            moves: by_step(&moves)?.broadcast_mul(&units)?,
            widths: by_step(&widths)?,
        })
    }
}

impl Known {
    fn new(sprites: &Tensor, earlier: &Tensor, size: ImageSize, units: [f32; AXES]) -> Result<Self, NnError> {
        let (rows, past, _) = earlier.dims3()?;
        let measured = SPEED_FRAMES.min(past);
        let middles = with_values(sprites, |sprites| middles(sprites, size))?;
        let (mut inputs, mut places, mut speeds) = (Vec::new(), Vec::new(), Vec::new());
        with_values(earlier, |earlier| {
            for (middle, earlier) in middles.iter().zip(earlier.chunks_exact(AXES * past)) {
                for (axis, unit) in units.into_iter().enumerate() {
                    let ways = earlier.iter().skip(axis).step_by(AXES);
                    let speed = -earlier[AXES * (measured - 1) + axis] / measured as f32;
                    let (place, speed) = (middle[axis] / unit, SPEED_SCALE * speed / unit);
                    inputs.extend([2.0 * place, 2.0 * place * place, speed]);
                    inputs.extend(ways.map(|way| -3.0 * way / unit));
                    places.push(place);
                    speeds.push(speed);
                }
            }
        })?;
        let column = |values: Vec<f32>| Tensor::from_vec(values, (AXES * rows, 1), &Device::Cpu);
        Ok(Self {
            inputs: Tensor::from_vec(inputs, (AXES * rows, ()), &Device::Cpu)?,
            places: column(places)?,
            speeds: column(speeds)?,
        })
    }
}

/// The middle of each picture, its pixels weighted by their squares, from the middle of the frame: to the right and down in pixels.
fn middles(pictures: &[f32], size: ImageSize) -> Vec<[f32; 2]> {
    let of_picture = |picture: &[f32]| {
        let (mut sum, mut across, mut down) = (1e-3, 0.0, 0.0);
        for (row, values) in picture.chunks_exact(size.width).enumerate() {
            for (column, value) in values.iter().enumerate() {
                let weight = value * value;
                sum += weight;
                across += weight * (column as f32 - (size.width as f32 - 1.0) / 2.0);
                down += weight * (row as f32 - (size.height as f32 - 1.0) / 2.0);
            }
        }
        [across / sum, down / sum]
    };
    pictures.chunks_exact(size.pixels()).map(of_picture).collect()
}

/// `ln(1 + e^x)`, without a large exponent.
fn softplus(values: &Tensor) -> candle_core::Result<Tensor> {
    values.relu()? + (values.abs()?.neg()?.exp()? + 1.0)?.log()?
}
