//! The layers of the flow network: its tensors and its cost.

use std::collections::BTreeMap;

use super::blocks::{BLOCK_PIXELS, MOVED_CHANNELS};
use super::depth_head::{FINE_VALUES, MIXED_VALUES};
use super::depth_views::DepthViews;
use super::encoder_views::EncoderViews;
use super::motion::{MOTION_HIDDEN, WHEELS};
use super::scene::SceneKind;
use super::speed_head::{SPEED_CHANNELS, VOTE_VALUES, speed_channels};
use crate::nn::geometry::state_channels::StateChannels;
use crate::nn::ops::compose::{HEAD_VALUES, SCENE_CHANNELS, SCENE_FEATURES};
use crate::nn::ops::image_geometry::TAPS;
use crate::nn::spec::{FlowLayers, FlowSpec, ModelSpec};

/// Channels of a frame on the grid of a quarter of the sides: a 4×4 block.
const FRAME_CHANNELS: usize = 16;
/// Hidden units of the modulation.
const MODULATION_HIDDEN: usize = 64;

/// A layer of the network: its tensor's shape, and how often a window of one rollout applies it to one row.
struct LayerSize {
    name: String,
    inputs: usize,
    outputs: usize,
    rows: usize,
}

/// Name and shape of every trained tensor.
pub(in crate::nn) fn tensor_shapes(spec: &ModelSpec, flow: &FlowSpec) -> BTreeMap<String, Vec<usize>> {
    let mut shapes = BTreeMap::new();
    for layer in layer_sizes(spec, flow) {
        shapes.insert(format!("{}.weight", layer.name), vec![layer.inputs, layer.outputs]);
        shapes.insert(format!("{}.bias", layer.name), vec![layer.outputs]);
    }
    if StateChannels::of(spec).commands_speeds() {
        shapes.insert(WHEELS.to_owned(), vec![2]);
    }
    let scene = SceneKind::of(spec, flow.camera);
    let shape = match scene {
        SceneKind::Room(..) => vec![6],
        _ => vec![spec.image_size().shrunk(2).pixels(), SCENE_CHANNELS],
    };
    if !flow.layers.depth || flow.layers.memory {
        shapes.insert(scene.tensor_name().to_owned(), shape);
    }
    shapes
}

impl ModelSpec {
    /// What each row of the weights that read states and actions stands for, by tensor; empty for other networks.
    #[doc(hidden)]
    #[must_use]
    pub fn rows_of_inputs(&self) -> BTreeMap<String, Vec<String>> {
        let Some(flow) = self.flow() else {
            return BTreeMap::new();
        };
        let states = self.states_read_by_layers().into_iter();
        let states = states.map(|channel| format!("state {}", self.states[channel]));
        let actions = self.action_inputs().map_or(&[][..], |_| &self.actions);
        let actions = (0..self.horizon).flat_map(|step| actions.iter().map(move |action| format!("{step} {action}")));
        let known: Vec<String> = states.chain(actions).collect();
        let steps = (0..self.horizon).map(|step| format!("step {step}"));
        let motion = if self.action_inputs().is_some() || flow.layers.speeds {
            &["yaw", "ahead", "left"][..]
        } else {
            &[]
        };
        let told = known.iter().cloned().chain(steps);
        let told = told.chain(motion.iter().map(|part| (*part).to_owned())).collect();
        let mut rows = BTreeMap::from([("flow.modulation.inputs.weight".to_owned(), told)]);
        if self.action_inputs().is_some() {
            rows.insert("flow.motion.inputs.weight".to_owned(), known);
        }
        rows
    }
}

/// Multiply–adds of weights to predict a window's frames, per frame, rounded up.
pub(in crate::nn) fn multiply_adds_per_frame(spec: &ModelSpec, flow: &FlowSpec) -> u64 {
    let all: u64 = layer_sizes(spec, flow)
        .iter()
        .map(|layer| (layer.inputs * layer.outputs * layer.rows) as u64)
        .sum();
    all.div_ceil(spec.horizon.max(1) as u64)
}

/// Channels that the encoder reads.
fn channels_read(sizes: &FlowLayers) -> usize {
    if sizes.depth {
        DepthViews::channels(sizes.frames_read)
    } else {
        EncoderViews::channels(sizes.frames_read)
    }
}

/// Channels beside the moved features from which a step's state is made.
fn mixed_beside(sizes: &FlowLayers) -> usize {
    match (sizes.depth, sizes.recurrent) {
        (true, _) => MIXED_VALUES,
        (false, true) => 4 * SCENE_FEATURES + FRAME_CHANNELS,
        (false, false) => 4 * SCENE_FEATURES,
    }
}

/// The layer that makes a step's state. In the recurrent form it adds to the state, so it starts small and has another
/// name.
pub(super) fn mix_name(sizes: &FlowLayers) -> &'static str {
    if sizes.recurrent { "advance" } else { "mix" }
}

fn layer_sizes(spec: &ModelSpec, flow: &FlowSpec) -> Vec<LayerSize> {
    let sizes = &flow.layers;
    let size = spec.image_size();
    let (half, quarter) = (size.shrunk(2).pixels(), size.shrunk(4).pixels());
    let (horizon, channels) = (spec.horizon, sizes.channels);
    let mut layers = Vec::new();
    let mut layer = |name: &str, inputs: usize, outputs: usize, rows: usize| {
        let name = format!("flow.{name}");
        layers.push(LayerSize {
            name,
            inputs,
            outputs,
            rows,
        });
    };
    layer("stem", TAPS * channels_read(sizes), sizes.stem_channels, half);
    layer("halving", TAPS * sizes.stem_channels, channels, quarter);
    for index in 0..sizes.encoder_blocks {
        for part in ["first", "second"] {
            layer(&format!("encoder.{index}.{part}"), TAPS * channels, channels, quarter);
        }
    }
    let (actions, states) = (spec.action_inputs(), spec.states_read_by_layers().len());
    let known = states + horizon * actions.unwrap_or(0);
    if actions.is_some() {
        layer("motion.inputs", known, MOTION_HIDDEN, 1);
        layer("motion.output", MOTION_HIDDEN, 3 * horizon, 1);
        if flow.camera.is_none() && !sizes.depth {
            layer("affine", 3, 6, horizon);
        }
    }
    let moving = if actions.is_some() || sizes.speeds { 3 } else { 0 };
    let told = known + horizon + moving;
    layer("modulation.inputs", told, MODULATION_HIDDEN, horizon);
    let modulated = (2 * sizes.decoder_blocks).max(1) * 2 * channels;
    layer("modulation.output", MODULATION_HIDDEN, modulated, horizon);
    let scene = SceneKind::of(spec, flow.camera).inputs(spec);
    let scene = scene.filter(|_| !sizes.depth || sizes.memory);
    if let Some(inputs) = scene {
        // Once for each predicted frame, and once for the last frame seen.
        let rows = (horizon + 1) * half;
        layer("scene.inputs", inputs, sizes.scene_hidden, rows);
        layer("scene.hidden", sizes.scene_hidden, sizes.scene_hidden, rows);
        layer("scene.output", sizes.scene_hidden, SCENE_CHANNELS, rows);
    }
    for (name, inputs, outputs, rows) in seeing_layers(sizes, [half, quarter], horizon) {
        layer(name, inputs, outputs, rows);
    }
    layer(
        mix_name(sizes),
        channels + mixed_beside(sizes),
        channels,
        horizon * quarter,
    );
    for index in 0..sizes.decoder_blocks {
        for part in ["first", "second"] {
            let name = format!("decoder.{index}.{part}");
            layer(&name, TAPS * channels, channels, horizon * quarter);
        }
    }
    layer("enlarge", channels, 4 * sizes.enlarged_channels, horizon * quarter);
    let beside = if sizes.depth { FINE_VALUES } else { SCENE_CHANNELS };
    let fine = sizes.enlarged_channels + MOVED_CHANNELS + beside;
    layer("fine", TAPS * fine, sizes.fine_channels, horizon * half);
    layer("head", TAPS * sizes.fine_channels, 4 * HEAD_VALUES, horizon * half);
    layers
}

/// The layers that see depth, movers and speeds, and those that read what is remembered: name, inputs, outputs and rows of each, on the
/// grids of half and of a quarter of the sides.
fn seeing_layers(
    sizes: &FlowLayers,
    [half, quarter]: [usize; 2],
    horizon: usize,
) -> Vec<(&'static str, usize, usize, usize)> {
    let (channels, enlarged) = (sizes.channels, sizes.enlarged_channels);
    let mut layers = Vec::new();
    if sizes.depth {
        layers.push(("depth.enlarge", channels, 4 * enlarged, quarter));
        layers.push(("depth.output", TAPS * (enlarged + sizes.stem_channels), 4, half));
    }
    if sizes.movers {
        layers.push(("movers.seen", channels, FRAME_CHANNELS, quarter));
        layers.push(("movers.coming", channels, FRAME_CHANNELS, horizon * quarter));
    }
    if sizes.memory {
        let fine = sizes.fine_channels;
        layers.push(("memory.seen", TAPS * BLOCK_PIXELS, sizes.stem_channels, half));
        layers.push(("memory.fine", TAPS * SCENE_CHANNELS, fine, horizon * half));
        layers.push(("memory.share", TAPS * fine, BLOCK_PIXELS, horizon * half));
    }
    if sizes.speeds {
        let read = TAPS * speed_channels(sizes.frames_read);
        layers.push(("speeds.halving", read, SPEED_CHANNELS, quarter));
        layers.push(("speeds.0", TAPS * SPEED_CHANNELS, SPEED_CHANNELS, quarter));
        layers.push(("speeds.1", TAPS * SPEED_CHANNELS, SPEED_CHANNELS, quarter));
        layers.push(("speeds.votes", SPEED_CHANNELS, VOTE_VALUES, quarter));
    }
    layers
}
