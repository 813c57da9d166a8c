//! The rules of a session: what is next, what was answered, what a gap means. Knows no lock, no clock and no thread.

use std::sync::Arc;

use crate::frame::Frame;
use crate::nn::ModelSpec;
use crate::server::images::{self, ImageError, ImageFormat};
use crate::server::protocol::{ErrorCode, OnGap, OnLate, ServerMessage, Timing};
use crate::serving::{ConditioningInput, InputError, ServingError, SessionState, Task, TaskOutput};
use crate::types::ValueError;

/// A frame whose values fit the model.
#[derive(Clone, Debug)]
pub(in crate::server) struct FrameStep {
    pub(in crate::server) seq: u64,
    pub(in crate::server) timestamp_us: i64,
    pub(in crate::server) frame: Frame,
    pub(in crate::server) premise: ConditioningInput,
    pub(in crate::server) format: ImageFormat,
    /// Whether newer frames wait behind this one, and need not wait for it to be predicted from.
    pub(in crate::server) is_overtaken: bool,
}

/// Why a frame was refused; the session stands where it stood.
#[derive(Debug, thiserror::Error)]
pub(in crate::server) enum StepError {
    #[error("seq is {found}; seq {expected} is next")]
    Gap { found: u64, expected: u64 },
    #[error("seq is {0}; the greatest is one less")]
    Seq(u64),
    #[error(transparent)]
    Image(#[from] ImageError),
    #[error("{field}: {source}")]
    Value { field: &'static str, source: ValueError },
    #[error(transparent)]
    Input(#[from] InputError),
    #[error(transparent)]
    Serving(#[from] ServingError),
    #[error("the session is held by another connection")]
    NotHeld,
}

impl StepError {
    pub(in crate::server) fn code(&self) -> ErrorCode {
        match self {
            Self::Gap { .. } => ErrorCode::Gap,
            Self::Image(ImageError::Encode(_)) => ErrorCode::Internal,
            Self::Serving(ServingError::QueueFull { .. } | ServingError::Deadline { .. } | ServingError::Stopped) => {
                ErrorCode::Overloaded
            }
            Self::Serving(ServingError::Input(_))
            | Self::Seq(_)
            | Self::Image(_)
            | Self::Value { .. }
            | Self::Input(_)
            | Self::NotHeld => ErrorCode::Invalid,
            Self::Serving(_) => ErrorCode::Internal,
        }
    }
}

/// How a session behaves.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(in crate::server) struct Settings {
    pub(in crate::server) on_gap: OnGap,
    pub(in crate::server) on_late: OnLate,
    pub(in crate::server) format: Option<ImageFormat>,
}

/// What a session remembers, with its last answer.
pub(super) struct SessionCore {
    pub(super) state: SessionState,
    pub(super) settings: Settings,
    /// None before the first frame and after an import, where the last answer is computed again.
    kept: Option<CachedAnswer>,
}

/// The answer to the last frame.
#[derive(Clone)]
pub(super) struct CachedAnswer {
    seq: u64,
    timestamp_us: i64,
    skipped: u64,
    have: usize,
    /// None while the context was not full, and of a frame that was overtaken.
    prediction: Option<(Arc<[Frame]>, Timing)>,
}

/// What a frame needs.
pub(super) enum PendingStep {
    /// It has been answered.
    CachedAnswer(CachedAnswer),
    /// This is to be computed, and committed.
    New { task: Task, skipped: u64 },
    /// This is to be computed, and kept.
    Again(Task),
}

impl SessionCore {
    pub(super) fn new(state: SessionState, settings: Settings) -> Self {
        Self {
            state,
            settings,
            kept: None,
        }
    }

    /// Changes nothing: what came of it is for [`SessionCore::commit`].
    pub(super) fn begin(&self, step: &FrameStep, spec: &ModelSpec) -> Result<PendingStep, StepError> {
        let next = self.state.next_seq();
        if step.seq == u64::MAX {
            return Err(StepError::Seq(step.seq));
        }
        if step.seq < next {
            return Ok(match (&self.kept, self.state.repeat_task(spec)) {
                (Some(kept), _) => PendingStep::CachedAnswer(kept.clone()),
                (None, Some(task)) => PendingStep::Again(task),
                (None, None) => PendingStep::CachedAnswer(self.last(step.timestamp_us, 0, None)),
            });
        }
        if step.seq > next && self.settings.on_gap == OnGap::Error {
            return Err(StepError::Gap {
                found: step.seq,
                expected: next,
            });
        }
        let premise = (!self.is_skipped(step)).then(|| step.premise.clone());
        Ok(PendingStep::New {
            task: self.state.step(step.frame.clone(), premise, spec),
            skipped: step.seq - next,
        })
    }

    /// Whether nothing is to be predicted from the step.
    fn is_skipped(&self, step: &FrameStep) -> bool {
        step.is_overtaken && self.settings.on_late == OnLate::Skip
    }

    /// Takes the step, of which this was computed.
    pub(super) fn commit(
        &mut self,
        step: FrameStep,
        mut computed: TaskOutput,
        skipped: u64,
        spec: &ModelSpec,
    ) -> CachedAnswer {
        if let Some(features) = computed.features.pop() {
            self.state.advance(step.seq, features, step.premise, spec);
        }
        self.keep(step.timestamp_us, skipped, computed)
    }

    /// Keeps what was computed as the answer to the last frame.
    pub(super) fn keep(&mut self, timestamp_us: i64, skipped: u64, computed: TaskOutput) -> CachedAnswer {
        let timing = Timing {
            queue_us: computed.queue_us,
            compute_us: computed.compute_us,
        };
        let future = computed.predictions.into_iter().next();
        let prediction = future.map(|frames| (frames.into(), timing));
        let kept = self.last(timestamp_us, skipped, prediction);
        self.kept = Some(kept.clone());
        kept
    }

    fn last(&self, timestamp_us: i64, skipped: u64, prediction: Option<(Arc<[Frame]>, Timing)>) -> CachedAnswer {
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
    pub(super) fn answer(self, format: ImageFormat, spec: &ModelSpec) -> Result<ServerMessage, StepError> {
        let Self {
            seq,
            timestamp_us,
            skipped,
            have,
            prediction,
        } = self;
        let Some((frames, timing)) = prediction else {
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
            frames: images::encode(&frames, format)?,
            format,
            timing,
            dropped: 0,
            skipped,
        })
    }
}
