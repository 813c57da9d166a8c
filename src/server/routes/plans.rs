//! Plans: what the robot should do to reach a goal, chosen by what is expected to happen.

mod bodies;

use std::sync::Arc;
use std::time::{Duration, Instant};

use axum::response::Response;
use metrics::{counter, histogram};
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use self::bodies::{PlanRequest, PlanResponse, SessionPlanRequest};
use super::picture;
use super::sessions::AuthorizedSession;
use crate::server::http::extract::{Path, ResponseFormat};
use crate::server::http::multipart::BodyOrForm;
use crate::server::http::problem::ApiError;
use crate::server::http::structured::{JsonOrMsgpack, structured};
use crate::server::state::App;
use foreframe_core::metric_names;
use foreframe_core::planning::{PlanBatch, PlanChoice, PlanContext, PlanError, Planner, PlannerInput};
use foreframe_core::registry::Model;
use foreframe_core::serving::{ConditioningInput, Prediction};
use foreframe_core::types::RobotState;

pub(in crate::server) fn routes() -> OpenApiRouter<App> {
    OpenApiRouter::new()
        .routes(routes!(model_plan))
        .routes(routes!(session_plan))
}

/// Searches for the plan that reaches a goal best, from a context. If no plan is safe, the answer is to stop, with the reason.
/// `Accept: image/png` gives a contact sheet: the context, then the frames predicted under the best plan and under each of the
/// runners-up.
#[utoipa::path(
    post, path = "/v1/models/{model}/plan", request_body(content((PlanRequest = "application/json"), (PlanRequest = "application/msgpack"))),
    responses(
        (status = 200, description = "The best plan", content(
            (PlanResponse = "application/json"), (PlanResponse = "application/msgpack"), (Vec<u8> = "image/png"), (Vec<u8> = "image/gif"),
        )),
        (status = 400, description = "Not what its Content-Type says"),
        (status = 406, description = "Too many for a picture, or no media type in `Accept` is supported"),
        (status = 413, description = "A body, a list or an answer exceeds its limit"),
        (status = 422, description = "A goal, a setting or a context that does not fit the model"),
        (status = 503, description = "Too many predictions wait"),
    )
)]
async fn model_plan(
    app: App,
    Path(model): Path<String>,
    wanted: ResponseFormat,
    BodyOrForm(request): BodyOrForm<PlanRequest>,
) -> Result<Response, ApiError> {
    let begun = Instant::now();
    let model = app.predictor().active(&model)?;
    let _place = app.admission.enter()?;
    let (manifest, config) = (Arc::clone(&model.manifest), Arc::clone(&app.config));
    let answer = request.answer_form(wanted);
    let decode = move || request.into_search(wanted, &manifest, &config);
    let (seen, context, input) = app.predictions.run(decode).await??;
    let search = Search {
        model,
        context,
        session: None,
        begun,
    };
    let choice = search.run(&app, input).await?;
    let encode = move || answer.of(choice, &seen, begun.elapsed());
    picture::threads_for(&app, wanted).run(encode).await?
}

/// Searches for the plan that reaches a goal best, from the session's last frame. The plan of that frame is one of the candidates. The
/// session does not change.
#[utoipa::path(
    post, path = "/v1/sessions/{id}/plan",
    request_body(content((SessionPlanRequest = "application/json"), (SessionPlanRequest = "application/msgpack"))),
    params(("id" = String, Path), ("x-session-token" = Option<String>, Header)),
    responses(
        (status = 200, description = "The best plan", content(
            (PlanResponse = "application/json"), (PlanResponse = "application/msgpack"), (Vec<u8> = "image/png"), (Vec<u8> = "image/gif"),
        )),
        (status = 409, description = "The session has not enough frames yet"),
        (status = 413, description = "A body, a list or an answer exceeds its limit"),
        (status = 422, description = "A goal or a setting that does not fit the model"),
        (status = 503, description = "Too many predictions wait"),
    )
)]
async fn session_plan(
    app: App,
    AuthorizedSession(session): AuthorizedSession,
    wanted: ResponseFormat,
    JsonOrMsgpack(request): JsonOrMsgpack<SessionPlanRequest>,
) -> Result<Response, ApiError> {
    let begun = Instant::now();
    let model = Arc::clone(&session.model);
    let (state, settings) = session.state();
    let (have, need) = (state.frame_count(), model.manifest.spec.context);
    if have < need {
        return Err(ApiError::Conflict(format!(
            "the session has {have} of the {need} frames that a prediction takes; send more frames"
        )));
    }
    let _place = app.admission.enter()?;
    let answer = request.answer_form(wanted);
    let context = PlanContext::new(state.rollout_task(Vec::new(), model.spec()));
    let (manifest, config) = (Arc::clone(&model.manifest), Arc::clone(&app.config));
    let decode = move || request.into_input(&state, settings.resize, &manifest, &config);
    let input = app.predictions.run(decode).await??;
    let search = Search {
        model,
        context,
        session: Some(session.key),
        begun,
    };
    let choice = search.run(&app, input).await?;
    let encode = move || answer.of(choice, &[], begun.elapsed());
    picture::threads_for(&app, wanted).run(encode).await?
}

/// A search on this server: plans are judged on a blocking thread, and predicted by the inference thread beside other requests.
struct Search {
    model: Arc<Model>,
    context: PlanContext,
    session: Option<u64>,
    begun: Instant,
}

/// The answer of a search, with the model that made it.
struct ChosenPlan {
    model: Arc<Model>,
    choice: PlanChoice,
}

impl Search {
    async fn run(self, app: &App, input: PlannerInput) -> Result<ChosenPlan, ApiError> {
        let (state, budget, begun) = (input.state.clone(), input.settings.budget, self.begun);
        let model = Arc::clone(&self.model);
        let mut planner = app.predictions.run(move || Planner::new(&model, input)).await??;
        let steps = planner.steps();
        let mut predicted: Option<(Prediction, Duration)> = None;
        loop {
            let next = move || -> Result<(Planner, Option<PlanBatch>), PlanError> {
                if let Some((prediction, took)) = predicted {
                    planner.record(prediction, took)?;
                }
                let batch = planner.next_batch(&|| begun.elapsed())?;
                Ok((planner, batch))
            };
            let batch;
            (planner, batch) = app.predictions.run(next).await??;
            let Some(batch) = batch else { break };
            let asked = Instant::now();
            let Some(prediction) = self.predict(app, batch, (state.clone(), steps), budget).await? else {
                break;
            };
            predicted = Some((prediction, asked.elapsed()));
        }
        let choice = app.predictions.run(move || planner.finish()).await?;
        self.count(&choice);
        Ok(ChosenPlan {
            model: self.model,
            choice,
        })
    }

    /// The prediction of a batch; `None` if the budget was over before it came.
    async fn predict(
        &self,
        app: &App,
        batch: PlanBatch,
        (state, steps): (Option<RobotState>, usize),
        budget: Option<Duration>,
    ) -> Result<Option<Prediction>, ApiError> {
        let inputs = ConditioningInput::of_plans(batch.plans, state, Some(steps), &self.model.manifest)?;
        let task = self.context.task(inputs, batch.sees_occupancy);
        let computed = app.predictor().compute(&self.model, task, self.session);
        let Some(budget) = budget else {
            return Ok(Some(computed.await?));
        };
        match tokio::time::timeout_at((self.begun + budget).into(), computed).await {
            Ok(prediction) => Ok(Some(prediction?)),
            Err(_) => Ok(None),
        }
    }

    fn count(&self, choice: &PlanChoice) {
        let model = self.model.manifest.name.to_string();
        let outcome = match choice.unsafe_reason {
            None => "safe",
            Some(_) => "stop",
        };
        counter!(metric_names::PLANS, "model" => model.clone(), "outcome" => outcome).increment(1);
        histogram!(metric_names::PLAN_SECONDS, "model" => model).record(self.begun.elapsed());
    }
}

impl From<PlanError> for ApiError {
    fn from(error: PlanError) -> Self {
        match error {
            PlanError::Prediction(error) => error.into(),
            _ => Self::of(&error),
        }
    }
}

impl bodies::PlanAnswerForm {
    /// The answer in the form that was asked for.
    fn of(
        self,
        found: ChosenPlan,
        seen: &[foreframe_core::frame::Frame],
        took: Duration,
    ) -> Result<Response, ApiError> {
        let ChosenPlan { model, choice } = found;
        let all = || std::iter::once(&choice.best).chain(&choice.runners_up);
        let frames = || -> Vec<&[foreframe_core::frame::Frame]> {
            all()
                .filter_map(|candidate| Some(candidate.rollout.as_ref()?.frames.as_slice()))
                .collect()
        };
        match self.wanted {
            ResponseFormat::Png => picture::png(picture::rollout_sheet(seen, &frames())),
            ResponseFormat::Gif => {
                let period_s = model.spec().frame_period_s;
                picture::gif(picture::rollout_animation(seen, &frames(), period_s))
            }
            ResponseFormat::Json | ResponseFormat::Msgpack => {
                let wanted = self.wanted;
                let body = PlanResponse::new(self, &model.manifest, choice, took)?;
                Ok(structured(wanted, &body))
            }
        }
    }
}
