//! What is in a data set: the frames of an episode with their actions and states, and the page of its inspection.

use std::path::PathBuf;

use axum::http::header;
use axum::response::IntoResponse;
use serde::{Deserialize, Serialize};
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::datasets::{dataset_name, kept};
use super::picture;
use crate::server::http::extract::{Path, Query};
use crate::server::http::problem::ApiError;
use crate::server::images::{self, ImageBytes, ImageFormat};
use crate::server::state::App;
use foreframe_core::frame::Frame;
use foreframe_core::frame::warp::CameraModel;
use foreframe_data::dataset::{Dataset, DatasetInfo, EpisodeData};
use foreframe_data::inspection;

pub(in crate::server) fn routes() -> OpenApiRouter<App> {
    OpenApiRouter::new()
        .routes(routes!(episode))
        .routes(routes!(inspection_page))
}

/// The maximum number of frames of an answer.
const MAX_FRAMES: usize = 300;

/// The page's only styles are in it, and its pictures too. It runs no scripts.
const INSPECTION_POLICY: &str = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; frame-ancestors 'self'";

/// Which frames of an episode.
#[derive(Debug, Deserialize, utoipa::IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
struct FrameQuery {
    /// The first frame, counted from 0.
    #[serde(default)]
    #[param(maximum = 4_294_967_295_u32)]
    from: u32,
    /// The maximum number of frames, 1 to 300. Default: 300.
    #[param(minimum = 1, maximum = 300)]
    limit: Option<usize>,
}

/// Frames of an episode, one after another.
#[derive(Debug, Serialize, utoipa::ToSchema)]
struct EpisodeFrames {
    /// Number of frames of the whole episode.
    frame_count: usize,
    /// The first of these frames.
    from: usize,
    /// The frames: PNG, base64.
    frames: Vec<ImageBytes>,
    /// Seconds since the start of the episode.
    times_s: Vec<f64>,
    /// The action from each frame to the next, in the order and units of the data set's `actions`.
    actions: Vec<Vec<f32>>,
    /// The state at each frame, in the order and units of the data set's `states`.
    states: Vec<Vec<f32>>,
    /// The camera, if it is known.
    #[serde(skip_serializing_if = "Option::is_none")]
    camera: Option<CameraModel>,
}

/// Frames of an episode with their times, actions and states.
#[utoipa::path(
    get, path = "/v1/datasets/{dataset}/episodes/{episode}",
    params(("dataset" = String, Path), ("episode" = usize, Path), FrameQuery),
    responses(
        (status = 200, description = "The frames", body = EpisodeFrames),
        (status = 404, description = "No such data set or episode"),
        (status = 422, description = "A limit out of range"),
    )
)]
async fn episode(
    app: App,
    Path((name, episode)): Path<(String, usize)>,
    Query(query): Query<FrameQuery>,
) -> Result<impl IntoResponse, ApiError> {
    let limit = query.limit.unwrap_or(MAX_FRAMES);
    if !(1..=MAX_FRAMES).contains(&limit) {
        let detail = format!("limit is {limit}; it must be 1 to {MAX_FRAMES}");
        return Err(ApiError::Unprocessable(detail));
    }
    let name = dataset_name(&app, &name).await?;
    let from = query.from as usize;
    let read = move |_: DatasetInfo, dir: PathBuf| {
        let (info, data) = Dataset::read_episode(&dir, episode)?;
        let frames = EpisodeFrames::of(&info, &data, from, limit)?;
        Ok::<_, ApiError>(serde_json::to_vec(&frames).expect("a list of frames that is not JSON is a bug"))
    };
    let json = kept(&app, &name, &format!("{episode}.{from}+{limit}"), read).await?;
    Ok(([(header::CONTENT_TYPE, "application/json")], json))
}

impl EpisodeFrames {
    fn of(info: &DatasetInfo, data: &EpisodeData, from: usize, limit: usize) -> Result<Self, ApiError> {
        let rows = |values: &[f32], each: usize| -> Vec<Vec<f32>> {
            let rows = values.chunks_exact(each.max(1)).map(<[f32]>::to_vec);
            rows.skip(from).take(limit).collect()
        };
        let frames = data.pixels.chunks_exact(info.frame_pixels()).skip(from).take(limit);
        let png = |pixels: &[u8]| {
            let frame = Frame::new(info.frame_width_px, info.frame_height_px, pixels.to_vec());
            let frame = frame.map_err(picture::not_drawn)?;
            Ok(images::encode_one(&frame, ImageFormat::Png)?)
        };
        Ok(Self {
            frame_count: data.timestamps_s.len(),
            from,
            frames: frames.map(png).collect::<Result<_, ApiError>>()?,
            times_s: data.timestamps_s.iter().skip(from).take(limit).copied().collect(),
            actions: rows(&data.actions, info.action_channels.len()),
            states: rows(&data.states, info.state_channels.len()),
            camera: info.camera_of(data.trial.as_ref()),
        })
    }
}

/// The page of `foreframe inspect --html`: ranges, rates, brightness, delays, and what is wrong.
#[utoipa::path(
    get, path = "/v1/datasets/{dataset}/inspection",
    responses(
        (status = 200, description = "A page", content_type = "text/html"),
        (status = 404, description = "No such data set"),
    )
)]
async fn inspection_page(app: App, Path(name): Path<String>) -> Result<impl IntoResponse, ApiError> {
    let name = dataset_name(&app, &name).await?;
    let memory_mib = app.config().dataset_memory_mib;
    let draw = move |_: DatasetInfo, dir: PathBuf| {
        let dataset = Dataset::open_within(&dir, memory_mib)?;
        let page = inspection::page(&inspection::inspect(&dataset)?, &dataset)?;
        Ok::<_, ApiError>(page.into_bytes())
    };
    let page = kept(&app, &name, "inspection", draw).await?;
    let headers = [
        (header::CONTENT_TYPE, "text/html; charset=utf-8"),
        (header::CONTENT_SECURITY_POLICY, INSPECTION_POLICY),
    ];
    Ok((headers, page))
}
