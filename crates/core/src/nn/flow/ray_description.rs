//! What rays meet in the learned room, as the numbers that the scene's layers read.
// A closure's vector instructions reach what is inlined into it, and only that.
#![allow(clippy::inline_always)]

use candle_core::{Result, Shape, Tensor};

use super::room_geometry::{
    MIN_DISTANCE, RoomHit, RoomRay, RoomSides, RoomViews, SIDE_GAIN, SIDES, SeenFrom, ViewInRoom,
};
use crate::nn::fused::{FusedOperation, Operand, apply};
use crate::nn::ops::gathering::{OfPlaces, SAMPLED_TOGETHER, write_rows};
use crate::nn::ops::modulation::PackedPerceptron;
use crate::nn::ops::waves::sin_cos;
use crate::nn::recycled::buffer;
use crate::vectorized::{Instructions, vectorized_by};

/// Octaves of sines and cosines of each coordinate of the point met.
pub(super) const OCTAVES: usize = 5;
/// The lowest frequency, in radians per unit of the room.
pub(super) const LOWEST: f32 = std::f32::consts::FRAC_PI_4;
const WAVES: usize = 3 * 2 * OCTAVES;
/// Numbers that describe one ray: waves, side met, point met, the ray itself and the distance.
pub(super) const RAY_VALUES: usize = WAVES + SIDES + 12;

impl RoomViews {
    /// What each ray meets, described by [`RAY_VALUES`] numbers: `[views · rays, RAY_VALUES]`. `parameter` `[6]` moves the
    /// sides, and gradients go to it.
    pub(super) fn describe(self, parameter: &Tensor) -> Result<Tensor> {
        apply(self, [parameter])
    }

    /// What the layers make of each ray's description, `[views · rays, outputs]`.
    pub(super) fn described_to(&self, layers: &PackedPerceptron, sides: RoomSides) -> Vec<f32> {
        let outputs = layers.outputs();
        let mut seen = buffer(self.rays() * outputs);
        for (view, seen) in self.parts(&mut seen, outputs) {
            let from = self.seen_from(view);
            layers.run(seen, RAY_VALUES, |first, read| {
                describe_rays(view, from, sides, first, read);
            });
        }
        seen
    }
}

/// Writes the descriptions of a view's rays, from the one with that index on.
fn describe_rays(view: &ViewInRoom, from: SeenFrom, sides: RoomSides, first: usize, out: &mut [f32]) {
    vectorized_by(
        #[inline(always)]
        |instructions| {
            let mut values = [[0.0; SAMPLED_TOGETHER]; RAY_VALUES];
            for (part, out) in out.chunks_mut(SAMPLED_TOGETHER * RAY_VALUES).enumerate() {
                let rays = view.camera.together(first + part * SAMPLED_TOGETHER);
                describe_together(rays, from, sides, &mut values, instructions);
                write_rows(&values, out.as_chunks_mut().0, instructions);
            }
        },
    );
}

/// Writes the descriptions of neighbouring rays, by value.
#[inline(always)]
fn describe_together(
    rays: [&OfPlaces; 3],
    from: SeenFrom,
    sides: RoomSides,
    values: &mut [OfPlaces; RAY_VALUES],
    instructions: Instructions,
) {
    for at in 0..SAMPLED_TOGETHER {
        let ray = from.ray([rays[0][at], rays[1][at], rays[2][at]]);
        let hit = sides.hit(ray);
        for axis in 0..3 {
            let (mut sin, mut cos) = sin_cos(LOWEST * hit.point[axis], instructions);
            for octave in 0..OCTAVES {
                let wave = 2 * (axis * OCTAVES + octave);
                values[wave][at] = sin;
                values[wave + 1][at] = cos;
                (sin, cos) = (2.0 * sin * cos, cos * cos - sin * sin);
            }
        }
        for side in 0..SIDES {
            values[WAVES + side][at] = if hit.side == side { 1.0 } else { 0.0 };
        }
        let rest = describe_way(ray, hit);
        for value in 0..rest.len() {
            values[WAVES + SIDES + value][at] = rest[value];
        }
    }
}

/// The point met, the ray and the distance.
#[inline(always)]
fn describe_way(ray: RoomRay, hit: RoomHit) -> [f32; RAY_VALUES - WAVES - SIDES] {
    let RoomRay { origin, direction } = ray;
    let [x, y, z] = direction;
    let level = (x * x + y * y).sqrt().max(1e-6);
    // With the direction, the line's distance from the middle says which line it is: upright things stand on lines.
    let line = (origin[0] * y - origin[1] * x) / level;
    let distance = hit.time * (level * level + z * z).sqrt();
    [
        hit.point[0],
        hit.point[1],
        hit.point[2],
        origin[0],
        origin[1],
        x / level,
        y / level,
        z / level,
        line,
        0.25 * distance,
        0.05 * distance * distance,
        1.0 / (distance + 0.3),
    ]
}

impl FusedOperation<1> for RoomViews {
    const NAME: &'static str = "describe-rays";

    fn forward(&self, [parameter]: [Operand; 1]) -> Result<(Vec<f32>, Shape)> {
        let sides = RoomSides::learned(parameter.values);
        let mut out = vec![0.0; self.rays() * RAY_VALUES];
        for (view, out) in self.parts(&mut out, RAY_VALUES) {
            describe_rays(view, self.seen_from(view), sides, 0, out);
        }
        Ok((out, Shape::from((self.rays(), RAY_VALUES))))
    }

    fn backward(&self, [parameter]: [Operand; 1], y: Operand, gradient: Operand) -> Result<[Option<Vec<f32>>; 1]> {
        let sides = RoomSides::learned(parameter.values);
        let mut sums = vec![0.0; SIDES];
        let mut described = y
            .values
            .chunks_exact(RAY_VALUES)
            .zip(gradient.values.chunks_exact(RAY_VALUES));
        self.visit(|ray| {
            if let Some((y, gradient)) = described.next() {
                let hit = sides.hit(ray);
                sums[hit.side] += SIDE_GAIN * side_gradient(ray, hit, y, gradient);
            }
        });
        Ok([Some(sums)])
    }
}

/// The gradient for the side that the ray meets, in units of the room.
#[inline(always)]
fn side_gradient(ray: RoomRay, hit: RoomHit, y: &[f32], gradient: &[f32]) -> f32 {
    let speed = ray.direction[hit.side / 2];
    if speed.abs() < 1e-3 || hit.time <= MIN_DISTANCE {
        return 0.0;
    }
    let rest = WAVES + SIDES;
    let mut for_time = 0.0;
    for axis in 0..3 {
        let mut for_point = gradient[rest + axis];
        let mut frequency = LOWEST;
        for octave in 0..OCTAVES {
            let at = 2 * (axis * OCTAVES + octave);
            for_point += frequency * (gradient[at] * y[at + 1] - gradient[at + 1] * y[at]);
            frequency *= 2.0;
        }
        for_time += for_point * ray.direction[axis];
    }
    let [x, level_y, z] = ray.direction;
    let length = (x * x + level_y * level_y + z * z).sqrt();
    let distance = hit.time * length;
    let near = 1.0 / (distance + 0.3);
    for_time +=
        length * (0.25 * gradient[rest + 9] + 0.1 * distance * gradient[rest + 10] - near * near * gradient[rest + 11]);
    for_time / speed
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frame::warp::CameraModel;
    use crate::nn::flow::room_geometry::RoomScale;
    use crate::nn::geometry::camera::CameraPose;
    use crate::nn::gradient_check::{assert_gradients, noise, values};
    use crate::nn::ops::linear::Linear;
    use crate::nn::ops::modulation::perceptron;
    use crate::nn::ops::sampling::ImageSize;
    use crate::nn::precision::Precision;

    /// From three poses.
    fn views(size: ImageSize) -> RoomViews {
        let camera = CameraModel {
            horizontal_fov_rad: 1.0,
            tilt_down_rad: 0.2,
            height_m: Some(0.3),
        };
        let poses = [0.3, 2.0, -1.2].map(|heading| CameraPose {
            x: 2.3,
            y: 0.2,
            heading,
        });
        RoomViews {
            scale: RoomScale {
                middle: [2.0, 0.5],
                unit: 0.8,
            },
            views: ViewInRoom::of(&poses, &[camera; 3], camera, size),
        }
    }

    fn sides() -> Tensor {
        Tensor::new(&[0.02f32, -0.03, 0.01, 0.05, 0.04, -0.02], &candle_core::Device::Cpu).unwrap()
    }

    #[test]
    fn gradients_of_the_sides_agree_with_differences() {
        let size = ImageSize { height: 4, width: 6 };
        assert_gradients(&[sides()], 2e-4, |inputs| views(size).describe(&inputs[0]));
    }

    #[test]
    fn packed_layers_give_what_the_tensors_give() {
        // Whole groups of rays, and some more.
        let views = views(ImageSize { height: 7, width: 15 });
        let layer = |inputs: usize, outputs: usize, seed| Linear {
            weight: (noise(&[inputs, outputs], seed) * 0.2).unwrap(),
            bias: noise(&[outputs], seed + 1),
            has_tanh: false,
            packed: None,
        };
        let mut layers = [layer(RAY_VALUES, 24, 1), layer(24, 12, 3)];
        let plain = values(&perceptron(&layers, &views.clone().describe(&sides()).unwrap()).unwrap());
        for layer in &mut layers {
            layer.pack(Precision::F32).unwrap();
        }
        let packed = PackedPerceptron::of(&layers).unwrap();
        let packed = views.described_to(&packed, RoomSides::of(&sides()).unwrap());
        assert_eq!(plain.len(), packed.len());
        for (plain, packed) in plain.iter().zip(packed) {
            assert!((plain - packed).abs() < 1e-4, "{plain} and {packed}");
        }
    }
}
