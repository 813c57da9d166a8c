//! A client's message while it is read: each field goes into its own type at once. What serde derives for the tagged enum
//! would first store the whole message in a form that takes up to a hundred times its bytes.

use serde::Deserialize;

use super::{ClientMessage, CloseMessage, ConfigureMessage, FrameMessage, OnGap, OnLate, PingMessage};
use crate::server::bounded_list::List;
use crate::server::images::{ImageBytes, ImageFormat};
use crate::server::plans::request::SessionPlanRequest;
use foreframe_core::frame::resize::Resize;

/// Every field that any message has.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct AnyMessage {
    r#type: MessageKind,
    seq: Option<u64>,
    timestamp_us: Option<i64>,
    image: Option<ImageBytes>,
    format: Option<ImageFormat>,
    action: Option<List<f64>>,
    state: Option<List<f64>>,
    plan: Option<List<List<f64>>>,
    steps: Option<usize>,
    on_gap: Option<OnGap>,
    on_late: Option<OnLate>,
    resize: Option<Resize>,
    plan_every: Option<u64>,
    plan_request: Option<Box<SessionPlanRequest>>,
}

#[derive(Clone, Copy, Deserialize)]
#[serde(rename_all = "snake_case")]
enum MessageKind {
    Frame,
    Configure,
    Ping,
    Close,
}

impl TryFrom<AnyMessage> for ClientMessage {
    type Error = String;

    fn try_from(mut any: AnyMessage) -> Result<Self, String> {
        let message = match any.r#type {
            MessageKind::Frame => Self::Frame(FrameMessage {
                seq: any.seq.take().ok_or_else(|| missing("seq"))?,
                timestamp_us: any.timestamp_us.take().ok_or_else(|| missing("timestamp_us"))?,
                image: any.image.take().ok_or_else(|| missing("image"))?,
                format: any.format.take().unwrap_or_default(),
                action: any.action.take().map(numbers),
                state: any.state.take().map(numbers),
                plan: any.plan.take().map(|plan| plan.0.into_iter().map(numbers).collect()),
                steps: any.steps.take(),
            }),
            MessageKind::Configure => Self::Configure(ConfigureMessage {
                on_gap: any.on_gap.take(),
                on_late: any.on_late.take(),
                format: any.format.take(),
                resize: any.resize.take(),
                plan_every: any.plan_every.take(),
                plan_request: any.plan_request.take(),
            }),
            MessageKind::Ping => Self::Ping(PingMessage {
                timestamp_us: any.timestamp_us.take().unwrap_or_default(),
            }),
            MessageKind::Close => Self::Close(CloseMessage {}),
        };
        any.unused().map_or(Ok(message), |field| {
            Err(format!("unknown field `{field}`: a message of this type has none"))
        })
    }
}

impl AnyMessage {
    /// A field that the message's type does not have.
    fn unused(&self) -> Option<&'static str> {
        let fields = [
            ("seq", self.seq.is_some()),
            ("timestamp_us", self.timestamp_us.is_some()),
            ("image", self.image.is_some()),
            ("format", self.format.is_some()),
            ("action", self.action.is_some()),
            ("state", self.state.is_some()),
            ("plan", self.plan.is_some()),
            ("steps", self.steps.is_some()),
            ("on_gap", self.on_gap.is_some()),
            ("on_late", self.on_late.is_some()),
            ("resize", self.resize.is_some()),
            ("plan_every", self.plan_every.is_some()),
            ("plan_request", self.plan_request.is_some()),
        ];
        fields
            .into_iter()
            .find(|(_, is_unused)| *is_unused)
            .map(|(name, _)| name)
    }
}

fn missing(field: &str) -> String {
    format!("missing field `{field}`")
}

/// A number too large for `f32` becomes infinite; the check of the field refuses it.
fn numbers(list: List<f64>) -> Vec<f32> {
    list.0.into_iter().map(|value| value as f32).collect()
}
