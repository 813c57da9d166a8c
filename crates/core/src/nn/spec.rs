//! The specification of a model: its dimensions and what its numbers mean. What follows from it, and whether it is valid, is
//! in the module `model_size`.

mod channels;
mod dense;
mod flow;
mod json;
mod limits;
mod model;
mod sprites;

pub use channels::{ChannelScale, MIN_CHANNEL_STD};
pub use dense::DenseSpec;
pub use flow::{FlowLayers, FlowSpec};
pub(in crate::nn) use limits::in_range;
pub use limits::{
    MAX_BLUR_SIGMA_PX, MAX_CHANNELS, MAX_FEATURES, MAX_FRAME_PERIOD_S, MAX_HIDDEN, MAX_MODEL_SIDE_PX, MAX_PARAMETERS,
    MAX_STEPS, MIN_FRAME_PERIOD_S,
};
pub use model::{Architecture, ModelSpec};
pub use sprites::SpriteSpec;
