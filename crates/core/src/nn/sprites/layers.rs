//! The tensors of the sprite network and its cost.

use std::collections::BTreeMap;

use super::block_tracks::TRACK_VALUES;
use crate::nn::ops::image_geometry::TAPS;
use crate::nn::spec::{ModelSpec, SpriteSpec};

/// How many sprites there are.
pub(super) const SPRITES: usize = 2;
/// Axes of a frame. The same layers say how a sprite moves along each of them.
pub(super) const AXES: usize = 2;
/// Numbers that say how a sprite goes on in one frame along an axis: by how much it becomes faster, how far it goes besides, and how unsure
/// its place is.
pub(super) const STEP_VALUES: usize = 3;

/// Numbers that describe a sprite's way so far along an axis: its middle and the square of that, its last speed, and its places.
fn way_values(context: usize) -> usize {
    3 + (context - 1)
}

/// Channels of the encoder's inputs on half the sides: blocks of 2×2 pixels of the frames, column and row.
fn read_channels(context: usize) -> usize {
    4 * context + 2
}

/// A layer: name, inputs, outputs, and how often a window applies it to one row.
fn layer_sizes(spec: &ModelSpec, sizes: &SpriteSpec) -> Vec<(String, usize, usize, usize)> {
    let size = spec.image_size();
    let (half, quarter) = (size.shrunk(2).pixels(), size.shrunk(4).pixels());
    let (channels, stem, content) = (sizes.channels, sizes.stem_channels, sizes.content_channels);
    let tracks = TRACK_VALUES * (spec.context - 1) + SPRITES;
    let mut layers = vec![
        ("stem".to_owned(), TAPS * read_channels(spec.context), stem, half),
        ("halving".to_owned(), TAPS * stem, channels, quarter),
        ("tracks".to_owned(), tracks, channels, quarter),
    ];
    for index in 0..sizes.encoder_blocks {
        for part in ["first", "second"] {
            layers.push((format!("encoder.{index}.{part}"), TAPS * channels, channels, quarter));
        }
    }
    let fine = sizes.enlarged_channels + stem;
    let (hidden, memory, of_sprites, of_axes) =
        (sizes.motion_hidden, sizes.motion_memory, SPRITES * half, SPRITES * AXES);
    let of_steps = of_axes * spec.horizon;
    let rest = [
        ("trust", channels, SPRITES, quarter),
        ("enlarge", channels, 4 * sizes.enlarged_channels, quarter),
        ("fine", TAPS * fine, sizes.fine_channels, half),
        ("head", TAPS * sizes.fine_channels, 4, half),
        ("content.first", TAPS * 4 * (spec.context + 1), content, of_sprites),
        ("content.second", TAPS * content, content, of_sprites),
        ("content.output", TAPS * content, 4, of_sprites),
        ("memory.inputs", way_values(spec.context), hidden, of_axes),
        ("memory.output", hidden, memory, of_axes),
        ("step.inputs", 2 + memory, hidden, of_steps),
        ("step.hidden", hidden, hidden, of_steps),
        ("step.output", hidden, STEP_VALUES + memory, of_steps),
    ];
    layers.extend(rest.map(|(name, inputs, outputs, rows)| (name.to_owned(), inputs, outputs, rows)));
    layers
}

/// Name and shape of every tensor.
pub(in crate::nn) fn tensor_shapes(spec: &ModelSpec, sizes: &SpriteSpec) -> BTreeMap<String, Vec<usize>> {
    let mut shapes = BTreeMap::new();
    for (name, inputs, outputs, _) in layer_sizes(spec, sizes) {
        shapes.insert(format!("sprites.{name}.weight"), vec![inputs, outputs]);
        shapes.insert(format!("sprites.{name}.bias"), vec![outputs]);
    }
    shapes
}

/// Multiply–adds of weights to predict a window's frames, per frame, rounded up.
pub(in crate::nn) fn multiply_adds_per_frame(spec: &ModelSpec, sizes: &SpriteSpec) -> u64 {
    let layers = layer_sizes(spec, sizes).into_iter();
    let all: u64 = layers
        .map(|(_, inputs, outputs, rows)| (inputs * outputs * rows) as u64)
        .sum();
    all.div_ceil(spec.horizon.max(1) as u64)
}
