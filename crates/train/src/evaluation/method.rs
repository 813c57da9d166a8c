//! The names of all that is compared in a table.

use serde::{Deserialize, Serialize};

/// One row of a table: who made the prediction.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Method {
    /// The model under test.
    Model,
    /// The last input frame, repeated.
    CopyLast,
    /// The mean of the input frames, repeated.
    MeanOfInputs,
    /// The mean of all frames of the training split, repeated.
    MeanTrainingFrame,
    /// The least-squares line through each pixel's inputs, continued and clamped to 0…1.
    LinearExtrapolation,
    /// The last frame moved on by the shift between the last two inputs (phase correlation).
    ConstantShift,
    /// The last frame warped by the camera's own motion, which follows from the commanded actions.
    EgoMotion,
    /// The last frame warped by the camera's motion over a flat floor, towards a wall at the distance that fits training best.
    GroundAndWall,
    /// The same with a wall whose distance in each column follows from the input frames.
    PlaneSweep,
    /// The moving object cut out of the last frame and moved on at constant velocity over the background.
    MovingCutOut,
    /// The weighted mean of the frames that follow in the 8 training windows whose inputs, and actions to come, differ least.
    NearestWindows,
    /// Black frames; only for benchmarks whose frames are mostly black.
    Black,
    /// The true frame through the model's own frame encoder and decoder: about the best it can draw. It reads
    /// them smoothed; a prediction that learnt to sharpen can come out better.
    CodecOnly,
}

impl Method {
    /// All rows, in the order of the tables.
    pub const ALL: [Self; 13] = [
        Self::Model,
        Self::CopyLast,
        Self::MeanOfInputs,
        Self::MeanTrainingFrame,
        Self::LinearExtrapolation,
        Self::ConstantShift,
        Self::EgoMotion,
        Self::GroundAndWall,
        Self::PlaneSweep,
        Self::MovingCutOut,
        Self::NearestWindows,
        Self::Black,
        Self::CodecOnly,
    ];

    /// Whether it predicts without a model.
    #[must_use]
    pub fn is_baseline(self) -> bool {
        !matches!(self, Self::Model | Self::CodecOnly)
    }

    /// The row's name in words.
    #[must_use]
    pub fn label(self) -> &'static str {
        match self {
            Self::Model => "model",
            Self::CopyLast => "copy last frame",
            Self::MeanOfInputs => "mean of the inputs",
            Self::MeanTrainingFrame => "mean training frame",
            Self::LinearExtrapolation => "linear extrapolation",
            Self::ConstantShift => "constant global shift",
            Self::EgoMotion => "commanded ego-motion",
            Self::GroundAndWall => "ground plane and wall",
            Self::PlaneSweep => "plane sweep",
            Self::MovingCutOut => "moving cut-out",
            Self::NearestWindows => "weighted mean of the 8 nearest training windows",
            Self::Black => "black",
            Self::CodecOnly => "codec on the true frame",
        }
    }
}
