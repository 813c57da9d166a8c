//! Tb1's pinhole camera. It casts rays with parry's `RayCast`, shades the points that they hit (Lambert and distance), casts
//! more rays at edges, and makes the segmentation mask.

use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use rapier3d::parry::query::{Ray, RayCast};
use rapier3d::parry::shape::Cuboid;
use rapier3d::prelude::Vector;

use super::config::{CameraConfig, Look, WorldConfig};
use super::error::SimError;
use super::rendered_robot::{NearestHit, RenderedRobot, RobotView, face};
use super::robot::PlanarPose;
use super::room::{Part, Piece, Room};
use super::surface::Surface;
use foreframe_core::frame::Frame;

/// A pixel at an edge is the mean of a square grid of rays with this many rays on each side.
const EDGE_RAYS: usize = 3;
/// Neighbouring pixels whose gray values differ by more than this are an edge, also if they show the same surface.
const EDGE_STEP: f32 = 0.06;

/// The result of one ray.
#[derive(Clone, Copy)]
struct RaySample {
    gray: f32,
    /// Identifies one face of one solid.
    surface: u16,
    /// Id in the segmentation mask.
    robot_id: u8,
}

/// A pinhole camera at a fixed pose.
#[derive(Clone, Debug)]
pub struct Camera {
    position: Vector,
    forward: Vector,
    left: Vector,
    up: Vector,
    /// Size of a pixel at a depth of one metre.
    pixel_m: f32,
    width: usize,
    height: usize,
    noise_std: f32,
    look: Look,
}

impl Camera {
    /// The camera of a robot with this pose. Pixels are square, which determines the vertical field of view. `config` gives
    /// the size of the image and the look.
    #[must_use]
    pub fn new(config: &WorldConfig, camera: &CameraConfig, pose: PlanarPose) -> Self {
        let (sin, cos) = pose.heading_rad.sin_cos();
        let (down, level) = (camera.tilt_down_rad as f32).sin_cos();
        Self {
            position: Vector::new(pose.x_m, pose.y_m, camera.height_m as f32),
            forward: Vector::new(cos * level, sin * level, -down),
            left: Vector::new(-sin, cos, 0.0),
            up: Vector::new(cos * down, sin * down, level),
            pixel_m: 2.0 * (camera.horizontal_fov_rad as f32 / 2.0).tan() / config.frame_width_px as f32,
            width: config.frame_width_px as usize,
            height: config.frame_height_px as usize,
            noise_std: camera.noise_std as f32,
            look: config.look,
        }
    }

    /// Projects a point [x, y, z] of the room to [column, row] in pixels from the top left corner (the center of the first
    /// pixel is 0.5, 0.5); none if the point is behind the camera.
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

    /// Width and height of the image in pixels.
    #[must_use]
    #[doc(hidden)]
    pub fn size_px(&self) -> [usize; 2] {
        [self.width, self.height]
    }

    /// The point [x, y, z] of the room that is seen at a place [column, row] of the image, at that depth along the camera's axis, in
    /// metres.
    #[must_use]
    #[doc(hidden)]
    pub fn point_m(&self, [column, row]: [f32; 2], depth_m: f32) -> [f32; 3] {
        (self.position + self.direction(column, row) * depth_m).to_array()
    }

    /// The depth of a point of the room along the camera's axis, in metres; negative behind the camera.
    #[must_use]
    #[doc(hidden)]
    pub fn depth_m(&self, point_m: [f32; 3]) -> f32 {
        (Vector::from_array(point_m) - self.position).dot(self.forward)
    }

    /// Renders an image with noise, and its segmentation mask. Errors: `Frame` if the size is out of range.
    pub(super) fn capture(
        &self,
        room: &Room,
        robots: &[RenderedRobot],
        mut noise: ChaCha8Rng,
    ) -> Result<(Frame, Vec<u8>), SimError> {
        let samples = self.render(room, robots);
        let exposure = if room.light.exposure_std > 0.0 {
            let normal: f32 = StandardNormal.sample(&mut noise);
            (room.light.exposure_std * normal).exp()
        } else {
            1.0
        };
        let pixels = samples
            .iter()
            .map(|sample| {
                let normal: f32 = if self.noise_std > 0.0 {
                    StandardNormal.sample(&mut noise)
                } else {
                    0.0
                };
                ((sample.gray * exposure + self.noise_std * normal).clamp(0.0, 1.0) * 255.0).round() as u8
            })
            .collect();
        let frame = Frame::new(self.width as u32, self.height as u32, pixels)?;
        Ok((frame, samples.iter().map(|sample| sample.robot_id).collect()))
    }

    /// The depth of what each pixel's center shows, along the camera's axis, in metres.
    pub(super) fn depths(&self, room: &Room, robots: &[RenderedRobot]) -> Vec<f32> {
        let views = &self.view(room, robots);
        let places = (0..self.height).flat_map(|row| (0..self.width).map(move |column| (column, row)));
        places
            .map(|(column, row)| {
                let direction = self.direction(column as f32 + 0.5, row as f32 + 0.5);
                let (mut hit, _) = self.cast_sides(room, direction);
                for piece in &views.pieces {
                    self.cast_piece(piece, direction, &mut hit);
                }
                for view in &views.robots {
                    view.cast(direction, &mut hit);
                }
                hit.time
            })
            .collect()
    }

    fn view<'a>(&self, room: &'a Room, robots: &'a [RenderedRobot]) -> View<'a> {
        View {
            room,
            pieces: self.visible_pieces(room),
            robots: robots
                .iter()
                .map(|robot| RobotView::new(robot, self.position))
                .collect(),
        }
    }

    /// The direction of a point of the image; 1 long along the camera's axis.
    #[inline]
    fn direction(&self, column: f32, row: f32) -> Vector {
        let right = (column - self.width as f32 / 2.0) * self.pixel_m;
        let down = (row - self.height as f32 / 2.0) * self.pixel_m;
        self.forward - self.left * right - self.up * down
    }

    /// Casts one ray through each pixel's center, then more rays at edges.
    fn render(&self, room: &Room, robots: &[RenderedRobot]) -> Vec<RaySample> {
        let views = &self.view(room, robots);
        let places = (0..self.height).flat_map(|row| (0..self.width).map(move |column| (column, row)));
        let centers: Vec<RaySample> = places
            .map(|(column, row)| self.sample(views, column as f32 + 0.5, row as f32 + 0.5))
            .collect();
        let refined = centers.iter().enumerate().map(|(index, center)| {
            let is_edge = self.is_edge(&centers, index);
            if is_edge { self.average(views, index) } else { *center }
        });
        refined.collect()
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

    /// The mean of a grid of rays. In the segmentation mask, the pixel gets the id that most of the rays hit.
    fn average(&self, views: &View, index: usize) -> RaySample {
        let (row, column) = (index / self.width, index % self.width);
        let mut sum = 0.0;
        let mut ids = [0u8; EDGE_RAYS * EDGE_RAYS];
        for (ray, id) in ids.iter_mut().enumerate() {
            let part = |index: usize| (index as f32 + 0.5) / EDGE_RAYS as f32;
            let (right, down) = (part(ray % EDGE_RAYS), part(ray / EDGE_RAYS));
            let sample = self.sample(views, column as f32 + right, row as f32 + down);
            sum += sample.gray;
            *id = sample.robot_id;
        }
        ids.sort_unstable();
        RaySample {
            gray: sum / ids.len() as f32,
            surface: 0,
            robot_id: most_frequent(&ids),
        }
    }

    /// Casts the ray through a point of the image and shades the point that it hits.
    fn sample(&self, views: &View, column: f32, row: f32) -> RaySample {
        let direction = self.direction(column, row);
        let (mut hit, mut surface) = self.cast_sides(views.room, direction);
        for piece in &views.pieces {
            if let Some(part) = self.cast_piece(piece, direction, &mut hit) {
                surface = &part.surface;
            }
        }
        for view in &views.robots {
            view.cast(direction, &mut hit);
        }
        let point = self.position + direction * hit.time;
        let mut shade = 1.0;
        if hit.surface == FLOOR {
            shade = (views.robots.iter())
                .map(|view| view.robot.shade(point.x, point.y))
                .product::<f32>();
        }
        let gray = if self.look == Look::Bright && hit.robot_id == 0 {
            WHITE * shade
        } else {
            if hit.robot_id == 0 {
                hit.albedo = surface.gray_at(point.to_array(), hit.normal.to_array());
            }
            let light = &views.room.light;
            let lambert = hit.normal.dot(light.direction).max(0.0);
            let distance_squared = direction.length_squared() * hit.time * hit.time;
            let falloff = 1.0 / (1.0 + 0.012 * distance_squared);
            hit.albedo * shade * (light.ambient + (1.0 - light.ambient) * lambert) * falloff * light.brightness
        };
        RaySample {
            gray,
            surface: hit.surface,
            robot_id: hit.robot_id,
        }
    }

    /// The pieces of the room that the camera may see: those whose sphere reaches into the cone around the image.
    fn visible_pieces<'a>(&self, room: &'a Room) -> Vec<PieceView<'a>> {
        let corner = self.pixel_m / 2.0 * (self.width as f32).hypot(self.height as f32);
        let (sin, cos) = corner.atan().sin_cos();
        let view = |(piece, number): (&'a Piece, u16)| {
            let to_center = piece.center - self.position;
            let ahead = to_center.dot(self.forward);
            let aside = (to_center.length_squared() - ahead * ahead).max(0.0).sqrt();
            let outside = to_center.length_squared() - piece.reach_m * piece.reach_m;
            (outside <= 0.0 || aside * cos - ahead * sin <= piece.reach_m).then_some(PieceView {
                piece,
                number,
                to_center,
                outside,
            })
        };
        room.pieces.iter().zip(0..).filter_map(view).collect()
    }

    /// Casts a ray against the parts of a piece. Overwrites `hit` and returns the part if one is nearer.
    fn cast_piece<'a>(&self, view: &PieceView<'a>, direction: Vector, hit: &mut NearestHit) -> Option<&'a Part> {
        let along = view.to_center.dot(direction);
        if view.outside > 0.0 && (along < 0.0 || along * along < direction.length_squared() * view.outside) {
            return None;
        }
        let mut nearest = None;
        for (part, index) in view.piece.parts.iter().zip(0u16..) {
            let ray = Ray::new(self.position - part.at, direction);
            if let Some(found) = part.solid.cast(&ray, hit.time) {
                *hit = NearestHit {
                    time: found.time_of_impact,
                    normal: found.normal,
                    albedo: 0.0,
                    surface: FIRST_PIECE + 64 * view.number + 8 * index + face(&found) as u16,
                    robot_id: 0,
                };
                nearest = Some(part);
            }
        }
        nearest
    }

    /// Casts a ray against the sides of the room. The camera is inside this box, so every ray hits one of them.
    fn cast_sides<'a>(&self, room: &'a Room, direction: Vector) -> (NearestHit, &'a Surface) {
        let half = Vector::new(room.length_m, room.width_m, room.height_m) / 2.0;
        let center = Vector::new(room.length_m / 2.0, 0.0, room.height_m / 2.0);
        let ray = Ray::new(self.position - center, direction);
        let found = Cuboid::new(half).cast_local_ray_and_get_normal(&ray, f32::MAX, false);
        let (time, axis) = found.map_or((0.0, 2), |found| (found.time_of_impact, face(&found) % 3));
        let far = direction[axis] > 0.0;
        let side = 2 * axis + usize::from(far);
        let mut normal = Vector::ZERO;
        normal[axis] = if far { -1.0 } else { 1.0 };
        let hit = NearestHit {
            time,
            normal,
            albedo: 0.0,
            surface: side as u16,
            robot_id: 0,
        };
        (hit, &room.sides[side])
    }
}

/// What all rays of one image are cast against.
struct View<'a> {
    room: &'a Room,
    pieces: Vec<PieceView<'a>>,
    robots: Vec<RobotView<'a>>,
}

/// A piece of the room with the values that are the same for all rays of an image.
struct PieceView<'a> {
    piece: &'a Piece,
    /// Its position among the room's pieces.
    number: u16,
    /// From the camera to the center of the bounding sphere.
    to_center: Vector,
    /// Squared distance to that center minus the squared radius of the sphere.
    outside: f32,
}

/// The first number of the surfaces of pieces; lower ones are the robots' and the room's sides.
const FIRST_PIECE: u16 = 8192;
/// The gray value of a white room.
const WHITE: f32 = 0.97;
/// The side of the room that is the floor.
const FLOOR: u16 = 4;

/// The most frequent value of a sorted list; the smallest one if several are equally frequent.
fn most_frequent(sorted: &[u8]) -> u8 {
    let mut best = (0, 0);
    for run in sorted.chunk_by(u8::eq) {
        if run.len() > best.0 {
            best = (run.len(), run[0]);
        }
    }
    best.1
}
