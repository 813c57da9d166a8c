//! Drawn surfaces: materials, and walls with skirting, posters, windows and doors.

use rand::Rng;
use rand_chacha::ChaCha8Rng;

use crate::surface::{Material, Panel, Pattern, Surface, Wall};

/// A material with one of the patterns and a gray value in this range.
pub(super) fn material(patterns: &[Pattern], gray: std::ops::Range<f32>, random: &mut ChaCha8Rng) -> Material {
    let pattern = patterns[random.random_range(0..patterns.len())];
    Material {
        gray: random.random_range(gray),
        pattern,
        contrast: random.random_range(0.1..0.45),
        period_m: random.random_range(0.35..1.6),
        offset_m: random.random_range(0.0..50.0),
    }
}

/// A wall that is `length_m` long, from `first_m` along its axis, and `height_m` high.
pub(super) fn wall(
    patterns: &[Pattern],
    [first_m, length_m]: [f32; 2],
    height_m: f32,
    random: &mut ChaCha8Rng,
) -> Surface {
    let material = material(patterns, 0.3..0.85, random);
    let has_skirting = random.random_bool(0.6);
    let count = random.random_range(0..=(length_m / 1.5) as usize);
    // One panel in each section of the wall, so that none overlaps another.
    let section_m = length_m / count.max(1) as f32;
    let panels = (0..count)
        .map(|index| {
            panel(
                patterns,
                first_m + index as f32 * section_m,
                section_m,
                height_m,
                random,
            )
        })
        .collect();
    Surface::Wall(Wall {
        skirting_m: if has_skirting {
            random.random_range(0.06..0.15)
        } else {
            0.0
        },
        skirting: material.gray * random.random_range(0.4..0.8),
        material,
        panels,
    })
}

/// A poster, a window or a door in the section of a wall that starts at `start_m`.
fn panel(patterns: &[Pattern], start_m: f32, section_m: f32, height_m: f32, random: &mut ChaCha8Rng) -> Panel {
    let (size_m, bottom_m, has_bars, gray) = match random.random_range(0..3) {
        0 => (
            [random.random_range(0.4..1.0), random.random_range(0.4..0.9)],
            random.random_range(0.7..1.2),
            false,
            0.1..0.95,
        ),
        1 => (
            [random.random_range(0.6..1.4), random.random_range(0.7..1.1)],
            random.random_range(0.7..1.0),
            true,
            0.85..0.97,
        ),
        _ => ([random.random_range(0.75..0.95), 2.0], 0.0, false, 0.2..0.8),
    };
    let width_m = f32::min(size_m[0], 0.9 * section_m);
    let left_m = start_m + random.random_range(0.0..=section_m - width_m);
    Panel {
        along_m: [left_m, left_m + width_m],
        height_m: [bottom_m, f32::min(bottom_m + size_m[1], height_m - 0.1)],
        material: material(patterns, gray, random),
        frame: random.random_range(0.1..0.9),
        frame_m: random.random_range(0.03..0.08),
        has_bars,
    }
}
