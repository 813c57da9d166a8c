//! The sizes of the flow network.

use serde::{Deserialize, Serialize};

use super::limits::in_range;
use crate::frame::warp::CameraModel;
use crate::nn::error::NnError;
use crate::nn::options::Conditioning;

/// Least and greatest side of a frame; both sides are multiples of the least.
const SIDES_PX: [u32; 2] = [4, 256];

/// Sizes of the flow network, and the camera that it predicts for.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct FlowSpec {
    /// Sizes of the layers.
    pub layers: FlowLayers,
    /// The camera model, if it is known.
    pub camera: Option<CameraModel>,
}

/// Sizes of the flow network's layers.
#[expect(
    clippy::struct_excessive_bools,
    reason = "parts of the network that are there or not"
)]
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
    /// Whether the depth of what the last frame shows is estimated from the context under its known motion, and the camera
    /// moved through it, instead of remembering what one place looks like. Without `memory`, such a model reads no absolute pose.
    pub depth: bool,
    /// Whether it also tells where movers are: other robots, in the last frame and in each predicted one. Only with `depth`;
    /// training needs masks of them.
    pub movers: bool,
    /// Whether it also estimates from the frames how fast the camera drives and turns. This stands in for the states and actions that
    /// a robot does not tell. Only with `depth`.
    pub speeds: bool,
    /// Whether it also remembers what one room looks like, and mixes that into what it sees, by the absolute pose in the state. Only
    /// with `depth`, for a robot that lives in one room.
    pub memory: bool,
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
            depth: false,
            movers: false,
            speeds: false,
            memory: false,
            recurrent: false,
        }
    }
}

impl FlowSpec {
    /// Errors: `Camera`, `RecurrentActions`, `RecurrentDepth`, `MoversDepth`, `SpeedsDepth`, `FrameSides` and those of the layers, for a
    /// model with this conditioning and frames of this width and height.
    pub(super) fn check(&self, conditioning: Conditioning, sides_px: [u32; 2]) -> Result<(), NnError> {
        if let Some(camera) = &self.camera {
            camera.validate().map_err(NnError::Camera)?;
        }
        self.layers.check_sizes()?;
        if self.layers.recurrent && conditioning.has_actions() {
            return Err(NnError::RecurrentActions { conditioning });
        }
        if self.layers.recurrent && self.layers.depth {
            return Err(NnError::RecurrentDepth);
        }
        if self.layers.movers && !self.layers.depth {
            return Err(NnError::MoversDepth);
        }
        if self.layers.speeds && !self.layers.depth {
            return Err(NnError::SpeedsDepth);
        }
        check_sides(sides_px)
    }
}

/// Errors: `FrameSides` if frames of this width and height cannot be cut into blocks of 4×4 pixels, or are too large.
pub(super) fn check_sides([width, height]: [u32; 2]) -> Result<(), NnError> {
    let [min, max] = SIDES_PX;
    let fits = |side: u32| (min..=max).contains(&side) && side.is_multiple_of(min);
    if fits(width) && fits(height) {
        return Ok(());
    }
    Err(NnError::FrameSides {
        width,
        height,
        min,
        max,
    })
}

impl FlowLayers {
    /// Errors: `OutOfRange` at the first size that is out of range.
    fn check_sizes(&self) -> Result<(), NnError> {
        let sizes = [
            ("flow.channels", self.channels, 1, 512),
            ("flow.stem_channels", self.stem_channels, 1, 512),
            ("flow.encoder_blocks", self.encoder_blocks, 0, 16),
            ("flow.decoder_blocks", self.decoder_blocks, 0, 16),
            ("flow.enlarged_channels", self.enlarged_channels, 1, 512),
            ("flow.fine_channels", self.fine_channels, 1, 512),
            ("flow.scene_hidden", self.scene_hidden, 1, 1024),
            ("flow.frames_read", self.frames_read, 1, 256),
        ];
        sizes
            .into_iter()
            .try_for_each(|(field, size, least, most)| in_range(field, size as f64, f64::from(least), f64::from(most)))
    }
}
