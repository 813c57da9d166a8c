//! The network of the paper on candle.
