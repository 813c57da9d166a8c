//! What one looks at before training on a data set: counts, rates and gaps (`timing`), ranges of every channel
//! (`channels`), brightness, repeated frames and exposure jumps (`images`), and the delay between actions and the image's
//! motion (`delays`). What is wrong becomes a sentence in [`Inspection::warnings`]; [`page`] draws all of it as HTML.

mod channels;
mod delays;
mod findings;
mod histogram;
mod images;
mod numbers;
mod page;
mod places;
mod timing;

#[doc(hidden)]
pub use self::channels::small_channels;
pub use self::channels::{ChannelRole, ChannelSummary};
pub use self::delays::{ActionDelay, LagCorrelation, MotionSignal};
pub use self::findings::{Inspection, inspect};
pub use self::histogram::Histogram;
pub use self::images::{ExposureJump, FrozenSpan, ImageSummary};
pub use self::page::page;
pub use self::places::FramePlace;
pub use self::timing::{FrameTiming, TimeGap};
