//! What a stream remembers between frames: the context, the number that comes next, and the last answer, which a frame
//! sent twice gets again. Knows no socket and no clock.

use std::collections::VecDeque;
use std::sync::Arc;

use super::images::{self, ImageError};
use super::protocol::{ErrorCode, FrameMessage, ServerMessage, Timing};
use crate::frame::Frame;
use crate::registry::Manifest;
use crate::serving::{InputError, Prediction, PredictionInput, ServingError};
use crate::types::{Action, RobotState, ValueError};

/// What to do about a frame.
#[derive(Debug)]
pub(super) enum Step {
    /// Send this.
    Answer(ServerMessage),
    /// Predict from this, then tell [`Session::predicted`].
    Predict(PredictionInput),
}

/// Why a frame was refused; the stream stands where it stood.
#[derive(Debug, thiserror::Error)]
pub(super) enum StreamError {
    #[error("seq is {found}; seq {expected} is next")]
    Gap { found: u64, expected: u64 },
    #[error(transparent)]
    Image(#[from] ImageError),
    #[error("{field}: {source}")]
    Value { field: &'static str, source: ValueError },
    #[error(transparent)]
    Input(#[from] InputError),
    #[error(transparent)]
    Serving(#[from] ServingError),
}

impl StreamError {
    pub(super) fn code(&self) -> ErrorCode {
        match self {
            Self::Gap { .. } => ErrorCode::Gap,
            Self::Image(ImageError::Encode(_)) => ErrorCode::Internal,
            Self::Serving(ServingError::QueueFull { .. } | ServingError::Deadline { .. } | ServingError::Stopped) => {
                ErrorCode::Overloaded
            }
            Self::Serving(ServingError::Input(_)) | Self::Image(_) | Self::Value { .. } | Self::Input(_) => {
                ErrorCode::Invalid
            }
            Self::Serving(_) => ErrorCode::Internal,
        }
    }
}

pub(super) struct Session {
    manifest: Arc<Manifest>,
    context: VecDeque<Frame>,
    next_seq: u64,
    /// The answer to the last frame; none if its prediction failed, so that the same frame may be sent again.
    kept: Option<ServerMessage>,
    dropped: u64,
}

impl Session {
    pub(super) fn new(manifest: Arc<Manifest>) -> Self {
        Self {
            manifest,
            context: VecDeque::new(),
            next_seq: 0,
            kept: None,
            dropped: 0,
        }
    }

    pub(super) fn next_seq(&self) -> u64 {
        self.next_seq
    }

    /// Takes a frame. Errors leave the session as it was.
    pub(super) fn accept(&mut self, message: &FrameMessage) -> Result<Step, StreamError> {
        let input = self.conditions(message)?;
        let is_last = message.seq.checked_add(1) == Some(self.next_seq);
        match &self.kept {
            Some(kept) if message.seq < self.next_seq => return Ok(Step::Answer(kept.clone())),
            None if is_last => return Ok(Step::Predict(self.with_context(input))),
            _ if message.seq != self.next_seq => {
                return Err(StreamError::Gap {
                    found: message.seq,
                    expected: self.next_seq,
                });
            }
            _ => {}
        }
        let frame = images::decode("image", &message.image, message.format, &self.manifest)?;
        self.push(frame);
        let need = self.manifest.spec.context;
        if self.context.len() < need {
            let answer = ServerMessage::Warming {
                seq: message.seq,
                timestamp_us: message.timestamp_us,
                have: self.context.len(),
                need,
            };
            self.kept = Some(answer.clone());
            return Ok(Step::Answer(answer));
        }
        Ok(Step::Predict(self.with_context(input)))
    }

    /// Turns the outcome of [`Step::Predict`] into the answer, and keeps it.
    pub(super) fn predicted(
        &mut self,
        message: &FrameMessage,
        outcome: Result<Prediction, ServingError>,
    ) -> Result<ServerMessage, StreamError> {
        let prediction = outcome.inspect_err(|_| self.dropped += 1)?;
        let format = message.format.answer();
        let answer = ServerMessage::Prediction {
            seq: message.seq,
            timestamp_us: message.timestamp_us,
            frames: images::encode(&prediction.frames, format)?,
            format,
            timing: Timing {
                queue_us: prediction.queue_us,
                compute_us: prediction.compute_us,
            },
            dropped: std::mem::take(&mut self.dropped),
        };
        self.kept = Some(answer.clone());
        Ok(answer)
    }

    fn push(&mut self, frame: Frame) {
        if self.context.len() == self.manifest.spec.context {
            self.context.pop_front();
        }
        self.context.push_back(frame);
        self.next_seq += 1;
        self.kept = None;
    }

    fn with_context(&self, input: PredictionInput) -> PredictionInput {
        PredictionInput {
            frames: self.context.iter().cloned().collect(),
            ..input
        }
    }

    /// Actions and state of the message, checked, without frames.
    fn conditions(&self, message: &FrameMessage) -> Result<PredictionInput, StreamError> {
        let action = |field| {
            move |values: &Vec<f32>| {
                Action::try_from(values.clone()).map_err(|source| StreamError::Value { field, source })
            }
        };
        let state = message.state.clone().map(RobotState::try_from).transpose();
        let plan = message
            .plan
            .as_ref()
            .map(|plan| plan.iter().map(action("plan")).collect());
        let input = PredictionInput {
            frames: Vec::new(),
            actions: message.action.iter().map(action("action")).collect::<Result<_, _>>()?,
            state: state.map_err(|source| StreamError::Value { field: "state", source })?,
            future_actions: plan.transpose()?,
        };
        input.check_conditions(&self.manifest.name, &self.manifest.spec)?;
        Ok(input)
    }
}
