//! Rooms that differ: each trial draws its own floor plan, surfaces, furniture, light, camera and robots.
//!
//! A floor plan is a rectangle with solid parts cut out by inner walls, so that corridors, alcoves, L shapes and rooms with a
//! doorway are all boxes in a box.

mod furniture;
mod plan;
mod walls;

use rand::Rng;
use rand_chacha::ChaCha8Rng;
use rapier3d::prelude::Vector;

use self::furniture::Kind;
use super::arena;
use super::config::CameraConfig;
use super::room::{Footprint, Light, Part, Piece, Room};
use super::room_set::RoomSet;
use super::surface::Pattern;

/// Free space that robots need around a start or a goal, in metres.
const STOP_MARGIN_M: f32 = 0.35;
/// How often a place is drawn before the margin is made smaller.
const TRIES: usize = 60;

impl RoomSet {
    fn patterns(self) -> &'static [Pattern] {
        match self {
            Self::NewMaterials => &Pattern::HELD_OUT,
            Self::Varied | Self::NewCameras => &Pattern::KNOWN,
        }
    }

    fn furniture(self) -> &'static [Kind] {
        match self {
            Self::NewMaterials => &Kind::ALL,
            Self::Varied | Self::NewCameras => &Kind::KNOWN,
        }
    }

    /// Draws the camera of a trial. `noise_std` is kept.
    pub(super) fn draw_camera(self, random: &mut ChaCha8Rng, noise_std: f64) -> CameraConfig {
        let mut draw = |known: [f64; 2], new: [[f64; 2]; 2]| {
            let [low, high] = match self {
                Self::Varied | Self::NewMaterials => known,
                Self::NewCameras => new[random.random_range(0..2)],
            };
            random.random_range(low..high)
        };
        CameraConfig {
            height_m: draw([0.35, 0.9], [[0.25, 0.32], [0.95, 1.3]]),
            tilt_down_rad: draw([0.0, 0.4], [[-0.15, -0.03], [0.43, 0.6]]),
            horizontal_fov_rad: draw([0.85, 1.6], [[0.65, 0.8], [1.65, 2.0]]),
            noise_std,
        }
    }

    /// Draws the room of a trial.
    pub(super) fn draw_room(self, random: &mut ChaCha8Rng) -> Room {
        let mut room = plan::draw(self, random);
        let held_out = (self == Self::NewMaterials).then_some(Kind::HELD_OUT);
        let area = room.length_m * room.width_m;
        let wanted = 1 + random.random_range(0..=(area / 5.0) as usize).min(10);
        for index in 0..wanted {
            let known = self.furniture();
            let kind = held_out
                .filter(|_| index == 0)
                .unwrap_or(known[random.random_range(0..known.len())]);
            if let Some(piece) = furniture::place(kind, &room, self.patterns(), random) {
                room.pieces.push(piece);
            }
        }
        room.light = draw_light(random);
        let mut stops: Vec<[f32; 2]> = Vec::new();
        for _ in 0..room.starts_m.len() + room.goals_m.len() {
            stops.push(free_place(&room, random, &stops, 0.8));
        }
        let (starts, goals) = stops.split_at(room.starts_m.len());
        room.starts_m.copy_from_slice(starts);
        room.goals_m.copy_from_slice(goals);
        room
    }
}

fn draw_light(random: &mut ChaCha8Rng) -> Light {
    let around = random.random_range(-std::f32::consts::PI..std::f32::consts::PI);
    let up = random.random_range(0.5..1.2f32);
    let direction = Vector::new(around.cos(), around.sin(), up).normalize();
    Light {
        direction,
        ambient: random.random_range(0.45..0.75),
        brightness: random.random_range(0.65..1.35),
        exposure_std: random.random_range(0.0..0.02),
    }
}

/// A random place that is clear of walls and pieces, at least `apart_m` from the places `taken`. If there is none, both distances
/// shrink until a place is found.
pub(super) fn free_place(room: &Room, random: &mut ChaCha8Rng, taken: &[[f32; 2]], apart_m: f32) -> [f32; 2] {
    let (mut margin, mut apart) = (STOP_MARGIN_M, apart_m);
    loop {
        for _ in 0..TRIES {
            let place = [
                random.random_range(0.0..room.length_m),
                random.random_range(-room.width_m / 2.0..room.width_m / 2.0),
            ];
            if room.is_clear(place, margin) && taken.iter().all(|&other| arena::distance(other, place) >= apart) {
                return place;
            }
        }
        margin *= 0.9;
        apart *= 0.8;
    }
}

/// A piece whose parts stand on its footprint, with a sphere around them.
fn bounded(parts: Vec<Part>, footprint: Footprint, top_m: f32) -> Piece {
    let [[x, y], [half_x, half_y]] = footprint.bounds();
    let half = top_m / 2.0;
    Piece {
        parts,
        footprint,
        center: Vector::new(x, y, half),
        reach_m: half_x.hypot(half_y).hypot(half),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use foreframe_core::types::Seed;

    fn rooms(set: RoomSet) -> Vec<Room> {
        (0..60)
            .map(|trial| set.draw_room(&mut Seed(5).derive("room", trial).rng()))
            .collect()
    }

    #[test]
    fn starts_and_goals_are_free_and_apart() {
        for room in rooms(RoomSet::Varied) {
            let stops: Vec<[f32; 2]> = room.starts_m.into_iter().chain(room.goals_m).collect();
            for (index, &stop) in stops.iter().enumerate() {
                assert!(room.is_clear(stop, 0.2), "{stop:?}");
                assert!(
                    stops[..index].iter().all(|&other| arena::distance(other, stop) > 0.35),
                    "{stops:?}"
                );
            }
        }
    }

    #[test]
    fn pieces_stand_inside_the_room() {
        for room in RoomSet::ALL.into_iter().flat_map(rooms) {
            assert!((3.0..=12.0).contains(&room.length_m) && (2.2..=3.5).contains(&room.height_m));
            for piece in &room.pieces {
                let [[x, y], [half_x, half_y]] = piece.footprint.bounds();
                assert!(x - half_x > -1e-3 && x + half_x < room.length_m + 1e-3, "{piece:?}");
                assert!(y.abs() + half_y < room.width_m / 2.0 + 1e-3, "{piece:?}");
            }
        }
    }

    #[test]
    fn new_cameras_are_outside_the_known_ranges() {
        for trial in 0..100 {
            let mut random = Seed(1).derive("camera", trial).rng();
            let known = RoomSet::Varied.draw_camera(&mut random, 0.0);
            let new = RoomSet::NewCameras.draw_camera(&mut random, 0.0);
            assert!((0.35..0.9).contains(&known.height_m) && !(0.35..0.9).contains(&new.height_m));
            assert!((0.85..1.6).contains(&known.horizontal_fov_rad) && !(0.85..1.6).contains(&new.horizontal_fov_rad));
        }
    }
}
