//! The sizes of the flow network, and what follows from them: its tensors and its cost.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::compose::{HEAD_VALUES, SCENE_CHANNELS, SCENE_FEATURES};
use super::conv::TAPS;
use super::flow_inputs::EncoderViews;
use super::motion::{DRIVE, MOTION_HIDDEN, StateChannels};
use super::sampling::ImageSize;
use super::scene::SceneKind;
use super::spec::in_range;
use super::{ModelSpec, NnError};

/// Channels of the moved pixels that the fine layers read: a 2×2 block and the share inside the frame.
const MOVED_CHANNELS: usize = 5;
/// Channels of a frame on the grid of a quarter of the sides: a 4×4 block.
const FRAME_CHANNELS: usize = 16;
/// Hidden units of the modulation.
const MODULATION_HIDDEN: usize = 64;
/// Least and greatest side of a frame; both sides are multiples of the least.
const SIDES_PX: [u32; 2] = [4, 256];

/// Sizes of the flow network's layers.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(default, deny_unknown_fields)]
pub struct FlowLayers {
    /// Channels on the grid of a quarter of the sides.
    pub channels: usize,
    /// Channels of the encoder's first layer, on the grid of half the sides.
    pub stem_channels: usize,
    /// Residual blocks of the encoder.
    pub encoder_blocks: usize,
    /// Residual blocks of each predicted step.
    pub decoder_blocks: usize,
    /// Channels that go from the quarter grid to the half grid.
    pub enlarged_channels: usize,
    /// Channels before the head, on the half grid.
    pub fine_channels: usize,
    /// Units of the scene's two hidden layers.
    pub scene_hidden: usize,
    /// Frames that the encoder reads: the last ones of the context.
    pub frames_read: usize,
    /// Whether each step continues from the state and the frame of the step before it, instead of starting from the last
    /// true frame. Only for models that take no actions.
    pub recurrent: bool,
}

impl Default for FlowLayers {
    fn default() -> Self {
        Self {
            channels: 48,
            stem_channels: 24,
            encoder_blocks: 2,
            decoder_blocks: 1,
            enlarged_channels: 12,
            fine_channels: 16,
            scene_hidden: 48,
            frames_read: 3,
            recurrent: false,
        }
    }
}

/// A layer of the network: its tensor's shape, and how often a window of one future applies it to one row.
struct LayerSize {
    name: String,
    inputs: usize,
    outputs: usize,
    rows: usize,
}

impl FlowLayers {
    /// Errors: `OutOfRange` at the first size that is out of range, `RecurrentActions`, `FrameSides`.
    pub(super) fn validate(&self, spec: &ModelSpec) -> Result<(), NnError> {
        let sizes = [
            ("flow.channels", self.channels, 512),
            ("flow.stem_channels", self.stem_channels, 512),
            ("flow.encoder_blocks", self.encoder_blocks, 16),
            ("flow.decoder_blocks", self.decoder_blocks, 16),
            ("flow.enlarged_channels", self.enlarged_channels, 512),
            ("flow.fine_channels", self.fine_channels, 512),
            ("flow.scene_hidden", self.scene_hidden, 1024),
            ("flow.frames_read", self.frames_read, 256),
        ];
        for (field, size, most) in sizes {
            let least = f64::from(u8::from(!field.ends_with("blocks")));
            in_range(field, size as f64, least, f64::from(most))?;
        }
        if self.recurrent && spec.action_inputs().is_some() {
            return Err(NnError::RecurrentActions {
                conditioning: spec.conditioning,
            });
        }
        let [least, most] = SIDES_PX;
        let fits = |side: u32| (least..=most).contains(&side) && side.is_multiple_of(least);
        if fits(spec.frame_width_px) && fits(spec.frame_height_px) {
            return Ok(());
        }
        Err(NnError::FrameSides {
            width: spec.frame_width_px,
            height: spec.frame_height_px,
            min: least,
            max: most,
        })
    }

    /// The layer that makes a step's state. In the recurrent form it adds to the state, so it starts small and has another
    /// name.
    pub(super) fn mix_name(&self) -> &'static str {
        if self.recurrent { "advance" } else { "mix" }
    }

    fn sizes(&self, spec: &ModelSpec) -> Vec<LayerSize> {
        let size = spec.image_size();
        let (half, quarter) = (size.shrunk(2).pixels(), size.shrunk(4).pixels());
        let (horizon, channels) = (spec.horizon, self.channels);
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
        layer(
            "stem",
            TAPS * EncoderViews::channels(self.frames_read),
            self.stem_channels,
            half,
        );
        layer("halving", TAPS * self.stem_channels, channels, quarter);
        for index in 0..self.encoder_blocks {
            for part in ["first", "second"] {
                layer(&format!("encoder.{index}.{part}"), TAPS * channels, channels, quarter);
            }
        }
        let (actions, states) = (spec.action_inputs(), spec.state_inputs().unwrap_or(0));
        let known = states + horizon * actions.unwrap_or(0);
        if actions.is_some() {
            layer("motion.inputs", known, MOTION_HIDDEN, 1);
            layer("motion.output", MOTION_HIDDEN, 3 * horizon, 1);
            if spec.camera.is_none() {
                layer("affine", 3, 6, horizon);
            }
        }
        let moving = if actions.is_some() { 3 } else { 0 };
        layer(
            "modulation.inputs",
            known + horizon + moving,
            MODULATION_HIDDEN,
            horizon,
        );
        let modulated = (2 * self.decoder_blocks).max(1) * 2 * channels;
        layer("modulation.output", MODULATION_HIDDEN, modulated, horizon);
        if let Some(inputs) = SceneKind::of(spec).inputs(spec) {
            // Once for each predicted frame, and once for the last frame seen.
            let rows = (horizon + 1) * half;
            layer("scene.inputs", inputs, self.scene_hidden, rows);
            layer("scene.hidden", self.scene_hidden, self.scene_hidden, rows);
            layer("scene.output", self.scene_hidden, SCENE_CHANNELS, rows);
        }
        let mixed = channels + 4 * SCENE_FEATURES + if self.recurrent { FRAME_CHANNELS } else { 0 };
        layer(self.mix_name(), mixed, channels, horizon * quarter);
        for index in 0..self.decoder_blocks {
            for part in ["first", "second"] {
                let name = format!("decoder.{index}.{part}");
                layer(&name, TAPS * channels, channels, horizon * quarter);
            }
        }
        layer("enlarge", channels, 4 * self.enlarged_channels, horizon * quarter);
        let fine = self.enlarged_channels + MOVED_CHANNELS + SCENE_CHANNELS;
        layer("fine", TAPS * fine, self.fine_channels, horizon * half);
        layer("head", TAPS * self.fine_channels, 4 * HEAD_VALUES, horizon * half);
        layers
    }

    /// Name and shape of every trained tensor.
    pub(super) fn tensor_shapes(&self, spec: &ModelSpec) -> BTreeMap<String, Vec<usize>> {
        let mut shapes = BTreeMap::new();
        for layer in self.sizes(spec) {
            shapes.insert(format!("{}.weight", layer.name), vec![layer.inputs, layer.outputs]);
            shapes.insert(format!("{}.bias", layer.name), vec![layer.outputs]);
        }
        if StateChannels::of(spec).commands_speeds() {
            shapes.insert(DRIVE.to_owned(), vec![2]);
        }
        let ImageSize { height, width } = spec.image_size().shrunk(2);
        match SceneKind::of(spec) {
            SceneKind::Room(_) => shapes.insert("flow.scene.room".to_owned(), vec![6]),
            _ => shapes.insert("flow.scene.image".to_owned(), vec![height * width, SCENE_CHANNELS]),
        };
        shapes
    }

    /// Multiply–adds of weights to predict a window's frames, per frame, rounded up.
    pub(super) fn multiply_adds_per_frame(&self, spec: &ModelSpec) -> u64 {
        let all: u64 = self
            .sizes(spec)
            .iter()
            .map(|layer| (layer.inputs * layer.outputs * layer.rows) as u64)
            .sum();
        all.div_ceil(spec.horizon.max(1) as u64)
    }
}
