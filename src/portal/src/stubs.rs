//! `/stubs`: what robots install in place of a package.

use std::sync::Arc;

use api::Stubs;
use api::stub::{ARCHITECTURE, ROS, SIGNATURE};
use axum::extract::{OriginalUri, Path, State};
use axum::http::{HeaderMap, header};
use axum::response::{IntoResponse, Response};
use axum::{Extension, Json};
use catalogue::stubs::{self, StubPrograms, TargetRobots};
use package::stub::Portal;
use ros::bus::RosVersion;
use serde::Deserialize;
use tokio::sync::Semaphore;

use crate::app::App;
use crate::body::file_body;
use crate::caller::{Caller, ConnectionPeer};
use crate::errors::Error;
use crate::query::Query;

/// Limit on the archives packed at once: each holds its files in memory meanwhile, and occupies a core.
static PACKING: Semaphore = Semaphore::const_new(2);

/// `/stubs`: services and architectures.
pub async fn list(State(app): State<Arc<App>>, Extension(caller): Extension<Caller>) -> Result<Json<Stubs>, Error> {
    let mut services = app.state.service_names()?;
    services.retain(|name| caller.can_see(&app, name));
    let programs = privilege::run_sync(StubPrograms::find_installed);
    Ok(Json(Stubs {
        services,
        architectures: programs.architectures(),
        lacking: programs.missing_architectures(),
        key: app.signing.public_key().to_string(),
    }))
}

/// Query of a stub.
#[derive(Debug, Deserialize)]
pub struct StubQuery {
    /// Architecture of the robot (default: this machine's).
    arch: Option<String>,
    /// ROS version of the robot (default: the service's).
    ros: Option<RobotRos>,
}

/// ROS version in a query.
#[derive(Debug, Clone, Copy, Deserialize)]
enum RobotRos {
    #[serde(rename = "1")]
    One,
    #[serde(rename = "2")]
    Two,
}

impl RobotRos {
    fn to_version(self) -> RosVersion {
        match self {
            Self::One => RosVersion::One,
            Self::Two => RosVersion::Two,
        }
    }
}

/// Returns the service of `NAME.tar.gz` or `NAME.tar.gz.sig`, and whether the file is the signature.
pub fn parse_file_name(file: &str) -> Option<(&str, bool)> {
    let signature = file.strip_suffix(".sig");
    let name = signature.unwrap_or(file).strip_suffix(".tar.gz")?;
    Some((name, signature.is_some()))
}

/// `/stubs/NAME.tar.gz` and `/stubs/NAME.tar.gz.sig`: requested alike, they match as long as the service has the same
/// revision.
pub async fn archive(
    State(app): State<Arc<App>>,
    Path(file): Path<String>,
    Query(asked): Query<StubQuery>,
    OriginalUri(uri): OriginalUri,
    Extension(caller): Extension<Caller>,
    headers: HeaderMap,
) -> Result<Response, Error> {
    let Some((name, is_signature)) = parse_file_name(&file) else {
        return Err(Error::UnknownPath {
            path: format!("{}; a stub is at /stubs/NAME.tar.gz, its signature at /stubs/NAME.tar.gz.sig", uri.path()),
        });
    };
    let revision = app.catalogue.current_revision(name)?;
    let program = privilege::run_sync(StubPrograms::find_installed).for_architecture(asked.arch.as_deref())?;
    let portal = stub_portal(&app, &caller, &headers);
    let inventory = app.catalogue.revision_contents(&revision).await?.inventory;
    let store = Arc::clone(app.catalogue.images());
    let architecture = program.architecture;
    let ros = asked.ros.map_or_else(|| revision.flavour.ros.ros_version(), RobotRos::to_version);
    let key = Arc::clone(&app.signing);
    let rules = Arc::clone(app.catalogue.translation_rules());
    let packing = move || {
        let robots = TargetRobots { ros, program: &program, portal: &portal, rules: &rules };
        stubs::build_archive(&store, &revision, &inventory, &robots, &key)
    };
    // The semaphore is never closed.
    let turn = PACKING.acquire().await;
    let archive = privilege::spawn_blocking(packing).await;
    drop(turn);
    let archive = archive.map_err(|_| Error::Internal("packing a stub"))??;
    if is_signature {
        let kind = [(header::CONTENT_TYPE, "application/x-ssh-signature")];
        return Ok((kind, archive.signature).into_response());
    }
    let headers = [
        (header::CONTENT_TYPE, "application/gzip".to_owned()),
        (header::CONTENT_DISPOSITION, format!("attachment; filename=\"{name}.tar.gz\"")),
        (header::HeaderName::from_static(ARCHITECTURE), architecture.to_owned()),
        (header::HeaderName::from_static(ROS), ros.number().to_string()),
        (header::HeaderName::from_static(SIGNATURE), sign::to_single_line(&archive.signature)),
    ];
    Ok((headers, file_body(archive.file, caller.wait_for_end(&app, name))).into_response())
}

/// Returns where the robot reaches this portal: as the caller reached it, provided that this cannot mean another
/// server, because the archive is signed and robots send their tokens there. A self-signed certificate is pinned by
/// its fingerprint, whatever the name; one signed by an authority is valid only for the names in it. A trusted proxy
/// is believed.
fn stub_portal(app: &App, caller: &Caller, headers: &HeaderMap) -> Portal {
    let host =
        headers.get(header::HOST).and_then(|host| host.to_str().ok()).filter(|host| stubs::is_authority(host)).filter(
            |host| match &app.tls {
                Some(tls) if !caller.forwarded => tls.is_self_signed() || tls.is_valid_for_host(host),
                _ => true,
            },
        );
    let scheme = if caller.secure { "wss" } else { "ws" };
    let address = match (caller.peer, host) {
        (ConnectionPeer::Tcp(_), Some(host)) => format!("{scheme}://{host}"),
        _ => app.address("").trim_end_matches('/').to_owned(),
    };
    // Behind a proxy, robots see the proxy's certificate.
    let direct = !caller.forwarded;
    let tls = app.tls.as_ref().filter(|tls| direct && tls.is_self_signed());
    Portal { address, fingerprint: tls.map(|tls| tls.fingerprint().to_string()) }
}
