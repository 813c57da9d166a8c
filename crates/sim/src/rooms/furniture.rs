//! Draws pieces of furniture and puts them into a room.

use rand::Rng;
use rand_chacha::ChaCha8Rng;
use rapier3d::prelude::Vector;

use super::{bounded, walls};
use crate::ray_cast::{Solid, UprightCylinder};
use crate::room::{Footprint, Part, Piece, Room};
use crate::surface::{Material, Pattern, Surface};

/// How often a place for a piece is drawn before the piece is left out.
const TRIES: usize = 12;
/// Space between two pieces, in metres: a robot passes.
const BETWEEN_M: f32 = 0.55;

/// A kind of furniture.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kind {
    Box,
    Table,
    Shelf,
    Pillar,
    Plant,
    /// Only in the test set of new materials.
    Armchair,
}

impl Kind {
    /// The kinds that training rooms have.
    pub(super) const KNOWN: [Self; 5] = [Self::Box, Self::Table, Self::Shelf, Self::Pillar, Self::Plant];
    pub(super) const ALL: [Self; 6] = [
        Self::Box,
        Self::Table,
        Self::Shelf,
        Self::Pillar,
        Self::Plant,
        Self::HELD_OUT,
    ];
    /// The kind that no training room has.
    pub(super) const HELD_OUT: Self = Self::Armchair;
}

/// Builds a piece around the place `at` on the floor.
struct Builder<'a> {
    at: [f32; 2],
    /// Whether its longer side lies along y instead of x.
    is_turned: bool,
    ceiling_m: f32,
    patterns: &'a [Pattern],
    parts: Vec<Part>,
}

impl Builder<'_> {
    fn turned<T>(&self, [x, y]: [T; 2]) -> [T; 2] {
        if self.is_turned { [y, x] } else { [x, y] }
    }

    /// A box with its center at `from_m` from the place, and its bottom and top.
    fn block(&mut self, from_m: [f32; 2], half_m: [f32; 2], [bottom, top]: [f32; 2], material: Material) {
        let ([x, y], [half_x, half_y]) = (self.turned(from_m), self.turned(half_m));
        self.parts.push(Part {
            at: Vector::ZERO,
            solid: Solid::Block {
                center: [self.at[0] + x, self.at[1] + y, f32::midpoint(bottom, top)],
                half: [half_x, half_y, (top - bottom) / 2.0],
            },
            surface: Surface::Material(material),
        });
    }

    fn cylinder(&mut self, from_m: [f32; 2], radius: f32, [bottom, top]: [f32; 2], gray: f32) {
        let [x, y] = self.turned(from_m);
        self.parts.push(Part {
            at: Vector::new(self.at[0] + x, self.at[1] + y, 0.0),
            solid: Solid::Cylinder(UprightCylinder { radius, bottom, top }),
            surface: Surface::Material(Material::plain(gray)),
        });
    }
}

/// A piece of that kind at a free place, often at a wall; none if no place was found.
pub(super) fn place(kind: Kind, room: &Room, patterns: &[Pattern], random: &mut ChaCha8Rng) -> Option<Piece> {
    let half_m = half_size(kind, random);
    for _ in 0..TRIES {
        let is_turned = random.random_bool(0.5);
        let [half_x, half_y] = if is_turned { [half_m[1], half_m[0]] } else { half_m };
        let (far_x, far_y) = (room.length_m - half_x, room.width_m / 2.0 - half_y);
        if far_x <= half_x || far_y <= 0.0 {
            continue;
        }
        let mut at = [random.random_range(half_x..far_x), random.random_range(-far_y..far_y)];
        match random.random_range(0..8) {
            0 => at[0] = half_x,
            1 => at[0] = far_x,
            2 => at[1] = -far_y,
            3 => at[1] = far_y,
            _ => {}
        }
        let footprint = footprint(kind, at, [half_x, half_y]);
        if room
            .pieces
            .iter()
            .all(|piece| !piece.footprint.is_near(&footprint, BETWEEN_M))
        {
            let mut builder = Builder {
                at,
                is_turned,
                ceiling_m: room.height_m,
                patterns,
                parts: Vec::new(),
            };
            let top_m = builder.build(kind, half_m, random);
            return Some(bounded(builder.parts, footprint, top_m));
        }
    }
    None
}

fn footprint(kind: Kind, center_m: [f32; 2], half_m: [f32; 2]) -> Footprint {
    match kind {
        Kind::Pillar | Kind::Plant => Footprint::Disc {
            center_m,
            radius_m: half_m[0],
        },
        Kind::Box | Kind::Table | Kind::Shelf | Kind::Armchair => Footprint::Rectangle { center_m, half_m },
    }
}

/// Half of its length and width, in metres.
fn half_size(kind: Kind, random: &mut ChaCha8Rng) -> [f32; 2] {
    let mut draw = |low: f32, high: f32| random.random_range(low..high);
    match kind {
        Kind::Box => [draw(0.15, 0.45), draw(0.15, 0.35)],
        Kind::Table => [draw(0.4, 0.8), draw(0.3, 0.45)],
        Kind::Shelf => [draw(0.35, 0.7), draw(0.14, 0.22)],
        Kind::Armchair => [draw(0.35, 0.45), draw(0.35, 0.42)],
        Kind::Pillar | Kind::Plant => [draw(0.1, 0.25); 2],
    }
}

impl Builder<'_> {
    /// Builds a piece of that size; returns its height in metres.
    fn build(&mut self, kind: Kind, half_m: [f32; 2], random: &mut ChaCha8Rng) -> f32 {
        let main = walls::material(self.patterns, 0.15..0.9, random);
        let gray = random.random_range(0.1..0.9);
        match kind {
            Kind::Box => {
                let top = random.random_range(0.2..1.2);
                self.block([0.0; 2], half_m, [0.0, top], main);
                top
            }
            Kind::Table => self.table(half_m, random.random_range(0.45..0.8), main, gray),
            Kind::Shelf => {
                let top = random.random_range(0.8..1.9);
                let has_bricks = self.patterns.contains(&Pattern::Bricks);
                let pattern = if has_bricks { Pattern::Bricks } else { main.pattern };
                self.block([0.0; 2], half_m, [0.0, top], Material { pattern, ..main });
                let on_top = [half_m[0] * 0.98, half_m[1] * 0.6];
                self.block([0.0; 2], on_top, [top, top + 0.03], Material::plain(gray));
                top + 0.03
            }
            Kind::Pillar => {
                let reaches_ceiling = random.random_bool(0.7);
                let top = if reaches_ceiling {
                    self.ceiling_m
                } else {
                    random.random_range(0.3..1.2)
                };
                self.cylinder([0.0; 2], half_m[0], [0.0, top], gray);
                top
            }
            Kind::Plant => {
                let pot = random.random_range(0.2..0.4);
                self.cylinder([0.0; 2], 0.7 * half_m[0], [0.0, pot], gray);
                self.leaves(half_m[0], pot + 0.05, random.random_range(0.15..0.4))
            }
            Kind::Armchair => self.armchair(half_m, random.random_range(0.75..0.95), main),
        }
    }

    /// A board on four round legs. Returns its height in metres, as do the methods below.
    fn table(&mut self, [half_x, half_y]: [f32; 2], top: f32, board: Material, legs: f32) -> f32 {
        self.block([0.0; 2], [half_x, half_y], [top - 0.05, top], board);
        for (x, y) in [(-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)] {
            let at = [x * (half_x - 0.05), y * (half_y - 0.05)];
            self.cylinder(at, 0.03, [0.0, top - 0.05], legs);
        }
        top
    }

    /// Three layers of leaves, each narrower and lighter than the one below.
    fn leaves(&mut self, radius: f32, bottom: f32, gray: f32) -> f32 {
        for layer in [0.0, 1.0, 2.0] {
            let from = bottom + 0.22 * layer;
            self.cylinder(
                [0.0; 2],
                radius * (1.0 - 0.25 * layer),
                [from, from + 0.2],
                gray + 0.05 * layer,
            );
        }
        bottom + 0.64
    }

    /// A seat, a back and two arms.
    fn armchair(&mut self, [half_x, half_y]: [f32; 2], top: f32, cover: Material) -> f32 {
        self.block([0.0; 2], [half_x, half_y], [0.05, 0.42], cover);
        self.block([0.0, half_y - 0.08], [half_x, 0.08], [0.42, top], cover);
        for side in [-1.0, 1.0] {
            self.block(
                [side * (half_x - 0.07), -0.08],
                [0.07, half_y - 0.08],
                [0.42, 0.6],
                cover,
            );
        }
        top
    }
}
