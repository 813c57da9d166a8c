//! Draws the floor plan of a room: its size and its inner walls.

use rand::Rng;
use rand_chacha::ChaCha8Rng;
use rapier3d::prelude::Vector;

use super::{bounded, walls};
use crate::arena;
use crate::ray_cast::Solid;
use crate::room::{Footprint, Light, Part, Piece, Room};
use crate::room_set::RoomSet;
use crate::surface::{Pattern, Surface};

/// Width of a doorway, in metres.
const DOORWAY_M: f32 = 1.0;
/// Height of a doorway, in metres.
const DOORWAY_HEIGHT_M: f32 = 2.0;
/// Thickness of an inner wall, in metres.
const INNER_WALL_M: f32 = 0.15;

/// A solid part of the floor plan: its center and its half sides.
struct Cut {
    center_m: [f32; 2],
    half_m: [f32; 2],
}

impl Cut {
    /// From one corner to the opposite one.
    fn between(low: [f32; 2], high: [f32; 2]) -> Self {
        Self {
            center_m: [f32::midpoint(low[0], high[0]), f32::midpoint(low[1], high[1])],
            half_m: [(high[0] - low[0]) / 2.0, (high[1] - low[1]) / 2.0],
        }
    }
}

/// A room without furniture, starts and goals.
pub(super) fn draw(set: RoomSet, random: &mut ChaCha8Rng) -> Room {
    let patterns = set.patterns();
    let height_m = random.random_range(2.2..3.4);
    let shape = random.random_range(0..100u32);
    let [length_m, width_m] = match shape {
        // A corridor.
        80.. => [random.random_range(6.0..12.0), random.random_range(1.8..2.6)],
        _ => [random.random_range(3.5..9.0), random.random_range(3.0..7.0)],
    };
    let cuts = cuts(shape, [length_m, width_m], random);
    let half = width_m / 2.0;
    let mut pieces: Vec<Piece> = cuts
        .iter()
        .map(|cut| inner_wall(cut, patterns, height_m, random))
        .collect();
    if let (67..80, [low, high]) = (shape, cuts.as_slice()) {
        pieces.push(lintel(low, high, height_m, &pieces));
    }
    let mut side = |along: [f32; 2]| walls::wall(patterns, along, height_m, random);
    let (short, long) = ([-half, width_m], [0.0, length_m]);
    let sides = [side(short), side(short), side(long), side(long)];
    let floor = walls::material(patterns, 0.25..0.75, random);
    let ceiling = walls::material(&[Pattern::Plain, Pattern::Waves], 0.7..0.95, random);
    let [back, front, right, left] = sides;
    Room {
        length_m,
        width_m,
        height_m,
        sides: [
            back,
            front,
            right,
            left,
            Surface::Material(floor),
            Surface::Material(ceiling),
        ],
        pieces,
        light: Light {
            direction: Vector::Z,
            ambient: 1.0,
            brightness: 1.0,
            exposure_std: 0.0,
        },
        starts_m: arena::STARTS_M,
        goals_m: arena::GOALS_M,
        checks_ways: true,
    }
}

/// The solid parts of a floor plan, by the number of its shape, 0 to 99.
fn cuts(shape: u32, [length_m, width_m]: [f32; 2], random: &mut ChaCha8Rng) -> Vec<Cut> {
    let half = width_m / 2.0;
    match shape {
        // A rectangle.
        ..40 => Vec::new(),
        // An L: one corner is missing.
        40..55 => {
            let (long, wide) = (
                length_m * random.random_range(0.3..0.5),
                width_m * random.random_range(0.3..0.5),
            );
            vec![match random.random_range(0..4) {
                0 => Cut::between([0.0, -half], [long, wide - half]),
                1 => Cut::between([0.0, half - wide], [long, half]),
                2 => Cut::between([length_m - long, -half], [length_m, wide - half]),
                _ => Cut::between([length_m - long, half - wide], [length_m, half]),
            }]
        }
        // Alcoves: blocks at a long wall, with recesses between them.
        55..67 | 80.. => {
            let depth = random.random_range(0.3..0.2 * width_m + 0.15);
            let (from, to) = if random.random_bool(0.5) {
                (-half, depth - half)
            } else {
                (half - depth, half)
            };
            let (first, second) = (
                length_m * random.random_range(0.2..0.35),
                length_m * random.random_range(0.65..0.8),
            );
            vec![
                Cut::between([0.0, from], [first, to]),
                Cut::between([second, from], [length_m, to]),
            ]
        }
        // Two rooms with a doorway between them.
        _ => {
            let at = length_m * random.random_range(0.35..0.65);
            let middle = random.random_range(0.7 - half..half - 0.7);
            let (low, high) = (middle - DOORWAY_M / 2.0, middle + DOORWAY_M / 2.0);
            let across = |from: f32, to: f32| Cut::between([at, from], [at + INNER_WALL_M, to]);
            vec![across(-half, low), across(high, half)]
        }
    }
}

/// A solid part of the floor plan, from floor to ceiling.
fn inner_wall(cut: &Cut, patterns: &[Pattern], height_m: f32, random: &mut ChaCha8Rng) -> Piece {
    let [x, y] = cut.center_m;
    let [half_x, half_y] = cut.half_m;
    let longer = if half_x > half_y {
        [x - half_x, 2.0 * half_x]
    } else {
        [y - half_y, 2.0 * half_y]
    };
    let part = Part {
        at: Vector::ZERO,
        solid: Solid::Block {
            center: [x, y, height_m / 2.0],
            half: [half_x, half_y, height_m / 2.0],
        },
        surface: walls::wall(patterns, longer, height_m, random),
    };
    let footprint = Footprint::Rectangle {
        center_m: cut.center_m,
        half_m: cut.half_m,
    };
    bounded(vec![part], footprint, height_m)
}

/// The wall above a doorway. Nothing collides with it: its footprint is one of the walls beside it.
fn lintel(low: &Cut, high: &Cut, height_m: f32, beside: &[Piece]) -> Piece {
    let (bottom, top) = (low.center_m[1] + low.half_m[1], high.center_m[1] - high.half_m[1]);
    let half = [low.half_m[0], (top - bottom) / 2.0, (height_m - DOORWAY_HEIGHT_M) / 2.0];
    let center = [low.center_m[0], f32::midpoint(bottom, top), DOORWAY_HEIGHT_M + half[2]];
    let (surface, footprint) = (beside[0].parts[0].surface.clone(), beside[0].footprint);
    Piece {
        parts: vec![Part {
            at: Vector::ZERO,
            solid: Solid::Block { center, half },
            surface,
        }],
        footprint,
        center: Vector::from_array(center),
        reach_m: Vector::from_array(half).length(),
    }
}
