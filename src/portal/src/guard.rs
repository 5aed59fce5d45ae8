//! Who asks: decided for each request, before its handler. What they may do is decided where the request is routed
//! ([`crate::allowed`]).
//!
//! Where there are tokens, each TCP request needs one, also from this machine, because requests of a web server in front
//! of the portal come from this machine, too. People show a session in its place, by a cookie
//! ([`crate::people::cookies`]). Without either only the page (which asks for one), its assets, `/healthz`
//! and a robot's WebSocket handshake (whose first message must be rosbridge's `auth`) are answered.
//!
//! Where there never was a token the portal listens on loopback only, and requests need none: this machine's users see
//! everything and are any robot; root, at its socket, is an admin. Web pages of other sites must
//! not use the portal through the browser of a user of this machine. So requests with another host in `Host` (DNS
//! rebinding), with another origin (cross-site requests and WebSockets), or with a proxy's headers are refused.

mod caller;
mod elsewhere;

use std::borrow::Cow;
use std::sync::Arc;
use std::time::{Duration, Instant};

use access::{Action, Principal};
use axum::extract::{Request, State};
use axum::http::{HeaderMap, Method, Uri, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use catalogue::names;
use parking_lot::Mutex;

use crate::app::App;
use crate::errors::Error;
use crate::oci;
use crate::people::cookies;
use crate::principals::{Identity, Recognising, Shown, Uncertified};
use crate::routes::{self, Access};
use crate::tokens;

pub use caller::{Caller, Connection, Peer, User};
pub use elsewhere::check_part;

/// Shortest time between two log lines about the same refusal.
const AGAIN: Duration = Duration::from_secs(60);
/// Most different refusals that are logged within that time; their text is chosen by the client.
const DIFFERENT: usize = 32;

/// What decides who asks.
pub struct Rules<'a> {
    /// The portal is bound to loopback.
    pub loopback: bool,
    /// By what tokens are recognised.
    pub known: Recognising<'a>,
    /// Origins allowed besides loopback's.
    pub origins: &'a [String],
}

/// Lets a request through with its [`Caller`], or refuses it.
pub async fn guard(State(app): State<Arc<App>>, mut request: Request, next: Next) -> Response {
    let Some(connection) = request.extensions().get::<Connection>() else {
        return Error::Internal("telling who asks").into_response();
    };
    let connection = match app.options.proxies.seen(connection, request.headers()) {
        Ok(seen) => seen,
        Err(error) => {
            // For whom the proxy asks cannot be told: it is the proxy's.
            let nobody = Caller::new(connection, Principal::nobody(), Shown::Nothing);
            let did = format!("{} {}", request.method(), request.uri().path());
            let status = error.problem().status;
            let object = "a client that its proxy names badly";
            app.audit
                .record_sparingly(&nobody, Action::Enter, &did, object, status);
            return error.into_response();
        }
    };
    let peer = connection.peer;
    let admitted = app.principals.with(|known| {
        let rules = Rules {
            loopback: app.listen.ip().is_loopback(),
            known,
            origins: &app.options.origins,
        };
        let (uri, headers) = (request.uri(), request.headers());
        if let Some(certified) = certified(&app, &connection, known) {
            // A token that is shown beside it says who asks; and no page uses a browser's certificate.
            if token_in(uri, headers).is_none() {
                elsewhere::check_origin(headers, rules.origins)?;
                elsewhere::check_part(headers)?;
                return Ok(Caller::by(&connection, certified?));
            }
        }
        rules.admit(&connection, request.method(), uri, headers)
    });
    match admitted {
        Ok(caller) => {
            if caller.who.shown != Shown::Nothing {
                connection.admit();
            }
            app.principals.note_use(&caller.who, store::now());
            request.extensions_mut().insert(caller);
            next.run(request).await
        }
        Err(error) => {
            if let Error::Foreign { what, next } = &error {
                report(peer, what, next);
                let (method, path) = (request.method(), request.uri().path());
                let nobody = Caller::new(&connection, Principal::nobody(), Shown::Nothing);
                let (did, status) = (format!("{method} {path}"), error.problem().status);
                app.audit
                    .record_sparingly(&nobody, Action::Enter, &did, what, status);
            }
            if let Error::Uncertified(why) = &error {
                let nobody = Caller::new(&connection, Principal::nobody(), Shown::Nothing);
                let did = format!("{} {}", request.method(), request.uri().path());
                let (object, status) = (why.to_string(), error.problem().status);
                app.audit
                    .record_sparingly(&nobody, Action::Enter, &did, &object, status);
            }
            if oci::is_of_registry_client(request.uri().path(), request.headers()) {
                oci::not_let_in(&error)
            } else {
                error.into_response()
            }
        }
    }
}

/// Whose robot's certificate a connection has shown, if any.
pub fn certified(
    app: &App,
    connection: &Connection,
    known: Recognising<'_>,
) -> Option<Result<Identity, Uncertified>> {
    let own = connection.certificates.first()?;
    let authority = &app.robots.as_ref()?.authority;
    let shown = authority::read(own).map_err(|error| Uncertified::Nameless(error.to_string()));
    Some(shown.and_then(|shown| known.certified(authority, &shown, store::now())))
}

/// Logs a refusal, so that the operator can allow it; at most once a minute, because pages repeat their requests.
fn report(peer: Peer, what: &str, next: &str) {
    static TOLD: Mutex<Vec<(Instant, String)>> = Mutex::new(Vec::new());
    let mut told = TOLD.lock();
    told.retain(|(at, _)| at.elapsed() < AGAIN);
    if told.len() < DIFFERENT && !told.iter().any(|(_, earlier)| earlier == what) {
        told.push((Instant::now(), what.to_owned()));
        tracing::warn!("refused a request of {peer}: {what}; {next}");
    }
}

impl Rules<'_> {
    fn admit(
        &self,
        connection: &Connection,
        method: &Method,
        uri: &Uri,
        headers: &HeaderMap,
    ) -> Result<Caller, Error> {
        if let Peer::Unix(user) = connection.peer {
            return admit_user(connection, user);
        }
        let given = token_in(uri, headers);
        if self.loopback && self.known.tokens.is_empty() && self.known.stored.is_empty() {
            elsewhere::check_direct(headers)?;
            elsewhere::check_host(headers)?;
            elsewhere::check_origin(headers, self.origins)?;
            elsewhere::check_part(headers)?;
            let mut caller = Caller::new(connection, Principal::local(), Shown::Nothing);
            // Any token is taken; it only owns robots' names.
            let token = given.as_deref().map(tokens::hash);
            caller.who.owner.clone_from(&token);
            caller.who.token = token;
            return Ok(caller);
        }
        match given {
            Some(token) => {
                let from = connection.peer.ip();
                let who = self.known.recognise(&token, from, store::now())?;
                Ok(Caller::by(connection, who))
            }
            None => self.admit_session(connection, method, uri, headers),
        }
    }

    /// Who shows no token may show a session, by a cookie; and some requests need neither.
    fn admit_session(
        &self,
        connection: &Connection,
        method: &Method,
        uri: &Uri,
        headers: &HeaderMap,
    ) -> Result<Caller, Error> {
        let open = is_open(method, uri, headers);
        // Who signs in may show a session that it was given by another: it counts for nothing.
        let signs_in = *method == Method::POST && routes::access(uri.path()) == Access::SignIn;
        let shown = match signs_in {
            true => None,
            false => cookies::shown(connection, headers)?,
        };
        let session = shown.map(|secret| {
            let who = self.known.recognise_session(&secret, store::now())?;
            cookies::check(connection, method, headers, &secret)?;
            Ok::<_, Error>(Caller::by(connection, who))
        });
        match session {
            Some(Ok(caller)) => Ok(caller),
            Some(Err(error @ Error::Foreign { .. })) => Err(error),
            Some(Err(error)) if !open => Err(error),
            _ if open => {
                let nobody = Principal::nobody();
                Ok(Caller::new(connection, nobody, Shown::Nothing))
            }
            _ => Err(Error::Unauthorised("a token is needed")),
        }
    }
}

fn admit_user(connection: &Connection, user: User) -> Result<Caller, Error> {
    let User { uid, is_member } = user;
    // The daemon is root's. This thread is not, and its own user may nothing.
    if uid == 0 || is_member {
        let name = match uid {
            0 => "root".to_owned(),
            uid => format!("user {uid}"),
        };
        return Ok(Caller::new(
            connection,
            Principal::admin(&name),
            Shown::User,
        ));
    }
    Err(Error::Foreign {
        what: format!("user {uid} may not use the daemon's socket"),
        next: "ask as root (sudo) or as a member of the group that admin_group names, or over TCP with --server"
            .to_owned(),
    })
}

/// Whether a request is answered without a token, as the table of routes says.
fn is_open(method: &Method, uri: &Uri, headers: &HeaderMap) -> bool {
    let path = uri.path();
    match (routes::access(path), is_upgrade(headers)) {
        (Access::Connect | Access::ReadOrConnect, true) => {
            *method == Method::GET && (path == "/" || is_service(path))
        }
        (Access::Code, false) => *method == Method::POST,
        (Access::Read | Access::ReadOrConnect, false) => {
            matches!(*method, Method::GET | Method::HEAD)
        }
        (Access::SignIn, false) => matches!(*method, Method::GET | Method::HEAD | Method::POST),
        _ => false,
    }
}

/// Whether a path can be that of a service: `/NAME`, or `/NAME/`.
fn is_service(path: &str) -> bool {
    let name = path.strip_prefix('/').unwrap_or_default();
    names::service(name.strip_suffix('/').unwrap_or(name)).is_ok()
}

/// Whether a WebSocket is asked for.
pub fn is_upgrade(headers: &HeaderMap) -> bool {
    header_text(headers, header::UPGRADE)
        .is_some_and(|upgrade| upgrade.eq_ignore_ascii_case("websocket"))
}

/// The token of `Authorization`: `Bearer` everywhere. At the registry, whose clients have nothing else, also the password of `Basic`, whatever
/// the name beside it is. Browsers send that by themselves once somebody has given it: nothing is changed there.
fn authorization(uri: &Uri, headers: &HeaderMap) -> Option<String> {
    let (scheme, sent) = header_text(headers, header::AUTHORIZATION)?.split_once(' ')?;
    let sent = sent.trim();
    if scheme.eq_ignore_ascii_case("bearer") {
        return Some(sent.to_owned());
    }
    if scheme.eq_ignore_ascii_case("basic") && oci::is_registrys(uri.path()) {
        let pair = base64_simd::STANDARD.decode_to_vec(sent).ok()?;
        let (_, password) = std::str::from_utf8(&pair).ok()?.split_once(':')?;
        return Some(password.to_owned());
    }
    None
}

fn token_in(uri: &Uri, headers: &HeaderMap) -> Option<String> {
    let protocol = || {
        let token = protocols(headers).find_map(|protocol| protocol.strip_prefix(BEARER))?;
        Some(token.to_owned())
    };
    authorization(uri, headers)
        .or_else(protocol)
        .or_else(|| query(uri.query(), "token"))
}

/// A WebSocket subprotocol that begins so is a token, of clients that can set no other header.
pub const BEARER: &str = "bearer.";
/// The one that is chosen where they offer it.
pub const ROSBRIDGE: &str = "rosbridge";

/// The WebSocket subprotocols that are offered.
pub fn protocols(headers: &HeaderMap) -> impl Iterator<Item = &str> {
    let offered = headers.get_all(header::SEC_WEBSOCKET_PROTOCOL).iter();
    offered
        .filter_map(|value| value.to_str().ok())
        .flat_map(|value| value.split(','))
        .map(str::trim)
}

/// One value of the query, decoded.
pub fn query(query: Option<&str>, name: &str) -> Option<String> {
    let (_, value) = pairs(query).find(|(key, _)| key == name)?;
    Some(value.into_owned())
}

/// All parameters of a query, in their order.
pub fn pairs(query: Option<&str>) -> impl Iterator<Item = (Cow<'_, str>, Cow<'_, str>)> {
    form_urlencoded::parse(query.unwrap_or_default().as_bytes())
}

fn header_text(headers: &HeaderMap, name: header::HeaderName) -> Option<&str> {
    headers.get(name).and_then(|value| value.to_str().ok())
}

#[cfg(test)]
mod tests;
