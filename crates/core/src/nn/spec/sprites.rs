//! The sizes of the sprite network.

use serde::{Deserialize, Serialize};

use super::flow::check_sides;
use super::limits::in_range;
use crate::nn::error::NnError;
use crate::nn::options::Conditioning;

/// Sizes of the sprite network's layers.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(default, deny_unknown_fields)]
pub struct SpriteSpec {
    /// Channels on the grid of a quarter of the sides.
    pub channels: usize,
    /// Channels of the encoder's first layer, on the grid of half the sides.
    pub stem_channels: usize,
    /// Residual blocks of the encoder.
    pub encoder_blocks: usize,
    /// Channels that go from the quarter grid to the half grid.
    pub enlarged_channels: usize,
    /// Channels before the shares of the sprites, on the half grid.
    pub fine_channels: usize,
    /// Channels before what is hidden of a sprite, on the half grid.
    pub content_channels: usize,
    /// Units of the layers that say how a sprite moves on.
    pub motion_hidden: usize,
    /// Numbers that are carried from one predicted frame to the next.
    pub motion_memory: usize,
}

impl Default for SpriteSpec {
    fn default() -> Self {
        Self {
            channels: 48,
            stem_channels: 32,
            encoder_blocks: 6,
            enlarged_channels: 16,
            fine_channels: 24,
            content_channels: 32,
            motion_hidden: 128,
            motion_memory: 32,
        }
    }
}

impl SpriteSpec {
    /// Errors: `OutOfRange` at the first size that is out of range, `SpriteConditioning`, `SpriteContext`, `FrameSides`.
    pub(super) fn check(&self, conditioning: Conditioning, context: usize, sides_px: [u32; 2]) -> Result<(), NnError> {
        let sizes = [
            ("sprites.channels", self.channels, 1, 512),
            ("sprites.stem_channels", self.stem_channels, 1, 512),
            ("sprites.encoder_blocks", self.encoder_blocks, 0, 16),
            ("sprites.enlarged_channels", self.enlarged_channels, 1, 512),
            ("sprites.fine_channels", self.fine_channels, 1, 512),
            ("sprites.content_channels", self.content_channels, 1, 512),
            ("sprites.motion_hidden", self.motion_hidden, 1, 1024),
            ("sprites.motion_memory", self.motion_memory, 1, 1024),
        ];
        for (field, size, least, most) in sizes {
            in_range(field, size as f64, f64::from(least), f64::from(most))?;
        }
        if conditioning != Conditioning::None {
            return Err(NnError::SpriteConditioning { conditioning });
        }
        if context < 2 {
            return Err(NnError::SpriteContext);
        }
        check_sides(sides_px)
    }
}
