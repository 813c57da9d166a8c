//! The data sets, and pictures of their episodes.

use std::path::PathBuf;
use std::sync::atomic::Ordering;

use axum::body::Bytes;
use axum::http::{StatusCode, header};
use axum::response::IntoResponse;
use serde::Serialize;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::picture;
use crate::server::http::extract::{Path, Query};
use crate::server::http::page::Page;
use crate::server::http::problem::ApiError;
use crate::server::state::App;
use foreframe_core::files::sha256_hex;
use foreframe_core::frame::warp::CameraModel;
use foreframe_core::frame::{Frame, FrameError, codec};
use foreframe_core::types::{Channel, DatasetName};
use foreframe_data::dataset::{Dataset, DatasetError, DatasetInfo};
use foreframe_jobs::jobs::{JobError, datasets};
use foreframe_jobs::store::Author;
use foreframe_train::evaluation::figures::animation::enlarged_gif;
use foreframe_train::evaluation::figures::montage::{MontageRow, Style, montage};

pub(in crate::server) fn routes() -> OpenApiRouter<App> {
    OpenApiRouter::new()
        .routes(routes!(list))
        .routes(routes!(get))
        .routes(routes!(delete))
        .routes(routes!(sheet))
        .routes(routes!(animation))
}

/// The maximum number of frames of an animation.
const MAX_ANIMATED: usize = 300;
/// The maximum number of frames of a contact sheet, and of one of its rows.
const MAX_SHOWN: usize = 32;
const ROW_FRAMES: usize = 8;

/// A page of data sets.
#[derive(Debug, Serialize, utoipa::ToSchema)]
struct DatasetList {
    /// In the order of their names.
    datasets: Vec<DatasetDescription>,
    /// The value of `after` for the next page; absent on the last page.
    #[serde(skip_serializing_if = "Option::is_none")]
    next: Option<String>,
}

/// A data set.
#[derive(Debug, Serialize, utoipa::ToSchema)]
struct DatasetDescription {
    /// Its name on this server.
    name: String,
    /// The name in its own description.
    title: String,
    /// Number of episodes.
    episodes: usize,
    /// Number of frames in all episodes.
    frames: usize,
    /// Width of every frame in pixels.
    frame_width_px: u32,
    /// Height of every frame in pixels.
    frame_height_px: u32,
    /// Seconds from one frame to the next.
    frame_period_s: f64,
    /// Components of an action.
    actions: Vec<Channel>,
    /// Components of a state.
    states: Vec<Channel>,
    /// Hash of its content.
    content_hash: String,
    /// The scenario of the simulation, if it was simulated.
    scenario: Option<String>,
    /// The seed of the simulation, if it was simulated.
    seed: Option<u64>,
    /// How the camera projects; absent where that is not known.
    #[serde(skip_serializing_if = "Option::is_none")]
    camera: Option<CameraModel>,
    /// Whether it has masks that tell what is seen at each pixel.
    has_masks: bool,
}

/// Lists the finished data sets.
#[utoipa::path(
    get, path = "/v1/datasets", params(Page),
    responses((status = 200, body = DatasetList), (status = 422, description = "A limit out of range"))
)]
async fn list(app: App, Query(page): Query<Page>) -> Result<axum::Json<DatasetList>, ApiError> {
    let _turn = app.render_cache.turn().await;
    let names = datasets::names(app.store().objects()).await?;
    let (names, next) = page.of(names, DatasetName::as_str)?;
    let mut datasets = Vec::new();
    for name in names {
        match describe(&app, &name).await {
            Ok(dataset) => datasets.push(dataset),
            // A list without them would be taken for the whole one.
            Err(error @ ApiError::Unavailable { .. }) => return Err(error),
            // A damaged data set, or one that is being deleted, must not hide the others.
            Err(_) => {}
        }
    }
    Ok(axum::Json(DatasetList { datasets, next }))
}

/// Describes a data set.
#[utoipa::path(get, path = "/v1/datasets/{dataset}", responses((status = 200, body = DatasetDescription)))]
async fn get(app: App, Path(name): Path<String>) -> Result<axum::Json<DatasetDescription>, ApiError> {
    let name = dataset_name(&app, &name).await?;
    describe(&app, &name).await.map(axum::Json)
}

/// Deletes a data set that no job uses; also an unfinished one of a collection that was cancelled or failed.
#[utoipa::path(
    delete, path = "/v1/datasets/{dataset}",
    responses(
        (status = 204, description = "Deleted"),
        (status = 409, description = "A job that has not ended uses it"),
    )
)]
async fn delete(app: App, author: Author, Path(name): Path<String>) -> Result<StatusCode, ApiError> {
    let name = dataset_name(&app, &name).await?;
    let _held = app.jobs().hold_submissions().await;
    let open = app.jobs().open().await?;
    if let Some(job) = open.into_iter().find(|job| job.spec.datasets().contains(&&name)) {
        return Err(JobError::InUse { name, job: job.id }.into());
    }
    datasets::delete(app.store(), &name, &author).await.map_err(absent)?;
    app.deleted_datasets.fetch_add(1, Ordering::Relaxed);
    Ok(StatusCode::NO_CONTENT)
}

/// A contact sheet of an episode.
#[utoipa::path(
    get, path = "/v1/datasets/{dataset}/episodes/{episode}/preview.png",
    responses(
        (status = 200, description = "The picture", body = Vec<u8>, content_type = "image/png"),
        (status = 404, description = "No such data set or episode"),
    )
)]
async fn sheet(app: App, Path((name, episode)): Path<(String, usize)>) -> Result<impl IntoResponse, ApiError> {
    let name = dataset_name(&app, &name).await?;
    let title = format!("{name}, episode {episode}");
    let draw = move |frames, _| contact_sheet(&title, frames);
    let png = episode_picture(&app, &name, episode, "png", draw).await?;
    Ok(([(header::CONTENT_TYPE, "image/png")], png))
}

/// An episode in motion.
#[utoipa::path(
    get, path = "/v1/datasets/{dataset}/episodes/{episode}/preview.gif",
    responses(
        (status = 200, description = "The animation", body = Vec<u8>, content_type = "image/gif"),
        (status = 404, description = "No such data set or episode"),
    )
)]
async fn animation(app: App, Path((name, episode)): Path<(String, usize)>) -> Result<impl IntoResponse, ApiError> {
    let name = dataset_name(&app, &name).await?;
    let gif = episode_picture(&app, &name, episode, "gif", |mut frames, period_s| {
        frames.truncate(MAX_ANIMATED);
        enlarged_gif(&frames, period_s)
    });
    Ok(([(header::CONTENT_TYPE, "image/gif")], gif.await?))
}

/// The name in the path. Errors: 404 if it is no valid name.
pub(super) async fn dataset_name(app: &App, text: &str) -> Result<DatasetName, ApiError> {
    datasets::named(app.store().objects(), text).await.map_err(absent)
}

async fn describe(app: &App, name: &DatasetName) -> Result<DatasetDescription, ApiError> {
    let info = datasets::describe(app.store().objects(), name).await.map_err(absent)?;
    Ok(DatasetDescription {
        name: name.to_string(),
        title: info.name,
        episodes: info.episode_count,
        frames: info.frame_count,
        frame_width_px: info.frame_width_px,
        frame_height_px: info.frame_height_px,
        frame_period_s: info.frame_period_s,
        actions: info.action_channels,
        states: info.state_channels,
        content_hash: info.content_hash,
        scenario: info.scenario,
        seed: info.seed.map(|seed| seed.0),
        camera: info.camera,
        has_masks: info.has_masks,
    })
}

/// A picture of an episode's frames, given them and the seconds from one to the next.
async fn episode_picture(
    app: &App,
    name: &DatasetName,
    episode: usize,
    kind: &str,
    draw: impl FnOnce(Vec<Frame>, f64) -> Result<Vec<u8>, FrameError> + Send + 'static,
) -> Result<Bytes, ApiError> {
    let make = move |info: DatasetInfo, dir: PathBuf| {
        let frames = Dataset::episode_frames(&dir, episode)?;
        draw(frames, info.frame_period_s).map_err(picture::not_drawn)
    };
    kept(app, name, &format!("{episode}.{kind}"), make).await
}

/// What `make` makes of a data set, given its description and its local directory: from the cache, where it is kept as long
/// as the data set has the same content and description, or made now.
pub(super) async fn kept(
    app: &App,
    name: &DatasetName,
    part: &str,
    make: impl FnOnce(DatasetInfo, PathBuf) -> Result<Vec<u8>, ApiError> + Send + 'static,
) -> Result<Bytes, ApiError> {
    let objects = app.store().objects();
    let info = datasets::describe(objects, name).await.map_err(absent)?;
    // The content hash leaves out camera, channels and frame period.
    let described = sha256_hex(info.description().as_bytes());
    let key = format!("dataset/{name}/{}/{described}/{part}", info.content_hash);
    if let Some(bytes) = app.render_cache.cached(&key) {
        return Ok(bytes);
    }
    let dir = datasets::fetch(objects, name).await.map_err(absent)?;
    app.render_cache.get_or_make(key, move || make(info, dir)).await
}

/// Frames spread evenly over an episode, in rows, each with its number.
fn contact_sheet(title: &str, frames: Vec<Frame>) -> Result<Vec<u8>, FrameError> {
    let stride = frames.len().div_ceil(MAX_SHOWN).max(1);
    let style = Style::for_frames_of(frames.first().map_or(1, Frame::width));
    let shown: Vec<(String, Frame)> = frames
        .into_iter()
        .enumerate()
        .step_by(stride)
        .map(|(number, frame)| (number.to_string(), frame))
        .collect();
    let rows: Vec<MontageRow> = shown.chunks(ROW_FRAMES).map(picture::unlabelled).collect();
    montage(title, &rows, &style).and_then(|sheet| codec::encode_png(&sheet))
}

/// The data set is in the path, so that it does not exist is 404, not 422.
fn absent(error: JobError) -> ApiError {
    match error {
        JobError::NotFound { .. } => ApiError::NotFound(error.to_string()),
        other => other.into(),
    }
}

impl From<DatasetError> for ApiError {
    fn from(error: DatasetError) -> Self {
        match error {
            DatasetError::NoEpisode { .. } => Self::of(&error),
            _ => Self::of_own_data(&error),
        }
    }
}
