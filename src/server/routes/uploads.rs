//! Files for imports.

use axum::body::Body;
use axum::http::{HeaderMap, StatusCode, header};
use serde::{Deserialize, Serialize};
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use crate::server::http::extract::{Path, Query};
use crate::server::http::keys::Caller;
use crate::server::http::problem::{ApiError, unfit};
use crate::server::state::App;
use crate::server::token::Token;
use foreframe_jobs::jobs::JobError;
use foreframe_jobs::jobs::uploads::UploadedFile;

pub(in crate::server) fn routes() -> OpenApiRouter<App> {
    OpenApiRouter::new().routes(routes!(create)).routes(routes!(delete))
}

/// The name of the file.
#[derive(Debug, Deserialize, utoipa::IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
struct UploadQuery {
    /// Its name, which tells what it is: an archive, a bag, an array or a video.
    #[param(
        pattern = "^[A-Za-z0-9][A-Za-z0-9._ ()+-]{0,110}\\.(zip|tar|tar\\.gz|tgz|mcap|db3|npy|npz|mp4|mkv|avi|mov|webm)$"
    )]
    name: String,
}

/// The bytes of a file.
#[derive(utoipa::ToSchema)]
#[schema(value_type = String, format = Binary)]
#[expect(dead_code, reason = "only described; the handler reads the body piece by piece")]
struct UploadedBytes(Vec<u8>);

/// An uploaded file.
#[derive(Debug, Serialize, utoipa::ToSchema)]
struct Upload {
    /// Its id, to delete it.
    id: String,
    /// The `source` of an import job.
    source: String,
    /// Its size in bytes.
    bytes: u64,
}

/// Uploads a recording for an import job: an archive (.zip, .tar, .tar.gz) of a folder, or a single file. The body is the file. It
/// is deleted when its import has succeeded, otherwise after `upload_idle_ms`.
#[utoipa::path(
    post, path = "/v1/uploads", params(UploadQuery),
    request_body(content = UploadedBytes, content_type = "application/octet-stream", description = "The file"),
    responses(
        (status = 201, description = "Received", body = Upload),
        (status = 413, description = "The file exceeds `max_upload_mib`"),
        (status = 415, description = "A form instead of the file"),
        (status = 422, description = "A name of no kind that can be imported, or an empty file"),
        (status = 503, description = "Too many uploads wait for their imports"),
    )
)]
async fn create(
    app: App,
    caller: Caller,
    Query(query): Query<UploadQuery>,
    headers: HeaderMap,
    body: Body,
) -> Result<(StatusCode, axum::Json<Upload>), ApiError> {
    let id = Token::random()?.id();
    let file = UploadedFile::new(id.clone(), &query.name).map_err(unfit("name"))?;
    let stated = headers
        .get(header::CONTENT_LENGTH)
        .and_then(|length| length.to_str().ok()?.parse().ok());
    app.uploads.check_length(stated)?;
    let is_form = |kind: &axum::http::HeaderValue| kind.as_bytes().starts_with(b"multipart/");
    if headers.get(header::CONTENT_TYPE).is_some_and(is_form) {
        let right = "the body is the file itself, without a form; send it with curl --data-binary @FILE";
        return Err(ApiError::UnsupportedMedia(right.to_owned()));
    }
    let bytes = app.uploads.receive(&file, caller, body, &app.blocking).await?;
    file.push(app.store().objects()).await.map_err(JobError::Store)?;
    let source = file.to_string();
    Ok((StatusCode::CREATED, axum::Json(Upload { id, source, bytes })))
}

/// Deletes an uploaded file that no import needs any more.
#[utoipa::path(
    delete, path = "/v1/uploads/{id}",
    responses(
        (status = 204, description = "Deleted"),
        (status = 409, description = "An import that has not ended uses it"),
    )
)]
async fn delete(app: App, Path(id): Path<String>) -> Result<StatusCode, ApiError> {
    app.uploads.delete(&id, app.jobs(), app.store().objects()).await?;
    Ok(StatusCode::NO_CONTENT)
}
