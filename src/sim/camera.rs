//! Tb1's pinhole camera: casts rays through parry's `RayCast`, shades what they hit (Lambert and distance), casts more
//! rays where neighbouring pixels hit different things, and tells whose pixel is whose.

use std::sync::LazyLock;

use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use rapier3d::parry::query::{Ray, RayCast};
use rapier3d::parry::shape::Cuboid;
use rapier3d::prelude::Vector;

use super::cast::UprightCylinder;
use super::mover::{Mover, MoverView, NearestHit, face};
use super::{PlanarPose, SimError, WorldConfig, arena};
use crate::frame::Frame;

/// A pixel at an edge is the mean of a grid of this many rays a side.
const EDGE_RAYS: usize = 3;
/// Neighbours that differ by more than this are an edge though they hit the same thing.
const EDGE_STEP: f32 = 0.06;
/// Share of the light that comes from everywhere.
const AMBIENT: f32 = 0.6;
/// Towards the lamp.
static LIGHT: LazyLock<Vector> = LazyLock::new(|| Vector::new(-0.45, 0.35, 0.82).normalize());

/// What one ray brings back.
#[derive(Clone, Copy)]
struct RaySample {
    gray: f32,
    /// Which face of which solid; differs between any two.
    surface: u16,
    owner: u8,
}

/// A pinhole camera at its place.
#[derive(Clone, Debug)]
pub struct Camera {
    position: Vector,
    forward: Vector,
    left: Vector,
    up: Vector,
    /// Size of a pixel at one metre's depth.
    pixel_m: f32,
    width: usize,
    height: usize,
    noise_std: f32,
}

impl Camera {
    /// The camera of a robot that stands there. Pixels are square; the vertical field of view follows.
    #[must_use]
    pub fn new(config: &WorldConfig, pose: PlanarPose) -> Self {
        let (sin, cos) = pose.heading_rad.sin_cos();
        let (down, level) = (config.camera.tilt_down_rad as f32).sin_cos();
        Self {
            position: Vector::new(pose.x_m, pose.y_m, config.camera.height_m as f32),
            forward: Vector::new(cos * level, sin * level, -down),
            left: Vector::new(-sin, cos, 0.0),
            up: Vector::new(cos * down, sin * down, level),
            pixel_m: 2.0 * (config.camera.horizontal_fov_rad as f32 / 2.0).tan() / config.frame_width_px as f32,
            width: config.frame_width_px as usize,
            height: config.frame_height_px as usize,
            noise_std: config.camera.noise_std as f32,
        }
    }

    /// Where a point [x, y, z] of the room appears, [column, row] in pixels from the top left corner (the first pixel's
    /// middle is 0.5, 0.5); nothing if it is behind the camera.
    #[must_use]
    pub fn project(&self, point_m: [f32; 3]) -> Option<[f32; 2]> {
        let to = Vector::from_array(point_m) - self.position;
        let depth = to.dot(self.forward);
        (depth > 1e-6).then(|| {
            let (right, down) = (-to.dot(self.left), -to.dot(self.up));
            [
                self.width as f32 / 2.0 + right / (depth * self.pixel_m),
                self.height as f32 / 2.0 + down / (depth * self.pixel_m),
            ]
        })
    }

    /// The picture and whose pixel is whose. Errors: `Frame` if the size is out of range.
    pub(super) fn take(&self, movers: &[Mover], mut noise: ChaCha8Rng) -> Result<(Frame, Vec<u8>), SimError> {
        let samples = self.render(movers);
        let pixels = samples
            .iter()
            .map(|sample| {
                let normal: f32 = if self.noise_std > 0.0 {
                    StandardNormal.sample(&mut noise)
                } else {
                    0.0
                };
                ((sample.gray + self.noise_std * normal).clamp(0.0, 1.0) * 255.0).round() as u8
            })
            .collect();
        let frame = Frame::new(self.width as u32, self.height as u32, pixels)?;
        Ok((frame, samples.iter().map(|sample| sample.owner).collect()))
    }

    /// One ray through each pixel's middle, then more where they disagree.
    fn render(&self, movers: &[Mover]) -> Vec<RaySample> {
        let seen: Vec<MoverView> = movers
            .iter()
            .map(|mover| MoverView::new(mover, self.position))
            .collect();
        let mut middles = Vec::with_capacity(self.width * self.height);
        for row in 0..self.height {
            for column in 0..self.width {
                middles.push(self.sample(&seen, column as f32 + 0.5, row as f32 + 0.5));
            }
        }
        (0..middles.len())
            .map(|index| {
                if self.is_edge(&middles, index) {
                    self.average(&seen, index)
                } else {
                    middles[index]
                }
            })
            .collect()
    }

    fn is_edge(&self, samples: &[RaySample], index: usize) -> bool {
        let here = samples[index];
        let (row, column) = (index / self.width, index % self.width);
        let differs = |other: usize| {
            let there = samples[other];
            there.surface != here.surface || (there.gray - here.gray).abs() > EDGE_STEP
        };
        (column > 0 && differs(index - 1))
            || (column + 1 < self.width && differs(index + 1))
            || (row > 0 && differs(index - self.width))
            || (row + 1 < self.height && differs(index + self.width))
    }

    /// The mean of a grid of rays; the pixel belongs to whom most of them hit.
    fn average(&self, seen: &[MoverView], index: usize) -> RaySample {
        let (row, column) = (index / self.width, index % self.width);
        let mut sum = 0.0;
        let mut owners = [0u8; EDGE_RAYS * EDGE_RAYS];
        for (ray, owner) in owners.iter_mut().enumerate() {
            let right = (ray % EDGE_RAYS) as f32 + 0.5;
            let down = (ray / EDGE_RAYS) as f32 + 0.5;
            let sample = self.sample(
                seen,
                column as f32 + right / EDGE_RAYS as f32,
                row as f32 + down / EDGE_RAYS as f32,
            );
            sum += sample.gray;
            *owner = sample.owner;
        }
        owners.sort_unstable();
        RaySample {
            gray: sum / owners.len() as f32,
            surface: 0,
            owner: most_frequent(&owners),
        }
    }

    /// Casts the ray through a point of the image and shades what it hits.
    fn sample(&self, seen: &[MoverView], column: f32, row: f32) -> RaySample {
        let right = (column - self.width as f32 / 2.0) * self.pixel_m;
        let down = (row - self.height as f32 / 2.0) * self.pixel_m;
        let direction = self.forward - self.left * right - self.up * down;
        let mut hit = self.cast_room(direction);
        for (pillar, index) in arena::PILLARS.iter().zip(6..) {
            let [x, y] = pillar.position_m;
            let shape = UprightCylinder {
                radius: pillar.radius_m,
                bottom: 0.0,
                top: arena::HEIGHT_M,
            };
            let ray = Ray::new(self.position - Vector::new(x, y, 0.0), direction);
            if let Some(found) = shape.cast_local_ray_and_get_normal(&ray, hit.time, true) {
                hit = NearestHit {
                    time: found.time_of_impact,
                    normal: found.normal,
                    albedo: pillar.albedo,
                    surface: index,
                    owner: 0,
                };
            }
        }
        for seen in seen {
            seen.cast(direction, &mut hit);
        }
        if hit.surface == FLOOR {
            let point = self.position + direction * hit.time;
            hit.albedo *= seen
                .iter()
                .map(|seen| seen.mover.shade(point.x, point.y))
                .product::<f32>();
        }
        let lambert = hit.normal.dot(*LIGHT).max(0.0);
        let way_squared = direction.length_squared() * hit.time * hit.time;
        let near = 1.0 / (1.0 + 0.012 * way_squared);
        RaySample {
            gray: hit.albedo * (AMBIENT + (1.0 - AMBIENT) * lambert) * near,
            surface: hit.surface,
            owner: hit.owner,
        }
    }

    /// The room is a box seen from within, so every ray meets one of its sides.
    fn cast_room(&self, direction: Vector) -> NearestHit {
        let half = Vector::new(arena::LENGTH_M, arena::WIDTH_M, arena::HEIGHT_M) / 2.0;
        let middle = Vector::new(arena::LENGTH_M / 2.0, 0.0, arena::HEIGHT_M / 2.0);
        let ray = Ray::new(self.position - middle, direction);
        let found = Cuboid::new(half).cast_local_ray_and_get_normal(&ray, f32::MAX, false);
        let (time, axis) = found.map_or((0.0, 2), |found| (found.time_of_impact, face(&found) % 3));
        let far = direction[axis] > 0.0;
        let side = 2 * axis as u16 + u16::from(far);
        let mut normal = Vector::ZERO;
        normal[axis] = if far { -1.0 } else { 1.0 };
        let point = self.position + direction * time;
        NearestHit {
            time,
            normal,
            albedo: arena::side_albedo(side, point.x, point.y, point.z),
            surface: side,
            owner: 0,
        }
    }
}

/// The room's side that is the floor.
const FLOOR: u16 = 4;

/// The value that occurs most often in a sorted list, the smallest where several do.
fn most_frequent(sorted: &[u8]) -> u8 {
    let mut best = (0, 0);
    for run in sorted.chunk_by(u8::eq) {
        if run.len() > best.0 {
            best = (run.len(), run[0]);
        }
    }
    best.1
}
