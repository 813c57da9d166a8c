//! Predictions for the images of a running robot: brings them to the model's frame rate, and compares each with what was predicted
//! for it.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Duration;

use super::BridgeError;
use foreframe_core::frame::resize::{Resize, resize};
use foreframe_core::frame::{Frame, quality};
use foreframe_core::registry::Model;
use foreframe_core::serving::Session;
use foreframe_core::types::{Action, RobotState};

/// A frame that is this share of a period early is not left out: a camera's clock is not exact.
const EARLY: f64 = 0.25;
/// A gap longer than this many frame periods starts a new context.
const GAP: f64 = 2.5;

/// What a message held.
pub(super) enum Seen {
    Image(Frame),
    Action(Action),
    State(RobotState),
}

/// What is known after a frame.
#[derive(Clone, Debug, Default)]
pub(crate) struct LiveStep {
    /// The last frame that is predicted from it, a horizon ahead; `None` while the context is not full.
    pub(crate) predicted: Option<Frame>,
    /// The time that this frame is of, in nanoseconds.
    pub(crate) predicted_time_ns: u64,
    /// The mean squared error of what was predicted for this frame a horizon ago, intensities 0…1; `None` if nothing was.
    pub(crate) error: Option<f64>,
    /// The error to expect of the predicted frame; `None` if the model is not calibrated.
    pub(crate) expected_error: Option<f64>,
}

pub(super) struct LivePrediction {
    model: Arc<Model>,
    session: Session,
    action: Option<Action>,
    state: Option<TimedState>,
    /// How far the times of a state and an image may be apart.
    state_age_limit: Duration,
    /// Whether the last state was too old for the last image.
    has_old_state: bool,
    /// The time of the last frame, and when the next one is due.
    last_ns: Option<u64>,
    due_ns: u64,
    /// What was predicted for the frames to come, the next one first; `None` for those without a prediction.
    expected: VecDeque<Option<Frame>>,
}

struct TimedState {
    state: RobotState,
    time_ns: u64,
}

impl LivePrediction {
    pub(super) fn new(model: Arc<Model>, state_age_limit: Duration) -> Self {
        Self {
            session: Session::new(Arc::clone(&model)),
            model,
            action: None,
            state: None,
            state_age_limit,
            has_old_state: false,
            last_ns: None,
            due_ns: 0,
            expected: VecDeque::new(),
        }
    }

    pub(super) fn set_action(&mut self, action: Action) {
        self.action = Some(action);
    }

    pub(super) fn set_state(&mut self, state: RobotState, time_ns: u64) {
        self.state = Some(TimedState { state, time_ns });
    }

    /// Whether the last state was too old for the last image, and so was not used.
    pub(super) fn has_old_state(&self) -> bool {
        self.has_old_state
    }

    /// Predicts from an image; `None` if it comes between two frames of the model, or the model needs an action or a state and there is
    /// none, or only a state that is too old. Errors: `Frame`, `Serving`.
    pub(super) fn step(&mut self, image: &Frame, time_ns: u64) -> Result<Option<LiveStep>, BridgeError> {
        let model = Arc::clone(&self.model);
        let spec = model.spec();
        let state = self.current_state(time_ns);
        let lacks = |is_taken: bool, is_known: bool| is_taken && !is_known && !spec.sees_speeds();
        if lacks(spec.action_inputs().is_some(), self.action.is_some())
            || lacks(spec.state_inputs().is_some(), state.is_some())
        {
            return Ok(None);
        }
        let period_ns = spec.frame_period_s * 1e9;
        if !self.is_due(time_ns, period_ns) {
            return Ok(None);
        }
        let (width, height, horizon) = (spec.frame_width_px, spec.frame_height_px, spec.horizon);
        let frame = resize(image, width, height, Resize::Crop)?;
        let plan = self.action.as_ref().map(|action| vec![action.clone(); horizon]);
        let rollout = self.session.step(frame.clone(), state.as_ref(), plan.as_deref())?;
        let error = self.expected.pop_front().flatten().map(|expected| {
            let levels = |frame: &Frame| {
                frame
                    .pixels()
                    .iter()
                    .map(|&level| f32::from(level) / 255.0)
                    .collect::<Vec<_>>()
            };
            quality::mse(&levels(&expected), &levels(&frame))
        });
        let predicted = rollout.as_ref().and_then(|rollout| rollout.frames.last().cloned());
        self.expected.resize(horizon - 1, None);
        self.expected.push_back(predicted.clone());
        Ok(Some(LiveStep {
            predicted,
            predicted_time_ns: time_ns.saturating_add((horizon as f64 * period_ns) as u64),
            error,
            expected_error: rollout.and_then(|rollout| Some(f64::from(rollout.expected_mse().last().copied()?))),
        }))
    }

    /// The last state, if it counts as the present one at this time: if the clock goes back, one from before does not.
    fn current_state(&mut self, time_ns: u64) -> Option<RobotState> {
        let limit = self.state_age_limit;
        let is_old = |state: &TimedState| Duration::from_nanos(state.time_ns.abs_diff(time_ns)) > limit;
        self.has_old_state = self.state.as_ref().is_some_and(is_old);
        let current = self.state.as_ref().filter(|_| !self.has_old_state);
        current.map(|timed| timed.state.clone())
    }

    /// Whether an image of this time is the next frame. Begins anew after a gap, or if time goes back.
    fn is_due(&mut self, time_ns: u64, period_ns: f64) -> bool {
        let is_continued = self
            .last_ns
            .is_some_and(|last_ns| time_ns >= last_ns && ((time_ns - last_ns) as f64) < GAP * period_ns);
        if !is_continued {
            self.session = Session::new(Arc::clone(&self.model));
            self.expected.clear();
            self.due_ns = time_ns;
        }
        if (time_ns as f64) + EARLY * period_ns < self.due_ns as f64 {
            return false;
        }
        self.last_ns = Some(time_ns);
        // Later ones are not due sooner because this one was late.
        self.due_ns = if time_ns as f64 > self.due_ns as f64 + period_ns {
            time_ns
        } else {
            self.due_ns
        };
        self.due_ns += period_ns as u64;
        true
    }
}
