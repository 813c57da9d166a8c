//! The rules of a session: which frame is next, what was answered, what a gap means. Knows no lock, no clock and no thread.

use std::sync::Arc;

use super::protocol::{
    ErrorCode, FrameMessage, OnGap, OnLate, ServerMessage, SessionSettings, Timing, beyond_training,
};
use crate::frame::Frame;
use crate::frame::fit::Fit;
use crate::nn::ModelSpec;
use crate::registry::Manifest;
use crate::server::blocking::TaskError;
use crate::server::images::{self, ImageError, ImageFormat, ImageInput};
use crate::serving::{
    ConditioningInput, InputError, RawConditioning, Rollout, STEP_FIELDS, ServingError, SessionState, Task, TaskOutput,
};
use crate::types::{Action, RobotState, ValueError};

/// A frame that fits the model.
#[derive(Clone, Debug)]
pub(in crate::server) struct FrameStep {
    pub(in crate::server) seq: u64,
    pub(in crate::server) timestamp_us: i64,
    pub(in crate::server) frame: Frame,
    pub(in crate::server) conditioning: ConditioningInput,
    pub(in crate::server) format: ImageFormat,
    /// Whether newer frames wait behind this one, so that it may go without a prediction.
    pub(in crate::server) is_overtaken: bool,
}

impl FrameStep {
    /// Checks the message and decodes its image, which takes long unless the image is raw. Errors name the field.
    pub(in crate::server) fn new(
        message: FrameMessage,
        fit: Option<Fit>,
        manifest: &Manifest,
        max_steps: usize,
    ) -> Result<Self, StepError> {
        let limit = max_steps.max(manifest.spec.horizon);
        if let Some(found) = message.steps.filter(|steps| *steps > limit) {
            return Err(StepError::Steps { found, limit });
        }
        let action = |field| {
            move |values: Vec<f32>| Action::try_from(values).map_err(|source| StepError::Value { field, source })
        };
        let past: Option<Action> = message.action.map(action("action")).transpose()?;
        let plan: Option<Vec<Action>> = message
            .plan
            .map(|plan| plan.into_iter().map(action("plan")).collect())
            .transpose()?;
        let state = message.state.map(RobotState::try_from).transpose();
        let state = state.map_err(|source| StepError::Value { field: "state", source })?;
        let given = RawConditioning {
            past: past.as_slice(),
            future: plan.as_deref(),
            state: state.as_ref(),
            steps: message.steps,
        };
        let format = message.format;
        Ok(Self {
            seq: message.seq,
            timestamp_us: message.timestamp_us,
            conditioning: ConditioningInput::new(given, &STEP_FIELDS, &manifest.name, &manifest.spec)?,
            frame: images::decode("image", message.image, ImageInput { format, fit }, manifest)?,
            format,
            is_overtaken: false,
        })
    }
}

/// Why a frame was refused. The session stays as it was.
#[derive(Debug, thiserror::Error)]
pub(in crate::server) enum StepError {
    #[error("seq is {found}; seq {expected} is next")]
    Gap { found: u64, expected: u64 },
    #[error("seq is {0}; the greatest is one less")]
    Seq(u64),
    #[error("steps is {found}; this server predicts 1 to {limit}")]
    Steps { found: usize, limit: usize },
    #[error(transparent)]
    Image(#[from] ImageError),
    #[error("{field}: {source}")]
    Value { field: &'static str, source: ValueError },
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
            Self::Serving(ServingError::QueueFull { .. } | ServingError::Deadline { .. } | ServingError::Stopped) => {
                ErrorCode::Overloaded
            }
            Self::Serving(ServingError::Input(_))
            | Self::Seq(_)
            | Self::Steps { .. }
            | Self::Image(_)
            | Self::Value { .. }
            | Self::Input(_)
            | Self::NotOwner => ErrorCode::Invalid,
            Self::Serving(_) => ErrorCode::Internal,
        }
    }
}

/// The state of a session with its last answer.
pub(super) struct SessionCore {
    pub(super) state: SessionState,
    pub(super) settings: SessionSettings,
    /// `None` before the first frame, and after an import: then the last answer is computed again on request.
    last_answer: Option<CachedAnswer>,
}

/// The answer to the last frame.
#[derive(Clone)]
pub(super) struct CachedAnswer {
    seq: u64,
    timestamp_us: i64,
    skipped: u64,
    have: usize,
    /// `None` while the context is not full, and for a frame that was overtaken.
    prediction: Option<Arc<StepPrediction>>,
}

/// A prediction, and how long it took.
pub(super) struct StepPrediction {
    rollout: Rollout,
    warnings: Vec<String>,
    timing: Timing,
}

/// What a frame needs.
pub(super) enum PendingStep {
    /// Nothing: it was answered before.
    Answered(CachedAnswer),
    /// Compute this, then [`SessionCore::commit`].
    New { task: Task, skipped: u64 },
    /// Compute this, then [`SessionCore::cache`].
    Again(Task),
}

impl SessionCore {
    pub(super) fn new(state: SessionState, settings: SessionSettings) -> Self {
        Self {
            state,
            settings,
            last_answer: None,
        }
    }

    /// What the step needs. Changes nothing; [`SessionCore::commit`] does, once the result is there.
    pub(super) fn begin(&self, step: &FrameStep, spec: &ModelSpec) -> Result<PendingStep, StepError> {
        let next = self.state.next_seq();
        if step.seq == u64::MAX {
            return Err(StepError::Seq(step.seq));
        }
        if step.seq < next {
            return Ok(match (&self.last_answer, self.state.repeat_task(spec)) {
                (Some(answer), _) => PendingStep::Answered(answer.clone()),
                (None, Some(task)) => PendingStep::Again(task),
                (None, None) => PendingStep::Answered(self.answer(step.timestamp_us, 0, None)),
            });
        }
        if step.seq > next && self.settings.on_gap == OnGap::Error {
            return Err(StepError::Gap {
                found: step.seq,
                expected: next,
            });
        }
        let conditioning = (!self.is_skipped(step)).then(|| step.conditioning.clone());
        Ok(PendingStep::New {
            task: self.state.step(step.frame.clone(), conditioning, spec),
            skipped: step.seq - next,
        })
    }

    /// Whether the step gets no prediction.
    fn is_skipped(&self, step: &FrameStep) -> bool {
        step.is_overtaken && self.settings.on_late == OnLate::Skip
    }

    /// Advances the session by the step, of which this is the result.
    pub(super) fn commit(
        &mut self,
        step: FrameStep,
        mut computed: TaskOutput,
        skipped: u64,
        spec: &ModelSpec,
    ) -> CachedAnswer {
        if let Some(features) = computed.features.pop() {
            self.state.advance(step.seq, features, step.conditioning, spec);
        }
        self.cache(step.timestamp_us, skipped, computed)
    }

    /// Caches the result as the answer to the last frame.
    pub(super) fn cache(&mut self, timestamp_us: i64, skipped: u64, computed: TaskOutput) -> CachedAnswer {
        let timing = Timing {
            queue_us: computed.queue_us,
            compute_us: computed.compute_us,
        };
        let warnings = computed.warnings;
        let rollout = computed.predictions.into_iter().next();
        let prediction = rollout.map(|rollout| {
            Arc::new(StepPrediction {
                rollout,
                warnings,
                timing,
            })
        });
        let answer = self.answer(timestamp_us, skipped, prediction);
        self.last_answer = Some(answer.clone());
        answer
    }

    fn answer(&self, timestamp_us: i64, skipped: u64, prediction: Option<Arc<StepPrediction>>) -> CachedAnswer {
        CachedAnswer {
            seq: self.state.next_seq().saturating_sub(1),
            timestamp_us,
            skipped,
            have: self.state.frame_count(),
            prediction,
        }
    }
}

impl CachedAnswer {
    /// Whether [`CachedAnswer::message`] has to compress images, which takes long.
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
        let Some(prediction) = prediction else {
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
            frames: images::encode(&prediction.rollout.frames, format)?,
            format,
            expected_mse: prediction.rollout.expected_mse(),
            mse_band_90: prediction.rollout.mse_bands(),
            novelty: prediction.rollout.novelty,
            beyond_training: beyond_training(prediction.rollout.frames.len(), spec),
            warnings: prediction.warnings.clone(),
            timing: prediction.timing,
            dropped: 0,
            skipped,
        })
    }
}
