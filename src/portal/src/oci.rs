//! `/v2/`: container images, served read-only according to the OCI distribution specification (1.1).

use std::sync::Arc;

use axum::extract::{OriginalUri, Path, State};
use axum::http::{HeaderName, Method, StatusCode, Uri, header};
use axum::response::{IntoResponse, Response};
use axum::{Extension, Json};
use serde_json::json;

use crate::app::App;
use crate::body::file_body;
use crate::caller::Caller;
use crate::errors::Error;
use crate::registry_clients::error_response;

const API_VERSION: HeaderName = HeaderName::from_static("docker-distribution-api-version");
const CONTENT_DIGEST: HeaderName = HeaderName::from_static("docker-content-digest");

/// `/v2/`: confirms that this is a registry.
pub async fn version() -> Response {
    ([(API_VERSION, "registry/2.0")], Json(json!({}))).into_response()
}

/// `/v2/_catalog`.
pub async fn catalog(State(app): State<Arc<App>>, Extension(caller): Extension<Caller>) -> Result<Response, Error> {
    let mut names = app.state.service_names()?;
    names.retain(|name| caller.can_see(&app, name));
    Ok(Json(json!({ "repositories": names })).into_response())
}

/// `/v2/NAME/tags/list`.
pub async fn tags(State(app): State<Arc<App>>, Path(name): Path<String>) -> Result<Response, Error> {
    let revisions = app.state.revisions(&name)?;
    if revisions.is_empty() {
        return Ok(not_found("NAME_UNKNOWN", &format!("there is no repository {name}")));
    }
    let tags: Vec<String> =
        revisions.iter().rev().map(|revision| revision.number.to_string()).chain(["latest".to_owned()]).collect();
    Ok(Json(json!({ "name": name, "tags": tags })).into_response())
}

/// `/v2/NAME/manifests/REFERENCE`: `latest`, a revision's number, or a digest.
pub async fn manifest(
    State(app): State<Arc<App>>,
    Path((name, reference)): Path<(String, String)>,
) -> Result<Response, Error> {
    let revisions = app.state.revisions(&name)?;
    let current = app.state.current_revision(&name)?;
    let image = match reference.as_str() {
        "latest" => current.map(|revision| revision.image.clone()),
        _ => revisions
            .into_iter()
            .find(|revision| revision.number.to_string() == reference || revision.image == reference)
            .map(|revision| revision.image),
    };
    let Some(image) = image else {
        return Ok(not_found("MANIFEST_UNKNOWN", &format!("there is no image {name}:{reference}")));
    };
    let store = Arc::clone(app.catalogue.images());
    let found = privilege::spawn_blocking(move || store.manifest(&image))
        .await
        .map_err(|_| Error::Internal("reading a manifest"))??;
    let Some(manifest) = found else {
        return Ok(not_found("MANIFEST_UNKNOWN", &format!("the image {name}:{reference} is gone")));
    };
    let headers = [(header::CONTENT_TYPE, manifest.media_type), (CONTENT_DIGEST, manifest.digest.to_string())];
    Ok((headers, manifest.bytes).into_response())
}

/// `/v2/NAME/blobs/DIGEST`.
pub async fn blob(
    State(app): State<Arc<App>>,
    Path((name, digest)): Path<(String, String)>,
    Extension(caller): Extension<Caller>,
) -> Result<Response, Error> {
    let Ok(parsed) = digest.parse::<image::Digest>() else {
        return Ok(error_response(StatusCode::BAD_REQUEST, "DIGEST_INVALID", &format!("{digest} is not a digest")));
    };
    // Blobs are shared by all services. A caller that does not see every service gets only those of this one.
    let images: Option<Vec<image::Digest>> = if caller.who.principal.sees_all() {
        None
    } else {
        let revisions = app.state.revisions(&name)?.into_iter();
        Some(revisions.filter_map(|revision| revision.image.parse().ok()).collect())
    };
    let store = Arc::clone(app.catalogue.images());
    let found = privilege::spawn_blocking(move || {
        for image in images.iter().flatten() {
            if store.has_blob(image, &parsed)? {
                return store.blob(&parsed);
            }
        }
        if images.is_some() {
            return Ok(None);
        }
        store.blob(&parsed)
    })
    .await
    .map_err(|_| Error::Internal("reading a blob"))??;
    let Some(blob) = found else {
        return Ok(not_found("BLOB_UNKNOWN", &format!("there is no blob {digest}")));
    };
    let body = file_body(blob.file, caller.wait_for_end(&app, &name));
    let headers = [
        (header::CONTENT_TYPE, "application/octet-stream".to_owned()),
        (header::CONTENT_LENGTH, blob.size.to_string()),
        (CONTENT_DIGEST, digest),
    ];
    Ok((headers, body).into_response())
}

/// Any other path; pushing through this interface is not supported.
pub async fn refuse_unsupported(OriginalUri(uri): OriginalUri) -> Response {
    error_response(
        StatusCode::NOT_FOUND,
        "UNSUPPORTED",
        &format!("{} is not served; images are read-only here", uri.path()),
    )
}

/// A supported path with an unsupported method.
pub fn other_method(method: &Method, uri: &Uri) -> Response {
    error_response(
        StatusCode::METHOD_NOT_ALLOWED,
        "UNSUPPORTED",
        &format!("{method} is not supported at {}; images are read-only here", uri.path()),
    )
}

fn not_found(code: &str, message: &str) -> Response {
    error_response(StatusCode::NOT_FOUND, code, message)
}
