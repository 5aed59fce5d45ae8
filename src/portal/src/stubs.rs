//! `/stubs`: what robots install in place of a package.

use std::sync::Arc;

use api::Stubs;
use api::stub::ARCHITECTURE;
use axum::body::Body;
use axum::extract::{OriginalUri, Path, Query, State};
use axum::http::{HeaderMap, header};
use axum::response::{IntoResponse, Response};
use axum::{Extension, Json};
use catalogue::stubs::{self, Programs};
use serde::Deserialize;
use tokio_util::io::ReaderStream;

use super::guard::{Caller, Peer};
use crate::app::App;
use crate::errors::Error;

/// Read from the archive at a time.
const CHUNK: usize = 64 << 10;

/// `/stubs`: services, and for which architectures.
pub async fn list(
    State(app): State<Arc<App>>,
    Extension(caller): Extension<Caller>,
) -> Result<Json<Stubs>, Error> {
    let mut services = app.state.service_names()?;
    services.retain(|name| caller.sees(&app, name));
    let programs = Programs::look();
    Ok(Json(Stubs {
        services,
        architectures: programs.held(),
        lacking: programs.lacking(),
    }))
}

/// For which robot.
#[derive(Debug, Deserialize)]
pub struct For {
    /// Its architecture; this machine's by default.
    arch: Option<String>,
}

/// `/stubs/NAME.tar.gz`.
pub async fn archive(
    State(app): State<Arc<App>>,
    Path(file): Path<String>,
    Query(asked): Query<For>,
    OriginalUri(uri): OriginalUri,
    Extension(caller): Extension<Caller>,
    headers: HeaderMap,
) -> Result<Response, Error> {
    let Some(name) = file.strip_suffix(".tar.gz") else {
        return Err(Error::UnknownPath {
            path: format!("{}; a stub is at /stubs/NAME.tar.gz", uri.path()),
        });
    };
    let revision = app.catalogue.current(name)?;
    let program = Programs::look().of(asked.arch.as_deref())?;
    let server = server(&app, &caller, &headers);
    let inventory = app.catalogue.known(&revision).await?.inventory;
    let store = Arc::clone(app.catalogue.images());
    let architecture = program.architecture;
    let packing = move || stubs::archive(&store, &revision, &inventory, &program, &server);
    let file = tokio::task::spawn_blocking(packing)
        .await
        .map_err(|_| Error::Internal("packing a stub"))??;
    let headers = [
        (header::CONTENT_TYPE, "application/gzip".to_owned()),
        (
            header::CONTENT_DISPOSITION,
            format!("attachment; filename=\"{name}.tar.gz\""),
        ),
        (
            header::HeaderName::from_static(ARCHITECTURE),
            architecture.to_owned(),
        ),
    ];
    let stream = ReaderStream::with_capacity(tokio::fs::File::from_std(file), CHUNK);
    Ok((headers, Body::from_stream(stream)).into_response())
}

/// Where the robot reaches this portal: as whoever asks for the stub reached it.
fn server(app: &App, caller: &Caller, headers: &HeaderMap) -> String {
    let host = headers
        .get(header::HOST)
        .and_then(|host| host.to_str().ok())
        .filter(|host| stubs::is_authority(host));
    match (caller.peer, host) {
        (Peer::Tcp(_), Some(host)) => format!("{}://{host}", scheme(headers)),
        _ => {
            let address = app.address("");
            address.trim_end_matches('/').to_owned()
        }
    }
}

/// A proxy in front of the portal speaks TLS in its place, and says so.
fn scheme(headers: &HeaderMap) -> &'static str {
    let forwarded = headers.get("x-forwarded-proto");
    match forwarded.and_then(|protocol| protocol.to_str().ok()) {
        Some("https" | "wss") => "wss",
        _ => "ws",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stub_fetched_through_tls_is_linked_through_tls() {
        let mut headers = HeaderMap::new();
        assert_eq!(scheme(&headers), "ws");
        headers.insert(
            "x-forwarded-proto",
            header::HeaderValue::from_static("https"),
        );
        assert_eq!(scheme(&headers), "wss");
    }
}
