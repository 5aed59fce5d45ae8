//! `/api/v1/pairings`, `/api/v1/pair`, `/api/v1/renew`: robots that have a key of their own (docs/adr/086).

use std::sync::Arc;
use std::time::Duration;

use access::{Action, Principal};
use api::machines::{NewPairing, Pair, Pairing, PairingMade, Renew, RobotCertificate};
use authority::{Authority, Issued, Request};
use axum::body::Body;
use axum::extract::{Path, State};
use axum::http::{HeaderMap, header};
use axum::{Extension, Json};
use catalogue::{names, stubs};
use tls::PairingLine;

use super::api_v1::Answer;
use super::guard::{Caller, Peer};
use super::policy::read;
use crate::app::App;
use crate::audit::About;
use crate::errors::Error;
use crate::principals::Shown;

/// What signs robots' certificates, and for how long.
pub struct Robots {
    /// The daemon's own authority.
    pub authority: Authority,
    /// How long a certificate is good.
    pub lifetime: Duration,
}

/// Robots that are paired, and those for which a code waits.
pub async fn list(State(app): State<Arc<App>>) -> Answer<Vec<Pairing>> {
    Ok(Json(app.principals.pairings()?))
}

/// Makes a code for a robot, or pairs one that has a certificate of the lab's own authority.
pub async fn begin(
    State(app): State<Arc<App>>,
    Extension(caller): Extension<Caller>,
    Extension(about): Extension<About>,
    headers: HeaderMap,
    body: Body,
) -> Answer<PairingMade> {
    let new: NewPairing = read(&app, &caller, body, "pairing").await?;
    names::robot(&new.robot).map_err(catalogue::Error::from)?;
    about.is(format!("robot {}", new.robot));
    let tls = app.tls.as_ref().filter(|_| app.robots.is_some());
    let Some(tls) = tls else {
        return Err(Error::BadRequest(format!(
            "robots are paired through TLS, and this daemon speaks plain text at {}: have it speak TLS ([tls] serve = \"tls\" in \
             its configuration, or listen beyond loopback without serve = \"plain-text-beyond-loopback\")",
            app.listen
        )));
    };
    if new.own_certificate {
        if !tls.trusts_others() {
            return Err(Error::BadRequest(
                "the configuration names no authority of the lab's own; name its certificates by client_authorities in [tls]".into(),
            ));
        }
        opened(&app, || app.principals.pair_own(&new))?;
        return Ok(Json(PairingMade {
            robot: new.robot,
            line: None,
            expires: None,
        }));
    }
    let server = server(&app, &caller, &headers, new.address.as_deref())?;
    let (code, expires) = app.principals.begin_pairing(&new)?;
    let key = app.signing.public().to_string();
    let line = PairingLine {
        server,
        robot: new.robot.clone(),
        fingerprint: tls.fingerprint(),
        key: key.split(' ').nth(1).unwrap_or_default().to_owned(),
        code,
    };
    Ok(Json(PairingMade {
        robot: new.robot,
        line: Some(line.to_string()),
        expires: Some(expires),
    }))
}

/// By which host and port the robot reaches the daemon: the one that is named, or by which whoever asks has reached it.
fn server(
    app: &App,
    caller: &Caller,
    headers: &HeaderMap,
    named: Option<&str>,
) -> Result<String, Error> {
    let host = headers
        .get(header::HOST)
        .and_then(|host| host.to_str().ok());
    let asked = match (named, caller.peer, caller.forwarded) {
        (Some(named), _, _) => named.to_owned(),
        (None, Peer::Tcp(_), false) => host.unwrap_or_default().to_owned(),
        // At the socket, or of a proxy, which keeps robots' certificates to itself.
        _ => {
            let address = app.address("");
            let (_, authority) = address.split_once("://").unwrap_or_default();
            authority.trim_end_matches('/').to_owned()
        }
    };
    let well_formed = stubs::is_authority(&asked) && port(&asked).is_some();
    match well_formed {
        true => Ok(asked),
        // A client leaves out the port that its scheme has (RFC 9110, section 4.2.2).
        false if named.is_none() && stubs::is_authority(&asked) => Ok(format!("{asked}:443")),
        false => Err(Error::BadRequest(format!(
            "{asked:?} is no address of this daemon; name it with --address HOST:PORT"
        ))),
    }
}

fn port(authority: &str) -> Option<u16> {
    let (host, port) = authority.rsplit_once(':')?;
    let whole = !host.contains(':') || host.ends_with(']');
    port.parse().ok().filter(|_| whole && !host.is_empty())
}

/// Pairing somebody for the first time closes the portal to those who show nothing.
fn opened<T>(app: &App, pairs: impl FnOnce() -> Result<T, Error>) -> Result<T, Error> {
    let first = app.principals.names_nobody();
    let done = pairs()?;
    if first {
        tracing::warn!(
            "the first robot was paired: from now on every request over TCP needs a token or a certificate"
        );
    }
    Ok(done)
}

/// Ends a robot's pairing and its connections, and takes back its code.
pub async fn unpair(
    State(app): State<Arc<App>>,
    Path(name): Path<String>,
    Extension(about): Extension<About>,
) -> Answer<Vec<Pairing>> {
    about.is(format!("robot {name}"));
    app.principals.unpair(&name)?;
    Ok(Json(app.principals.pairings()?))
}

/// Takes a robot's code back.
pub async fn cancel(
    State(app): State<Arc<App>>,
    Path(name): Path<String>,
    Extension(about): Extension<About>,
) -> Answer<Vec<Pairing>> {
    about.is(format!("robot {name}"));
    app.principals.cancel_pairing(&name)?;
    Ok(Json(app.principals.pairings()?))
}

/// Gives a robot that shows its code a certificate of its key.
pub async fn pair(
    State(app): State<Arc<App>>,
    Extension(caller): Extension<Caller>,
    body: Body,
) -> Answer<RobotCertificate> {
    // What was shown beside it counts for nothing.
    let caller = Caller::nobody(&caller);
    let robots = robots(&app, &caller)?;
    let shown: Pair = read(&app, &caller, body, "pairing").await?;
    names::robot(&shown.robot).map_err(catalogue::Error::from)?;
    let object = format!("robot {}", shown.robot);
    match paired(&app, robots, &caller, &shown) {
        Ok(issued) => {
            let robot = Caller::named(&caller, &shown.robot);
            app.audit
                .record(&robot, Action::Pair, "was paired by a code", &object, 200);
            Ok(Json(certificate(shown.robot, issued)))
        }
        Err(error) => {
            let status = error.problem().status;
            let did = format!("showed a pairing code: {error}");
            app.audit
                .record_sparingly(&caller, Action::Pair, &did, &object, status);
            Err(error)
        }
    }
}

fn paired(app: &App, robots: &Robots, caller: &Caller, shown: &Pair) -> Result<Issued, Error> {
    let principals = &app.principals;
    // The code first: of strangers no request is looked at.
    let code = principals.code(&shown.robot, &shown.code, caller.peer.ip(), store::now())?;
    let request = Request::read(&shown.request, &shown.robot).map_err(Error::Uncertifiable)?;
    opened(app, || {
        principals.pair(&code, &request, &robots.authority, robots.lifetime)
    })
}

fn certificate(robot: String, issued: Issued) -> RobotCertificate {
    RobotCertificate {
        robot,
        certificate: issued.certificate,
        issued: issued.issued,
        expires: issued.expires,
    }
}

/// Gives a paired robot another certificate of its key.
pub async fn renew(
    State(app): State<Arc<App>>,
    Extension(caller): Extension<Caller>,
    body: Body,
) -> Answer<RobotCertificate> {
    let robots = robots(&app, &caller)?;
    let Shown::Certificate {
        pairing,
        key: Some(key),
        ..
    } = &caller.who.shown
    else {
        return Err(Error::BadRequest(
            "a certificate is renewed by the robot that shows it, where the daemon has signed it; those of the lab's own authority are \
             renewed there"
                .into(),
        ));
    };
    let asked: Renew = read(&app, &caller, body, "renewal").await?;
    let robot = caller.who.principal.name.clone();
    let object = format!("robot {robot}");
    let renewed = Request::read(&asked.request, &robot)
        .map_err(Error::Uncertifiable)
        .and_then(|request| {
            if request.key_hash() != key {
                return Err(Error::BadRequest(format!(
                    "the request has another key than {robot} was paired with; to give it another, pair it again: cloudroidctl pair {robot}"
                )));
            }
            let principals = &app.principals;
            principals.renew((*pairing, &robot), &request, &robots.authority, robots.lifetime)
        });
    match renewed {
        Ok(issued) => {
            app.audit.record_sparingly(
                &caller,
                Action::Pair,
                "renewed its certificate",
                &object,
                200,
            );
            Ok(Json(certificate(robot, issued)))
        }
        Err(error) => {
            let status = error.problem().status;
            let did = "asked for another certificate";
            app.audit
                .record_sparingly(&caller, Action::Pair, did, &object, status);
            Err(error)
        }
    }
}

/// What signs certificates, where nobody is on the way.
fn robots<'a>(app: &'a App, caller: &Caller) -> Result<&'a Robots, Error> {
    let robots = app.robots.as_ref();
    robots.filter(|_| caller.secure && !caller.forwarded).ok_or_else(|| {
        Error::BadRequest(
            "robots are paired through TLS with the daemon itself: not in plain text, and not through a proxy, which keeps their \
             certificates to itself"
                .into(),
        )
    })
}

impl Caller {
    /// Who asks, taken for nobody.
    fn nobody(caller: &Caller) -> Caller {
        let mut nobody = caller.clone();
        nobody.who.principal = Arc::new(Principal::nobody());
        nobody
    }

    /// The same as a robot, for the audit log.
    fn named(caller: &Caller, robot: &str) -> Caller {
        let mut named = caller.clone();
        named.who.principal = Arc::new(Principal {
            name: robot.to_owned(),
            roles: vec![access::Role::Robot],
            ..Principal::nobody()
        });
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
            assert_eq!(port(authority), found, "{authority}");
        }
    }
}
