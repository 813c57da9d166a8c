//! The frames of a robot, and the predictions that the library makes of them one after another.

use std::sync::Arc;

use foreframe::server::protocol::{ClientMessage, FrameMessage};
use foreframe::server::{ImageBytes, ImageFormat};
use foreframe_core::frame::{Frame, codec};
use foreframe_core::registry::Model;
use foreframe_core::serving::Session;
use foreframe_core::types::{Action, RobotState};
use tokio_tungstenite::tungstenite::Message;

use crate::workload::{self, Workload};

/// After this many frames, a robot's frames, actions and states repeat.
const PERIOD: u64 = 60;
/// Steps through the example frames from which no divisor of their number follows.
const STRIDES: [u64; 4] = [1, 2, 4, 7];

/// What one robot sends, and the answers to expect. Frames are counted from 0 and have no end.
pub(super) struct RobotRecording {
    messages: Vec<FrameMessage>,
    /// The predictions after frame `context - 1` and the frames after it.
    expected: Vec<Vec<Frame>>,
    context: u64,
}

impl RobotRecording {
    pub(super) fn new(robot: u64, workload: &Workload, model: &Model) -> Self {
        let messages: Vec<FrameMessage> = (0..PERIOD).map(|index| message(robot, index, workload)).collect();
        let context = workload.context();
        let (mut session, mut expected) = (Session::new(Arc::new(model.clone())), Vec::new());
        for seq in 0..PERIOD + context - 1 {
            let message = &messages[(seq % PERIOD) as usize];
            expected.extend(predict(&mut session, message));
        }
        Self {
            messages,
            expected,
            context,
        }
    }

    pub(super) fn frame(&self, seq: u64) -> Message {
        let message = self.messages[(seq % PERIOD) as usize].clone();
        workload::message(&ClientMessage::Frame(FrameMessage { seq, ..message }))
    }

    /// Whether the answer to a frame is that the context is not full.
    pub(super) fn is_buffered(&self, seq: u64) -> bool {
        seq + 1 < self.context
    }

    /// Whether predicted frames are those of the library.
    pub(super) fn is_right(&self, seq: u64, frames: &[ImageBytes]) -> bool {
        let index = (seq + 1).checked_sub(self.context).map(|index| index % PERIOD);
        let found = frames.iter().map(|frame| frame.0.as_slice());
        index.is_some_and(|index| are_equal(found, &self.expected[index as usize]))
    }
}

fn message(robot: u64, index: u64, workload: &Workload) -> FrameMessage {
    let stride = STRIDES[(robot % STRIDES.len() as u64) as usize];
    let value = 0.05 * ((index % 4) + robot % 3) as f32;
    FrameMessage {
        steps: None,
        seq: index,
        timestamp_us: 0,
        image: ImageBytes(workload.pixels((robot + stride * index) as usize).to_vec()),
        format: ImageFormat::Raw,
        action: workload.spec().action_inputs().map(|count| vec![value; count]),
        state: workload.spec().state_inputs().map(|count| vec![0.1 + value; count]),
        plan: None,
    }
}

fn predict(session: &mut Session, message: &FrameMessage) -> Option<Vec<Frame>> {
    let spec = session.model().spec();
    let frame = Frame::new(spec.frame_width_px, spec.frame_height_px, message.image.0.clone()).unwrap();
    let action = message.action.clone().map(|action| Action::try_from(action).unwrap());
    let state = message.state.clone().map(|state| RobotState::try_from(state).unwrap());
    let plan = action.map(|action| vec![action; spec.horizon]);
    let predicted = session.step(frame, state.as_ref(), plan.as_deref()).unwrap();
    predicted.map(|rollout| rollout.frames)
}

/// Whether predicted images are those of the library.
pub(super) fn are_equal<'a>(found: impl Iterator<Item = &'a [u8]>, expected: &[Frame]) -> bool {
    found.eq(expected.iter().map(Frame::pixels))
}

/// The same for PNG files.
pub(super) fn are_equal_png(found: &[ImageBytes], expected: &[Frame]) -> bool {
    let decoded: Option<Vec<Frame>> = found.iter().map(|file| codec::decode(&file.0).ok()).collect();
    decoded.is_some_and(|frames| are_equal(frames.iter().map(Frame::pixels), expected))
}
