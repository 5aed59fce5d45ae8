//! `/api/v1/pairings`, `/api/v1/pair`, `/api/v1/renew`: robots with a key of their own (docs/adr/086).

use std::sync::Arc;

use access::{AccessAction, Principal};
use api::machines::{NewPairing, Pair, Pairing, PairingMade, Renew, RobotCertificate};
use authority::{CertificateRequest, IssuedRobotCertificate};
use axum::body::Body;
use axum::extract::{Path, State};
use axum::http::{HeaderMap, header};
use axum::{Extension, Json};
use catalogue::{names, stubs};
use tls::PairingLine;

use crate::app::{App, RobotAuthority};
use crate::audit::AuditObject;
use crate::caller::{Caller, ConnectionPeer};
use crate::errors::Error;
use crate::json::{JsonResult, read_json};
use crate::principals::identity::Credential;

/// Lists paired robots and pending pairing codes.
pub async fn list(State(app): State<Arc<App>>) -> JsonResult<Vec<Pairing>> {
    Ok(Json(app.principals.pairings()?))
}

/// Creates a pairing code for a robot, or pairs a robot that has a certificate of the operator's own authority.
pub async fn begin(
    State(app): State<Arc<App>>,
    Extension(caller): Extension<Caller>,
    Extension(about): Extension<AuditObject>,
    headers: HeaderMap,
    body: Body,
) -> JsonResult<PairingMade> {
    let new: NewPairing = read_json(&app, &caller, body, "pairing").await?;
    names::validate_robot(&new.robot).map_err(catalogue::Error::from)?;
    about.set(format!("robot {}", new.robot));
    let tls = app.tls.as_ref().filter(|_| app.robots.is_some());
    let Some(tls) = tls else {
        return Err(Error::BadRequest(format!(
            "robots are paired over TLS, but this daemon speaks plain text at {}: enable TLS ([tls] serve = \"tls\" in \
                its configuration, or listen beyond loopback without serve = \"plain-text-beyond-loopback\")",
            app.listen
        )));
    };
    if new.own_certificate {
        if !tls.has_other_authorities() {
            return Err(Error::BadRequest(
                "the configuration has no certificate authority of the lab; set client_authorities in [tls]".into(),
            ));
        }
        pair_and_warn(&app, || app.principals.pair_own(&new))?;
        return Ok(Json(PairingMade { robot: new.robot, line: None, expires: None }));
    }
    let server = server_address(&app, &caller, &headers, new.address.as_deref())?;
    let (code, expires) = app.principals.begin_pairing(&new)?;
    let key = app.signing.public_key().to_string();
    let line = PairingLine {
        server,
        robot: new.robot.clone(),
        fingerprint: tls.fingerprint(),
        key: key.split(' ').nth(1).unwrap_or_default().to_owned(),
        code,
    };
    Ok(Json(PairingMade { robot: new.robot, line: Some(line.to_string()), expires: Some(expires) }))
}

/// Returns the host and port at which the robot reaches the daemon: the given address, or the one that the caller
/// used.
fn server_address(app: &App, caller: &Caller, headers: &HeaderMap, named: Option<&str>) -> Result<String, Error> {
    let host = headers.get(header::HOST).and_then(|host| host.to_str().ok());
    let asked = match (named, caller.peer, caller.forwarded) {
        (Some(named), _, _) => named.to_owned(),
        (None, ConnectionPeer::Tcp(_), false) => host.unwrap_or_default().to_owned(),
        // The caller is at the Unix socket or behind a proxy, which would not pass on robots' certificates.
        _ => {
            let address = app.address("");
            let (_, authority) = address.split_once("://").unwrap_or_default();
            authority.trim_end_matches('/').to_owned()
        }
    };
    let well_formed = stubs::is_authority(&asked) && parse_port(&asked).is_some();
    if well_formed {
        Ok(asked)
    } else if named.is_none() && stubs::is_authority(&asked) {
        // Clients omit the default port of the scheme (RFC 9110, section 4.2.2).
        Ok(format!("{asked}:443"))
    } else {
        Err(Error::BadRequest(format!("{asked:?} is not an address of this daemon; give one with --address HOST:PORT")))
    }
}

fn parse_port(authority: &str) -> Option<u16> {
    let (host, port) = authority.rsplit_once(':')?;
    let whole = !host.contains(':') || host.ends_with(']');
    port.parse().ok().filter(|_| whole && !host.is_empty())
}

/// Pairs a robot. The first pairing closes the portal to unauthenticated callers, which is logged.
fn pair_and_warn<T>(app: &App, pairs: impl FnOnce() -> Result<T, Error>) -> Result<T, Error> {
    let first = app.principals.has_no_credentials();
    let done = pairs()?;
    if first {
        tracing::warn!("the first robot was paired: from now on every request over TCP needs a token or a certificate");
    }
    Ok(done)
}

/// Ends a robot's pairing and its connections, and cancels its pairing code.
pub async fn unpair(
    State(app): State<Arc<App>>,
    Path(name): Path<String>,
    Extension(about): Extension<AuditObject>,
) -> JsonResult<Vec<Pairing>> {
    about.set(format!("robot {name}"));
    app.principals.unpair(&name)?;
    Ok(Json(app.principals.pairings()?))
}

/// Cancels a robot's pairing code.
pub async fn cancel(
    State(app): State<Arc<App>>,
    Path(name): Path<String>,
    Extension(about): Extension<AuditObject>,
) -> JsonResult<Vec<Pairing>> {
    about.set(format!("robot {name}"));
    app.principals.cancel_pairing(&name)?;
    Ok(Json(app.principals.pairings()?))
}

/// Issues a certificate to a robot that presents its pairing code.
pub async fn pair(
    State(app): State<Arc<App>>,
    Extension(caller): Extension<Caller>,
    body: Body,
) -> JsonResult<RobotCertificate> {
    // Other credentials of the request are ignored.
    let caller = Caller::as_nobody(&caller);
    let robots = require_robot_authority(&app, &caller)?;
    let shown: Pair = read_json(&app, &caller, body, "pairing").await?;
    names::validate_robot(&shown.robot).map_err(catalogue::Error::from)?;
    let object = format!("robot {}", shown.robot);
    match pair_by_code(&app, robots, &caller, &shown) {
        Ok(issued) => {
            let robot = Caller::as_robot(&caller, &shown.robot);
            app.audit.record(&robot, AccessAction::Pair, "was paired by a code", &object, 200);
            Ok(Json(to_robot_certificate(shown.robot, issued)))
        }
        Err(error) => {
            let status = error.problem().status;
            let did = format!("presented a pairing code: {error}");
            app.audit.record_throttled(&caller, AccessAction::Pair, &did, &object, status);
            Err(error)
        }
    }
}

fn pair_by_code(
    app: &App,
    robots: &RobotAuthority,
    caller: &Caller,
    shown: &Pair,
) -> Result<IssuedRobotCertificate, Error> {
    let principals = &app.principals;
    // The code is checked first: requests of strangers are not parsed.
    let code = principals.check_code(&shown.robot, &shown.code, caller.peer.ip(), store::now())?;
    let request = CertificateRequest::parse(&shown.request, &shown.robot).map_err(Error::Uncertifiable)?;
    pair_and_warn(app, || principals.pair(&code, &request, &robots.authority, robots.lifetime))
}

fn to_robot_certificate(robot: String, issued: IssuedRobotCertificate) -> RobotCertificate {
    RobotCertificate { robot, certificate: issued.certificate, issued: issued.issued, expires: issued.expires }
}

/// Renews the certificate of a paired robot.
pub async fn renew(
    State(app): State<Arc<App>>,
    Extension(caller): Extension<Caller>,
    body: Body,
) -> JsonResult<RobotCertificate> {
    let robots = require_robot_authority(&app, &caller)?;
    let Credential::Certificate { pairing, key: Some(key), .. } = &caller.who.shown else {
        return Err(Error::BadRequest(
            "only the robot itself can renew its certificate, and only one signed by this daemon; certificates of the \
                lab's own authority are renewed there"
                .into(),
        ));
    };
    let asked: Renew = read_json(&app, &caller, body, "renewal").await?;
    let robot = caller.who.principal.name.clone();
    let object = format!("robot {robot}");
    let renewed = CertificateRequest::parse(&asked.request, &robot).map_err(Error::Uncertifiable).and_then(|request| {
        if request.key_hash() != key {
            return Err(Error::BadRequest(format!(
                "the request has a different key than {robot} was paired with; to change the key, pair it again: \
                        cloudroidctl pair {robot}"
            )));
        }
        let principals = &app.principals;
        principals.renew((*pairing, &robot), &request, &robots.authority, robots.lifetime)
    });
    match renewed {
        Ok(issued) => {
            app.audit.record_throttled(&caller, AccessAction::Pair, "renewed its certificate", &object, 200);
            Ok(Json(to_robot_certificate(robot, issued)))
        }
        Err(error) => {
            let status = error.problem().status;
            let did = "asked for another certificate";
            app.audit.record_throttled(&caller, AccessAction::Pair, did, &object, status);
            Err(error)
        }
    }
}

/// Returns the authority if the connection is direct and encrypted.
fn require_robot_authority<'a>(app: &'a App, caller: &Caller) -> Result<&'a RobotAuthority, Error> {
    let robots = app.robots.as_ref();
    robots.filter(|_| caller.secure && !caller.forwarded).ok_or_else(|| {
        Error::BadRequest(
            "robots are paired over TLS with the daemon itself: not in plain text, and not through a proxy, which \
                hides their certificates"
                .into(),
        )
    })
}

impl Caller {
    /// Returns the caller without its identity.
    fn as_nobody(caller: &Caller) -> Caller {
        let mut nobody = caller.clone();
        nobody.who.principal = Arc::new(Principal::nobody());
        nobody
    }

    /// Returns the caller with the identity of the robot, for the audit log.
    fn as_robot(caller: &Caller, robot: &str) -> Caller {
        let mut named = caller.clone();
        named.who.principal =
            Arc::new(Principal { name: robot.to_owned(), roles: vec![access::Role::Robot], ..Principal::nobody() });
        named
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_have_a_port() {
        for (authority, found) in [
            ("lab:9090", Some(9090)),
            ("[::1]:9090", Some(9090)),
            ("lab", None),
            ("::1", None),
            ("lab:", None),
            ("lab:99999", None),
        ] {
            assert_eq!(parse_port(authority), found, "{authority}");
        }
    }
}
