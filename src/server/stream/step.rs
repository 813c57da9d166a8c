//! The rules of a session: which frame is next, what was answered, what a gap means. Knows no lock, no clock and no thread.

use std::sync::Arc;

use super::protocol::{ErrorCode, FrameMessage, OnGap, OnLate, ServerMessage, SessionSettings};
use crate::server::blocking::TaskError;
use crate::server::images::{self, ImageError, ImageFormat, ImageInput};
use crate::server::request_inputs::refused_steps;
use foreframe_core::error_kind::{ErrorKind, HasErrorKind};
use foreframe_core::frame::Frame;
use foreframe_core::frame::resize::Resize;
use foreframe_core::nn::ModelSpec;
use foreframe_core::registry::Manifest;
use foreframe_core::serving::{
    ConditioningInput, FieldNames, InputError, Prediction, RawConditioning, STEP_FIELDS, ServingError, SessionState,
    Task, unused_inputs,
};
use foreframe_core::types::{Action, RobotState, ValueError};

/// A frame that fits the model.
#[derive(Clone, Debug)]
pub(in crate::server) struct FrameStep {
    pub(in crate::server) seq: u64,
    pub(in crate::server) timestamp_us: i64,
    pub(in crate::server) frame: Frame,
    pub(in crate::server) conditions: CheckedConditions,
    pub(in crate::server) format: ImageFormat,
    /// Whether newer frames wait behind this one, so that it may go without a prediction.
    pub(in crate::server) is_overtaken: bool,
}

impl FrameStep {
    /// Checks the message and decodes its image, which takes long unless the image is raw. Errors name the field.
    pub(in crate::server) fn new(
        message: FrameMessage,
        resize: Option<Resize>,
        manifest: &Manifest,
        max_steps: usize,
    ) -> Result<Self, StepError> {
        let format = message.format;
        let conditions = StepConditions {
            action: message.action,
            plan: message.plan,
            state: message.state,
            steps: message.steps,
        };
        Ok(Self {
            seq: message.seq,
            timestamp_us: message.timestamp_us,
            conditions: conditions.check(&STEP_FIELDS, manifest, max_steps)?,
            frame: images::decode("image", message.image, ImageInput { format, resize }, manifest)?,
            format,
            is_overtaken: false,
        })
    }
}

/// What comes with a frame, if it fits the model.
#[derive(Clone, Debug)]
pub(in crate::server) struct CheckedConditions {
    pub(in crate::server) conditioning: ConditioningInput,
    /// A warning for each field that the model does not use.
    pub(in crate::server) unused: Vec<String>,
}

/// What comes with a frame, as the client sent it.
pub(in crate::server) struct StepConditions {
    pub(in crate::server) action: Option<Vec<f32>>,
    pub(in crate::server) plan: Option<Vec<Vec<f32>>>,
    pub(in crate::server) state: Option<Vec<f32>>,
    pub(in crate::server) steps: Option<usize>,
}

impl StepConditions {
    /// The conditioning input, if it fits the model. `names`: of the fields, for errors and warnings.
    pub(in crate::server) fn check(
        self,
        names: &FieldNames,
        manifest: &Manifest,
        max_steps: usize,
    ) -> Result<CheckedConditions, StepError> {
        if let Some(reason) = refused_steps(self.steps, manifest, max_steps) {
            return Err(StepError::Invalid(reason));
        }
        let (action, plan) = (
            self.action.is_some().then_some("action"),
            self.plan.is_some().then_some(names.plan),
        );
        let given: Vec<&str> = action.into_iter().chain(plan).collect();
        let unused = unused_inputs(false, &given, manifest);
        let past: Option<Action> = self.action.map(|action| checked("action", action)).transpose()?;
        let actions = |plan: Vec<Vec<f32>>| plan.into_iter().map(|action| checked(names.plan, action)).collect();
        let plan: Option<Vec<Action>> = self.plan.map(actions).transpose()?;
        let state: Option<RobotState> = self.state.map(|state| checked("state", state)).transpose()?;
        let given = RawConditioning {
            past: past.as_slice(),
            plan: plan.as_deref(),
            state: state.as_ref(),
            steps: self.steps,
        };
        let conditioning = ConditioningInput::new(given, names, manifest)?;
        Ok(CheckedConditions { conditioning, unused })
    }
}

fn checked<T: TryFrom<Vec<f32>, Error = ValueError>>(field: &str, values: Vec<f32>) -> Result<T, StepError> {
    T::try_from(values).map_err(|error| StepError::Invalid(format!("{field}: {error}")))
}

/// Why a frame was refused. The session stays as it was.
#[derive(Debug, thiserror::Error)]
pub(in crate::server) enum StepError {
    #[error("seq is {found}; seq {expected} is next")]
    Gap { found: u64, expected: u64 },
    #[error("{0}")]
    Invalid(String),
    #[error(transparent)]
    Image(#[from] ImageError),
    #[error(transparent)]
    Input(#[from] InputError),
    #[error(transparent)]
    Serving(#[from] ServingError),
    #[error(transparent)]
    Task(#[from] TaskError),
    #[error("another connection has taken over the session")]
    NotOwner,
}

impl StepError {
    pub(in crate::server) fn code(&self) -> ErrorCode {
        match self {
            Self::Gap { .. } => ErrorCode::Gap,
            Self::Image(ImageError::Encode(_)) | Self::Task(_) => ErrorCode::Internal,
            Self::Serving(error) => match error.kind() {
                ErrorKind::Busy | ErrorKind::Away => ErrorCode::Overloaded,
                ErrorKind::Usage => ErrorCode::Invalid,
                _ => ErrorCode::Internal,
            },
            Self::Invalid(_) | Self::Image(_) | Self::Input(_) | Self::NotOwner => ErrorCode::Invalid,
        }
    }
}

/// The state of a session with its last answer.
pub(super) struct SessionCore {
    pub(super) state: SessionState,
    pub(super) settings: SessionSettings,
    /// `None` before the first frame, and after an import: then the last answer is computed again on request.
    last_answer: Option<StepAnswer>,
    /// The warnings about inputs that the model does not use, as far as an answer had them.
    said_unused: Vec<String>,
}

/// The answer to a frame.
#[derive(Clone)]
pub(super) struct StepAnswer {
    seq: u64,
    timestamp_us: i64,
    skipped: u64,
    have: usize,
    /// `None` while the context is not full, and for a frame that was overtaken.
    prediction: Option<Arc<Prediction>>,
}

impl SessionCore {
    pub(super) fn new(state: SessionState, settings: SessionSettings) -> Self {
        Self {
            state,
            settings,
            last_answer: None,
            said_unused: Vec::new(),
        }
    }

    /// How many frames are missing before this one; `None` if it was answered before. Errors: `Invalid`, `Gap`.
    pub(super) fn missing_before(&self, seq: u64) -> Result<Option<u64>, StepError> {
        let expected = self.state.next_seq();
        if seq == u64::MAX {
            return Err(StepError::Invalid(format!("seq is {seq}; the greatest is one less")));
        }
        if seq > expected && self.settings.on_gap == OnGap::Error {
            return Err(StepError::Gap { found: seq, expected });
        }
        Ok(seq.checked_sub(expected))
    }

    /// The task of the next frame. `is_overtaken`: newer frames wait behind it, so it may go without a prediction.
    pub(super) fn task(
        &self,
        frame: Frame,
        conditioning: &ConditioningInput,
        is_overtaken: bool,
        spec: &ModelSpec,
    ) -> Task {
        let is_skipped = is_overtaken && self.settings.on_late == OnLate::Skip;
        let conditioning = (!is_skipped).then(|| conditioning.clone());
        self.state.step(frame, conditioning, spec)
    }

    /// The task that computes the last answer again; `None` if [`SessionCore::last_answer`] gives it.
    pub(super) fn repeat_task(&self, spec: &ModelSpec) -> Option<Task> {
        match self.last_answer {
            Some(_) => None,
            None => self.state.repeat_task(spec),
        }
    }

    /// The answer to the last frame. `timestamp_us`: the time of the frame that asks for it again.
    pub(super) fn last_answer(&self, timestamp_us: i64) -> StepAnswer {
        let last = self.last_answer.clone();
        last.unwrap_or_else(|| self.answer(timestamp_us, 0, None))
    }

    /// Adds the warnings about the session's camera and other inputs that the model does not use, each to one answer of the session.
    pub(super) fn say_unused(&mut self, prediction: &mut Prediction, mut unused: Vec<String>) {
        if prediction.rollouts.is_empty() {
            return;
        }
        unused.extend(unused_inputs(self.state.camera().is_some(), &[], &prediction.manifest));
        unused.retain(|warning| !self.said_unused.contains(warning));
        self.said_unused.extend_from_slice(&unused);
        prediction.warnings.extend(unused);
    }

    /// Keeps the prediction as the answer to the last frame.
    pub(super) fn keep(&mut self, timestamp_us: i64, skipped: u64, prediction: Prediction) -> StepAnswer {
        let prediction = (!prediction.rollouts.is_empty()).then(|| Arc::new(prediction));
        let answer = self.answer(timestamp_us, skipped, prediction);
        self.last_answer = Some(answer.clone());
        answer
    }

    fn answer(&self, timestamp_us: i64, skipped: u64, prediction: Option<Arc<Prediction>>) -> StepAnswer {
        StepAnswer {
            seq: self.state.next_seq().saturating_sub(1),
            timestamp_us,
            skipped,
            have: self.state.frame_count(),
            prediction,
        }
    }
}

impl StepAnswer {
    /// Whether [`StepAnswer::message`] has to compress images, which takes long.
    pub(super) fn must_compress(&self, format: ImageFormat) -> bool {
        self.prediction.is_some() && format.answer() != ImageFormat::Raw
    }

    /// The message to the client; encodes the frames.
    pub(super) fn message(self, format: ImageFormat, spec: &ModelSpec) -> Result<ServerMessage, StepError> {
        let Self {
            seq,
            timestamp_us,
            skipped,
            have,
            prediction,
        } = self;
        let Some((prediction, rollout)) = prediction.as_ref().and_then(|all| Some((all, all.rollouts.first()?))) else {
            if have == spec.context {
                return Ok(ServerMessage::Overtaken {
                    seq,
                    timestamp_us,
                    skipped,
                });
            }
            return Ok(ServerMessage::Buffering {
                seq,
                timestamp_us,
                have,
                need: spec.context,
                skipped,
            });
        };
        let format = format.answer();
        Ok(ServerMessage::Prediction {
            seq,
            timestamp_us,
            frames: images::encode(&rollout.frames, format)?,
            format,
            expected_mse: rollout.expected_mse(),
            mse_band_90: rollout.mse_bands(),
            novelty: rollout.novelty,
            beyond_training: prediction.beyond_training(),
            warnings: prediction.warnings.clone(),
            timing: prediction.timing,
            dropped: 0,
            skipped,
        })
    }
}
