//! Plans with the frames of a stream: which frames get one, and the search. One plan is searched for at a time, after its frame's
//! prediction is on its way; a plan that is due meanwhile is skipped and counted.

use std::sync::Arc;
use std::time::Instant;

use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use super::protocol::{ConfigureMessage, ServerMessage, SessionSettings, WarningCode};
use super::session::Session;
use super::socket::StreamServices;
use crate::server::http::problem::{ApiError, unfit};
use crate::server::plans::request::SessionPlanRequest;
use crate::server::plans::response::PlanResponse;
use crate::server::plans::search::PlanTask;
use foreframe_core::error_text::without_middle;
use foreframe_core::frame::resize::Resize;
use foreframe_core::planning::Planner;
use foreframe_core::serving::SessionState;
use foreframe_core::types::RobotState;

/// How large the image of a goal may be that a stream keeps, in bytes.
const MAX_IMAGE_BYTES: usize = 1 << 20;

/// Which frames get a plan.
pub(super) struct PlanSchedule {
    /// 0: none does.
    every: u64,
    request: Option<Box<SessionPlanRequest>>,
    /// Predictions until the next plan.
    until_due: u64,
    /// Plans that were due while another one was searched for, since the last one that began.
    skipped: u64,
    /// The search takes its one place.
    place: Arc<Semaphore>,
}

/// A plan that is due.
pub(super) struct DuePlan {
    seq: u64,
    timestamp_us: i64,
    skipped: u64,
    request: SessionPlanRequest,
    state: SessionState,
    settings: SessionSettings,
    begun: Instant,
    places: Arc<[OwnedSemaphorePermit; 2]>,
}

impl PlanSchedule {
    pub(super) fn new() -> Self {
        Self {
            every: 0,
            request: None,
            until_due: 0,
            skipped: 0,
            place: Arc::new(Semaphore::new(1)),
        }
    }

    /// Takes what a message says of plans. Errors: a goal or a setting does not fit the model, or there is no goal; then nothing changes.
    pub(super) async fn configure(
        &mut self,
        message: &ConfigureMessage,
        session: &Session,
        services: &StreamServices,
    ) -> Result<(), ApiError> {
        let every = message.plan_every.unwrap_or(self.every);
        if let Some(request) = &message.plan_request {
            let bytes = request.image_bytes();
            if bytes > MAX_IMAGE_BYTES {
                return Err(ApiError::Unprocessable(format!(
                    "goal.image has {bytes} bytes; a stream keeps at most {MAX_IMAGE_BYTES}"
                )));
            }
            check(request.as_ref().clone(), message.resize, session, services).await?;
            self.request = Some(request.clone());
        } else if every > 0 && self.request.is_none() {
            return Err(ApiError::Unprocessable(format!(
                "plan_every is {every}, but there is no goal; give plan_request with a goal"
            )));
        }
        if message.plan_every.is_some() {
            (self.every, self.until_due) = (every, 0);
        }
        Ok(())
    }

    /// The plan that is due after an answer of the stream, if one is.
    pub(super) fn due(
        &mut self,
        answer: &ServerMessage,
        session: &Session,
        services: &StreamServices,
    ) -> Option<DuePlan> {
        let &ServerMessage::Prediction { seq, timestamp_us, .. } = answer else {
            return None;
        };
        let request = self.request.as_ref().filter(|_| self.every > 0)?;
        if self.until_due > 0 {
            self.until_due -= 1;
            return None;
        }
        self.until_due = self.every - 1;
        let places = Arc::clone(&self.place).try_acquire_owned().ok();
        let Some((place, admitted)) = places.and_then(|place| Some((place, services.admission.enter().ok()?))) else {
            self.skipped += 1;
            return None;
        };
        let (state, settings) = session.state();
        Some(DuePlan {
            seq,
            timestamp_us,
            skipped: std::mem::take(&mut self.skipped),
            request: request.as_ref().clone(),
            state,
            settings,
            begun: Instant::now(),
            places: Arc::new([place, admitted]),
        })
    }
}

/// Errors: what of the request does not fit the model.
async fn check(
    request: SessionPlanRequest,
    resize: Option<Resize>,
    session: &Session,
    services: &StreamServices,
) -> Result<(), ApiError> {
    let (model, config) = (Arc::clone(&session.model), Arc::clone(&services.config));
    let (state, settings) = session.state();
    let check = move || {
        let mut input = request.into_input(&state, resize.or(settings.resize), &model.manifest, &config)?;
        let states = &model.spec().states;
        if input.state.is_none() && !states.is_empty() {
            // It comes with the frames.
            let means: Vec<f32> = states.iter().map(|channel| channel.mean).collect();
            input.state = Some(RobotState::try_from(means).map_err(unfit("state"))?);
        }
        Planner::new(&model, input)?;
        Ok(())
    };
    services.blocking.run(check).await?
}

impl DuePlan {
    /// Hold it until the client has the plan: then the next one may be due.
    pub(super) fn places(&self) -> Arc<[OwnedSemaphorePermit; 2]> {
        Arc::clone(&self.places)
    }

    /// Searches for the plan; what to tell the client.
    pub(super) async fn search(self, session: &Session, services: &StreamServices) -> ServerMessage {
        let (seq, timestamp_us, skipped) = (self.seq, self.timestamp_us, self.skipped);
        match self.answer(session, services).await {
            Ok(answer) => ServerMessage::Plan {
                seq,
                timestamp_us,
                answer,
                skipped,
            },
            Err(error) => ServerMessage::Warning {
                code: WarningCode::Plan,
                detail: without_middle(&format!("there is no plan for seq {seq}: {}", error.into_detail())),
            },
        }
    }

    async fn answer(self, session: &Session, services: &StreamServices) -> Result<Box<PlanResponse>, ApiError> {
        let (model, begun, form) = (Arc::clone(&session.model), self.begun, self.request.form());
        let task = PlanTask {
            context: self.state.rollout_task(Vec::new(), model.spec()),
            model: Arc::clone(&model),
            session: Some(session.key),
            begun,
        };
        let (config, resize) = (Arc::clone(&services.config), self.settings.resize);
        let decode = move || self.request.into_input(&self.state, resize, &model.manifest, &config);
        let input = services.blocking.run(decode).await??;
        let found = task.run(&services.predictor, &services.blocking, input).await?;
        let encode = move || PlanResponse::new(form, &found.model.manifest, found.choice, begun.elapsed());
        services.blocking.run(encode).await?.map(Box::new)
    }
}
