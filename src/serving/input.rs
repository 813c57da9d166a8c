//! What a prediction takes, and whether it fits a model.

use crate::frame::Frame;
use crate::nn::{Conditioning, ModelSpec};
use crate::types::{Action, RobotState};

/// What does not fit, by the name of the field.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum InputError {
    /// Not as many frames as the model's context.
    #[error("frames holds {found} images; model \"{model}\" takes {expected}")]
    FrameCount {
        /// The model's name.
        model: String,
        /// Frames given.
        found: usize,
        /// Frames needed.
        expected: usize,
    },
    /// A frame of another size.
    #[error("{field} is {width}×{height} px; model \"{model}\" takes {model_width}×{model_height}")]
    FrameSize {
        /// The field, with its index.
        field: String,
        /// The model's name.
        model: String,
        /// Its width in pixels.
        width: u32,
        /// Its height in pixels.
        height: u32,
        /// The model's width in pixels.
        model_width: u32,
        /// The model's height in pixels.
        model_height: u32,
    },
    /// More past actions than frames.
    #[error("actions holds {found} actions; there are {frames} frames, and each has at most one")]
    ActionCount {
        /// Actions given.
        found: usize,
        /// Frames given.
        frames: usize,
    },
    /// Not as many future actions as the model's horizon.
    #[error("future_actions holds {found} actions; model \"{model}\" takes {expected}")]
    FutureActionCount {
        /// The model's name.
        model: String,
        /// Actions given.
        found: usize,
        /// Actions needed.
        expected: usize,
    },
    /// A vector of another length.
    #[error("{field} holds {found} numbers; model \"{model}\" takes {expected}: {channels}")]
    Dimension {
        /// The field, with its index.
        field: String,
        /// The model's name.
        model: String,
        /// Numbers given.
        found: usize,
        /// Numbers needed.
        expected: usize,
        /// Their names and units.
        channels: String,
    },
    /// The model needs it and it was not given.
    #[error("{field} is missing; model \"{model}\" takes {channels}")]
    Missing {
        /// The field.
        field: &'static str,
        /// The model's name.
        model: String,
        /// Names and units of the numbers it takes.
        channels: String,
    },
}

/// What a prediction starts from. A model takes what its conditioning says and ignores the rest.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PredictionInput {
    /// The context, oldest first.
    pub frames: Vec<Frame>,
    /// Past actions, oldest first, the last one under way at the last frame; may be empty. The last one is held where
    /// there are no future actions.
    pub actions: Vec<Action>,
    /// What the robot says of itself at the last frame.
    pub state: Option<RobotState>,
    /// The actions to predict under: the first acts from the last frame to the first predicted one.
    pub future_actions: Option<Vec<Action>>,
}

impl PredictionInput {
    /// Whether the model named `model` takes this. Errors name the field, what it is and what it should be.
    pub fn check(&self, model: &str, spec: &ModelSpec) -> Result<(), InputError> {
        if self.frames.len() != spec.context {
            return Err(InputError::FrameCount {
                model: model.to_owned(),
                found: self.frames.len(),
                expected: spec.context,
            });
        }
        for (index, frame) in self.frames.iter().enumerate() {
            check_size(
                &format!("frames[{index}]"),
                model,
                spec,
                (frame.width(), frame.height()),
            )?;
        }
        if self.actions.len() > self.frames.len() {
            return Err(InputError::ActionCount {
                found: self.actions.len(),
                frames: self.frames.len(),
            });
        }
        self.check_conditions(model, spec)
    }

    /// Whether actions and state fit, whatever the frames.
    pub(crate) fn check_conditions(&self, model: &str, spec: &ModelSpec) -> Result<(), InputError> {
        self.future_actions(model, spec)?;
        self.state(model, spec).map(|_| ())
    }

    /// The actions the model is conditioned on, one a predicted frame, or `None` where it takes none.
    pub(super) fn future_actions(&self, model: &str, spec: &ModelSpec) -> Result<Option<Vec<&[f32]>>, InputError> {
        if spec.conditioning == Conditioning::None {
            return Ok(None);
        }
        for (field, actions) in [
            ("actions", Some(&self.actions)),
            ("future_actions", self.future_actions.as_ref()),
        ] {
            for (index, action) in actions.into_iter().flatten().enumerate() {
                let field = format!("{field}[{index}]");
                check_length(field, model, action.as_slice().len(), &channels_of(&spec.actions))?;
            }
        }
        match (&self.future_actions, self.actions.last()) {
            (Some(actions), _) if actions.len() == spec.horizon => {
                Ok(Some(actions.iter().map(Action::as_slice).collect()))
            }
            (Some(actions), _) => Err(InputError::FutureActionCount {
                model: model.to_owned(),
                found: actions.len(),
                expected: spec.horizon,
            }),
            (None, Some(held)) => Ok(Some(vec![held.as_slice(); spec.horizon])),
            (None, None) => Err(InputError::Missing {
                field: "future_actions",
                model: model.to_owned(),
                channels: channels_of(&spec.actions).join(", "),
            }),
        }
    }

    /// The state the model is conditioned on, or `None` where it takes none.
    pub(super) fn state(&self, model: &str, spec: &ModelSpec) -> Result<Option<&[f32]>, InputError> {
        if spec.conditioning != Conditioning::StateAction {
            return Ok(None);
        }
        let channels = channels_of(&spec.states);
        let Some(state) = &self.state else {
            return Err(InputError::Missing {
                field: "state",
                model: model.to_owned(),
                channels: channels.join(", "),
            });
        };
        check_length("state".to_owned(), model, state.as_slice().len(), &channels)?;
        Ok(Some(state.as_slice()))
    }
}

/// Whether the frame in `field`, of that width and height in pixels, is of the model's size.
pub(crate) fn check_size(
    field: &str,
    model: &str,
    spec: &ModelSpec,
    (width, height): (u32, u32),
) -> Result<(), InputError> {
    if (width, height) == (spec.frame_width_px, spec.frame_height_px) {
        return Ok(());
    }
    Err(InputError::FrameSize {
        field: field.to_owned(),
        model: model.to_owned(),
        width,
        height,
        model_width: spec.frame_width_px,
        model_height: spec.frame_height_px,
    })
}

fn check_length(field: String, model: &str, found: usize, channels: &[String]) -> Result<(), InputError> {
    if found == channels.len() {
        return Ok(());
    }
    Err(InputError::Dimension {
        field,
        model: model.to_owned(),
        found,
        expected: channels.len(),
        channels: channels.join(", "),
    })
}

fn channels_of(scales: &[crate::nn::ChannelScale]) -> Vec<String> {
    scales
        .iter()
        .map(|scale| format!("{} {}", scale.name, scale.unit).trim_end().to_owned())
        .collect()
}
