//! Plans: what the robot should do to reach a goal, chosen by what is expected to happen.

mod bodies;

use std::sync::Arc;
use std::time::{Duration, Instant};

use axum::response::Response;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use self::bodies::PlanRequest;
use super::picture;
use super::sessions::AuthorizedSession;
use crate::server::http::extract::{Path, ResponseFormat};
use crate::server::http::multipart::BodyOrForm;
use crate::server::http::problem::ApiError;
use crate::server::http::structured::{JsonOrMsgpack, structured};
use crate::server::plans::request::SessionPlanRequest;
use crate::server::plans::response::{PlanForm, PlanResponse};
use crate::server::plans::search::{ChosenPlan, PlanTask};
use crate::server::state::App;
use foreframe_core::frame::Frame;

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
    let answer = PlanAnswerForm {
        wanted,
        body: request.form(),
    };
    let decode = move || request.into_search(wanted, &manifest, &config);
    let (seen, context, input) = app.predictions.run(decode).await??;
    let search = PlanTask {
        model,
        context,
        session: None,
        begun,
    };
    let choice = search.run(app.predictor(), &app.predictions, input).await?;
    let encode = move || answer.of(choice, &seen, begun.elapsed());
    picture::threads_for(&app, wanted).run(encode).await?
}

/// Searches for the plan that reaches a goal best, from the session's last frame. The plan of that frame is always one of the plans tried. The
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
    let answer = PlanAnswerForm {
        wanted,
        body: request.form(),
    };
    let context = state.rollout_task(Vec::new(), model.spec());
    let (manifest, config) = (Arc::clone(&model.manifest), Arc::clone(&app.config));
    let decode = move || request.into_input(&state, settings.resize, &manifest, &config);
    let input = app.predictions.run(decode).await??;
    let search = PlanTask {
        model,
        context,
        session: Some(session.key),
        begun,
    };
    let choice = search.run(app.predictor(), &app.predictions, input).await?;
    let encode = move || answer.of(choice, &[], begun.elapsed());
    picture::threads_for(&app, wanted).run(encode).await?
}

/// How an answer is given.
struct PlanAnswerForm {
    wanted: ResponseFormat,
    body: PlanForm,
}

impl PlanAnswerForm {
    /// The answer in the form that was asked for.
    fn of(self, found: ChosenPlan, seen: &[Frame], took: Duration) -> Result<Response, ApiError> {
        let ChosenPlan { model, choice } = found;
        let all = || std::iter::once(&choice.best).chain(&choice.runners_up);
        let frames = || -> Vec<&[Frame]> {
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
                let body = PlanResponse::new(self.body, &model.manifest, choice, took)?;
                Ok(structured(wanted, &body))
            }
        }
    }
}
