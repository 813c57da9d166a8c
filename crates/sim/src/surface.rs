//! What a surface looks like: a base gray, a pattern, and what hangs on a wall. Lengths are in metres; `u` runs along the
//! surface, `v` across it: upward on a wall, to the left on a floor.

use std::f32::consts::TAU;

use super::arena;

/// How the gray value of a surface varies over it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Pattern {
    Plain,
    /// Long waves in both directions.
    Waves,
    /// Parallel stripes across `u`.
    Stripes,
    /// Square tiles with joints.
    Tiles,
    /// Rows of bricks, each shifted by half a brick.
    Bricks,
    /// Smooth random patches.
    Patches,
    /// Round dots in a grid. Only in the test set of new materials.
    Dots,
    /// Diagonal squares. Only in the test set of new materials.
    Diamonds,
}

impl Pattern {
    /// The patterns that training rooms have.
    pub(super) const KNOWN: [Self; 6] = [
        Self::Plain,
        Self::Waves,
        Self::Stripes,
        Self::Tiles,
        Self::Bricks,
        Self::Patches,
    ];
    /// The patterns that no training room has.
    pub(super) const HELD_OUT: [Self; 2] = [Self::Dots, Self::Diamonds];
}

/// A base gray with a pattern.
#[derive(Clone, Copy, Debug)]
pub(super) struct Material {
    /// Mean gray value, 0…1.
    pub(super) gray: f32,
    pub(super) pattern: Pattern,
    /// Greatest relative change of the gray value by the pattern.
    pub(super) contrast: f32,
    /// Length of one repetition of the pattern, in metres.
    pub(super) period_m: f32,
    /// Where the pattern starts; also the seed of random patches.
    pub(super) offset_m: f32,
}

impl Material {
    pub(super) fn plain(gray: f32) -> Self {
        Self {
            gray,
            pattern: Pattern::Plain,
            contrast: 0.0,
            period_m: 1.0,
            offset_m: 0.0,
        }
    }

    /// Gray value at a point of the surface, 0…1.
    fn gray_at(&self, u: f32, v: f32) -> f32 {
        let (u, v) = ((u + self.offset_m) / self.period_m, v / self.period_m);
        (self.gray * (1.0 + self.contrast * self.variation(u, v))).clamp(0.02, 0.98)
    }

    /// −1…1, with periods of 1 in both directions.
    fn variation(&self, u: f32, v: f32) -> f32 {
        match self.pattern {
            Pattern::Plain => 0.0,
            Pattern::Waves => 0.6 * (TAU * u).sin() + 0.4 * (TAU * (0.37 * u + 0.71 * v) + 1.0).sin(),
            Pattern::Stripes => square_wave(u),
            Pattern::Tiles => 0.35 * square_wave(u) * square_wave(v) + joints(u, v),
            Pattern::Bricks => {
                let row = (3.0 * v).floor();
                let shifted = u + if row.rem_euclid(2.0) > 0.5 { 0.5 } else { 0.0 };
                0.3 * hash(shifted.floor(), row, self.offset_m) + joints(shifted, 3.0 * v)
            }
            Pattern::Patches => {
                patches(u, v, self.offset_m) * 0.7 + patches(2.7 * u, 2.7 * v, self.offset_m + 9.0) * 0.3
            }
            Pattern::Dots => {
                let from_center = (u.rem_euclid(1.0) - 0.5).hypot(v.rem_euclid(1.0) - 0.5);
                ramp(0.3 - from_center)
            }
            Pattern::Diamonds => square_wave(u + v) * square_wave(u - v),
        }
    }
}

/// −1 or 1 with ramps between them, positive in the first half of each period.
fn square_wave(x: f32) -> f32 {
    ((TAU * x).sin() * 4.0).clamp(-1.0, 1.0)
}

/// −1 below zero, 1 above, with a ramp between.
fn ramp(x: f32) -> f32 {
    (x * 12.0).clamp(-1.0, 1.0)
}

/// Dark lines at whole numbers of `u` and `v`.
fn joints(u: f32, v: f32) -> f32 {
    let to_line = |x: f32| (x - x.round()).abs();
    let nearest = to_line(u).min(to_line(v));
    -(1.0 - nearest / 0.06).clamp(0.0, 1.0) * 0.65
}

/// A number in −1…1 that depends on a cell of a grid only.
fn hash(column: f32, row: f32, seed: f32) -> f32 {
    let mixed = (column * 12.9898 + row * 78.233 + seed * 37.719).sin() * 43_758.547;
    2.0 * (mixed - mixed.floor()) - 1.0
}

/// Smooth noise in −1…1 between the random values of the corners of each cell.
fn patches(u: f32, v: f32, seed: f32) -> f32 {
    let (column, row) = (u.floor(), v.floor());
    let smooth = |x: f32| x * x * (3.0 - 2.0 * x);
    let (right, up) = (smooth(u - column), smooth(v - row));
    let along = |row: f32| {
        let left = hash(column, row, seed);
        left + right * (hash(column + 1.0, row, seed) - left)
    };
    let lower = along(row);
    lower + up * (along(row + 1.0) - lower)
}

/// A rectangle on a wall.
#[derive(Clone, Copy, Debug)]
pub(super) struct Panel {
    /// Where it begins and ends along the wall.
    pub(super) along_m: [f32; 2],
    /// Its lower and upper edge above the floor.
    pub(super) height_m: [f32; 2],
    pub(super) material: Material,
    /// Gray value of its frame.
    pub(super) frame: f32,
    /// Width of the frame and of a window's bars.
    pub(super) frame_m: f32,
    /// Whether bars divide it, as in a window.
    pub(super) has_bars: bool,
}

impl Panel {
    /// Its gray value at a point of the wall; none beside it.
    fn gray_at(&self, u: f32, v: f32) -> Option<f32> {
        let (right, up) = (u - self.along_m[0], v - self.height_m[0]);
        let (width, height) = (self.along_m[1] - self.along_m[0], self.height_m[1] - self.height_m[0]);
        if right < 0.0 || up < 0.0 || right > width || up > height {
            return None;
        }
        let to_edge = right.min(width - right).min(up.min(height - up));
        let to_bar = (right - width / 2.0).abs().min((up - height / 2.0).abs()) + self.frame_m / 2.0;
        let is_frame = to_edge < self.frame_m || (self.has_bars && to_bar < self.frame_m);
        Some(if is_frame {
            self.frame
        } else {
            self.material.gray_at(right, up)
        })
    }
}

/// A wall: its material, a darker strip at the floor, and what hangs on it.
#[derive(Clone, Debug)]
pub(super) struct Wall {
    pub(super) material: Material,
    /// Height and gray value of the skirting; a height of 0 is none.
    pub(super) skirting_m: f32,
    pub(super) skirting: f32,
    pub(super) panels: Vec<Panel>,
}

/// What a ray sees where it hits.
#[derive(Clone, Debug)]
pub(super) enum Surface {
    /// A side of the arena, by its number.
    ArenaSide(u16),
    Material(Material),
    Wall(Wall),
}

impl Surface {
    /// Gray value at a point of the room whose surface points in direction `normal`, 0…1.
    pub(super) fn gray_at(&self, [x, y, z]: [f32; 3], normal: [f32; 3]) -> f32 {
        let (u, v) = if normal[2].abs() > 0.7 {
            (x, y)
        } else if normal[0].abs() > normal[1].abs() {
            (y, z)
        } else {
            (x, z)
        };
        match self {
            Self::ArenaSide(side) => arena::side_albedo(*side, x, y, z),
            Self::Material(material) => material.gray_at(u, v),
            Self::Wall(wall) if v < wall.skirting_m => wall.skirting,
            Self::Wall(wall) => {
                let panel = wall.panels.iter().find_map(|panel| panel.gray_at(u, v));
                panel.unwrap_or_else(|| wall.material.gray_at(u, v))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_pattern_stays_within_its_contrast() {
        for pattern in Pattern::KNOWN.into_iter().chain(Pattern::HELD_OUT) {
            let material = Material {
                gray: 0.5,
                pattern,
                contrast: 0.4,
                period_m: 0.7,
                offset_m: 3.1,
            };
            let grays: Vec<f32> = (0..10_000)
                .map(|i| material.gray_at((i % 100) as f32 * 0.11 - 5.0, (i / 100) as f32 * 0.03))
                .collect();
            let (low, high) = (
                grays.iter().copied().fold(1.0, f32::min),
                grays.iter().copied().fold(0.0, f32::max),
            );
            assert!(low >= 0.299 && high <= 0.701, "{pattern:?}: {low} {high}");
            assert_eq!(
                high - low > 0.05,
                pattern != Pattern::Plain,
                "{pattern:?}: {low} {high}"
            );
        }
    }

    #[test]
    fn a_window_has_a_frame_bars_and_a_wall_around() {
        let window = Panel {
            along_m: [1.0, 2.0],
            height_m: [1.0, 2.0],
            material: Material::plain(0.9),
            frame: 0.2,
            frame_m: 0.06,
            has_bars: true,
        };
        let wall = Surface::Wall(Wall {
            material: Material::plain(0.5),
            skirting_m: 0.1,
            skirting: 0.3,
            panels: vec![window],
        });
        let gray = |y: f32, z: f32| wall.gray_at([0.0, y, z], [1.0, 0.0, 0.0]);
        assert_eq!(
            [
                gray(1.25, 1.25),
                gray(1.5, 1.2),
                gray(1.02, 1.5),
                gray(0.5, 1.5),
                gray(1.5, 0.05)
            ],
            [0.9, 0.2, 0.2, 0.5, 0.3]
        );
    }
}
