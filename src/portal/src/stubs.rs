//! `/stubs`: what robots install in place of a package.

use std::sync::Arc;

use api::Stubs;
use api::stub::{ARCHITECTURE, SIGNATURE};
use axum::body::Body;
use axum::extract::{OriginalUri, Path, State};
use axum::http::{HeaderMap, header};
use axum::response::{IntoResponse, Response};
use axum::{Extension, Json};
use catalogue::stubs::{self, Programs};
use package::stub::Portal;
use serde::Deserialize;
use tokio::sync::Semaphore;
use tokio_util::io::ReaderStream;

use super::guard::{Caller, Peer};
use crate::app::App;
use crate::errors::Error;
use crate::query::Query;

/// Read from the archive at a time.
const CHUNK: usize = 64 << 10;
/// Archives that are packed at the same time: each holds its files in memory meanwhile, and takes a core.
static PACKING: Semaphore = Semaphore::const_new(2);

/// `/stubs`: services, and for which architectures.
pub async fn list(
    State(app): State<Arc<App>>,
    Extension(caller): Extension<Caller>,
) -> Result<Json<Stubs>, Error> {
    let mut services = app.state.service_names()?;
    services.retain(|name| caller.sees(&app, name));
    let programs = privilege::now(Programs::look);
    Ok(Json(Stubs {
        services,
        architectures: programs.held(),
        lacking: programs.lacking(),
        key: app.signing.public().to_string(),
    }))
}

/// For which robot.
#[derive(Debug, Deserialize)]
pub struct For {
    /// Its architecture; this machine's by default.
    arch: Option<String>,
}

/// The service of `NAME.tar.gz` and `NAME.tar.gz.sig`, and whether it is the latter.
pub fn service(file: &str) -> Option<(&str, bool)> {
    let signature = file.strip_suffix(".sig");
    let name = signature.unwrap_or(file).strip_suffix(".tar.gz")?;
    Some((name, signature.is_some()))
}

/// `/stubs/NAME.tar.gz`, and `/stubs/NAME.tar.gz.sig`: asked alike, they belong together as long as the service has
/// the same revision.
pub async fn archive(
    State(app): State<Arc<App>>,
    Path(file): Path<String>,
    Query(asked): Query<For>,
    OriginalUri(uri): OriginalUri,
    Extension(caller): Extension<Caller>,
    headers: HeaderMap,
) -> Result<Response, Error> {
    let Some((name, is_signature)) = service(&file) else {
        return Err(Error::UnknownPath {
            path: format!(
                "{}; a stub is at /stubs/NAME.tar.gz, its signature at /stubs/NAME.tar.gz.sig",
                uri.path()
            ),
        });
    };
    let revision = app.catalogue.current(name)?;
    let program = privilege::now(Programs::look).of(asked.arch.as_deref())?;
    let portal = portal(&app, &caller, &headers);
    let inventory = app.catalogue.known(&revision).await?.inventory;
    let store = Arc::clone(app.catalogue.images());
    let architecture = program.architecture;
    let key = Arc::clone(&app.signing);
    let packing = move || stubs::archive(&store, &revision, &inventory, &program, &portal, &key);
    // It is never closed.
    let turn = PACKING.acquire().await;
    let archive = privilege::blocking(packing).await;
    drop(turn);
    let archive = archive.map_err(|_| Error::Internal("packing a stub"))??;
    if is_signature {
        let kind = [(header::CONTENT_TYPE, "application/x-ssh-signature")];
        return Ok((kind, archive.signature).into_response());
    }
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
        (
            header::HeaderName::from_static(SIGNATURE),
            sign::in_a_line(&archive.signature),
        ),
    ];
    let stream = ReaderStream::with_capacity(tokio::fs::File::from_std(archive.file), CHUNK);
    Ok((headers, Body::from_stream(stream)).into_response())
}

/// Where the robot reaches this portal: as whoever asks for the stub reached it, if nobody else can be meant by that: the
/// archive is signed, and robots send their tokens there. What signs itself is pinned by its fingerprint whatever the name
/// is; what an authority has signed speaks for the names in it alone. Of a proxy that is named, the operator has said to
/// believe it.
fn portal(app: &App, caller: &Caller, headers: &HeaderMap) -> Portal {
    let host = headers
        .get(header::HOST)
        .and_then(|host| host.to_str().ok())
        .filter(|host| stubs::is_authority(host))
        .filter(|host| match &app.tls {
            Some(tls) if !caller.forwarded => tls.signs_itself() || tls.speaks_for(host),
            _ => true,
        });
    let scheme = if caller.secure { "wss" } else { "ws" };
    let address = match (caller.peer, host) {
        (Peer::Tcp(_), Some(host)) => format!("{scheme}://{host}"),
        _ => app.address("").trim_end_matches('/').to_owned(),
    };
    // What a proxy shows is its own.
    let direct = !caller.forwarded;
    let tls = app.tls.as_ref().filter(|tls| direct && tls.signs_itself());
    Portal {
        address,
        fingerprint: tls.map(|tls| tls.fingerprint().to_string()),
    }
}
