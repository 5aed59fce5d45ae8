//! `/api/v1/bases`: what images are built upon, and moving it to another server.

use std::io;
use std::sync::Arc;

use api::bases::{BASE_ARCHIVE, BaseDetail, BaseSummary};
use axum::body::Body;
use axum::extract::{Path, State};
use axum::http::header;
use axum::response::{IntoResponse, Response};
use axum::{Extension, Json};
use futures_util::{StreamExt, TryStreamExt};

use crate::app::App;
use crate::body::file_body;
use crate::caller::Caller;
use crate::errors::Error;
use crate::json::JsonResult;

/// Returns all bases.
pub async fn bases(State(app): State<Arc<App>>) -> JsonResult<Vec<BaseSummary>> {
    Ok(Json(app.pusher.bases().await?))
}

/// Returns a base with its contents.
pub async fn base(State(app): State<Arc<App>>, Path(name): Path<String>) -> JsonResult<BaseDetail> {
    Ok(Json(app.pusher.base(&name).await?))
}

/// Returns a base as an archive, for another server.
pub async fn export(
    State(app): State<Arc<App>>,
    Extension(caller): Extension<Caller>,
    Path(name): Path<String>,
) -> Result<Response, Error> {
    let (file, bytes) = app.pusher.export_base(&name).await?;
    let headers = [
        (header::CONTENT_TYPE, BASE_ARCHIVE.to_owned()),
        (header::CONTENT_LENGTH, bytes.to_string()),
        (header::CONTENT_DISPOSITION, format!("attachment; filename=\"{name}.oci.tar\"")),
    ];
    // The download is cut off when the caller's credential becomes invalid.
    Ok((headers, file_body(file, caller.wait_for_end(&app, ""))).into_response())
}

/// Removes an imported base.
pub async fn remove(State(app): State<Arc<App>>, Path(name): Path<String>) -> JsonResult<BaseDetail> {
    Ok(Json(app.pusher.forget_base(&name).await?))
}

/// Imports an archive of another server.
pub async fn import(State(app): State<Arc<App>>, body: Body) -> JsonResult<BaseDetail> {
    let archive = body.into_data_stream().map_err(io::Error::other).boxed();
    Ok(Json(app.pusher.import_base(archive).await?))
}
