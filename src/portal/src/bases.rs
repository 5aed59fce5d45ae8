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
use push::NewBase;
use serde::Deserialize;
use utoipa::IntoParams;

use crate::app::App;
use crate::audit::AuditObject;
use crate::body::file_body;
use crate::caller::Caller;
use crate::errors::Error;
use crate::json::JsonResult;
use crate::query::Query;

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
    Extension(about): Extension<AuditObject>,
    Path(name): Path<String>,
) -> Result<Response, Error> {
    about.set(format!("base {name}"));
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
pub async fn remove(
    State(app): State<Arc<App>>,
    Extension(about): Extension<AuditObject>,
    Path(name): Path<String>,
) -> JsonResult<BaseDetail> {
    about.set(format!("base {name}"));
    Ok(Json(app.pusher.forget_base(&name).await?))
}

/// Query: how a base is made.
#[derive(Debug, Default, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
pub struct NewBaseQuery {
    /// True to replace an imported base of this name.
    #[serde(default)]
    replace: bool,
    /// ROS distribution that counts, if there are several, or if nothing says which it is.
    ros_distro: Option<String>,
}

/// Makes a base from an image or a root file system.
pub async fn make(
    State(app): State<Arc<App>>,
    Extension(about): Extension<AuditObject>,
    Path(name): Path<String>,
    Query(asked): Query<NewBaseQuery>,
    body: Body,
) -> JsonResult<BaseDetail> {
    about.set(format!("base {name}"));
    let archive = body.into_data_stream().map_err(io::Error::other).boxed();
    let NewBaseQuery { replace, ros_distro: ros_distribution } = asked;
    Ok(Json(app.pusher.import_image(archive, NewBase { name, replace, ros_distribution }).await?))
}

/// Imports an archive of another server.
pub async fn import(
    State(app): State<Arc<App>>,
    Extension(about): Extension<AuditObject>,
    body: Body,
) -> JsonResult<BaseDetail> {
    let archive = body.into_data_stream().map_err(io::Error::other).boxed();
    let base = app.pusher.import_base(archive).await?;
    about.set(format!("base {}", base.summary.name));
    Ok(Json(base))
}
