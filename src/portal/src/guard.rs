//! Authentication of each request, before its handler. What the caller may do is decided where the request is routed
//! ([`crate::allowed`]).
//!
//! Where tokens exist, every TCP request needs one, even from this machine, because the requests of a web server in
//! front of the portal come from this machine, too. People present a session cookie instead
//! ([`crate::people::cookies`]). Without either, only the page (which asks for a credential), its assets, `/healthz`,
//! and a robot's WebSocket handshake (whose first message must be rosbridge's `auth`) are answered.
//!
//! Where there never was a token, the portal listens on loopback only and requests need none: this machine's users
//! see everything and may act as any robot; root, at its socket, is an admin. Web pages of other sites must not use
//! the portal through the browser of a user of this machine. So requests with another host in `Host` (DNS rebinding),
//! with another origin (cross-site requests and WebSockets), or with a proxy's headers are refused.
//!
//! If the operator allows it (`loopback_robots`), robots on this machine connect without a token even where tokens
//! exist: handshakes from loopback that pass the same checks.

pub mod elsewhere;

use std::sync::{Arc, LazyLock};

use access::{AccessAction, Principal};
use axum::extract::{Request, State};
use axum::http::{HeaderMap, Method, Uri, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use catalogue::names;
use parking_lot::Mutex;
use store::NoticeThrottle;

use crate::app::App;
use crate::caller::{Caller, ConnectionPeer, PortalConnection, User};
use crate::errors::Error;
use crate::headers::{BEARER, header_text, is_upgrade, protocols};
use crate::people::cookies;
use crate::principals::Recogniser;
use crate::principals::identity::{CallerIdentity, Credential};
use crate::principals::refusals::CertificateRefusal;
use crate::query::query_value;
use crate::registry_clients;
use crate::route_access::{Access, DescribeRequest, FindAccess};
use crate::tokens;

/// Settings that decide which requests are admitted.
pub struct AdmissionRules<'a> {
    /// True if the portal is bound to loopback.
    pub loopback: bool,
    /// True if robots on this machine need no token even where tokens exist.
    pub loopback_robots: bool,
    /// Recognises credentials.
    pub known: Recogniser<'a>,
    /// Allowed origins besides loopback's.
    pub origins: &'a [String],
    /// Looks up the route of a path.
    pub find_access: FindAccess,
}

/// Middleware that passes a request on with its [`Caller`], or refuses it.
pub async fn guard(
    State((app, find_access, describe)): State<(Arc<App>, FindAccess, DescribeRequest)>,
    mut request: Request,
    next: Next,
) -> Response {
    let Some(connection) = request.extensions().get::<PortalConnection>() else {
        return Error::Internal("identifying the caller").into_response();
    };
    let connection = match app.options.proxies.resolve_client(connection, request.headers()) {
        Ok(seen) => seen,
        Err(error) => {
            // The client cannot be determined, so the request is attributed to the proxy.
            let nobody = Caller::new(connection, Principal::nobody(), Credential::Nothing);
            let did = describe(request.method(), request.uri().path());
            let status = error.problem().status;
            let object = format!("a client with a malformed proxy header ({})", request.uri().path());
            app.audit.record_throttled(&nobody, AccessAction::Enter, &did, &object, status);
            return error.into_response();
        }
    };
    let peer = connection.peer;
    let admitted = app.principals.with_recogniser(|known| {
        let rules = AdmissionRules {
            loopback: app.listen.ip().is_loopback(),
            loopback_robots: app.options.loopback_robots,
            known,
            origins: &app.options.origins,
            find_access,
        };
        let (uri, headers) = (request.uri(), request.headers());
        if let Some(certified) = recognise_certificate(&app, &connection, known) {
            // A token sent as well takes precedence, and no page may use a browser's certificate.
            if find_token(uri, headers).is_none() {
                elsewhere::check_origin(headers, rules.origins)?;
                elsewhere::check_not_embedded(headers)?;
                return Ok(Caller::from_identity(&connection, certified?));
            }
        }
        rules.admit(&connection, request.method(), uri, headers)
    });
    match admitted {
        Ok(caller) => {
            if caller.who.shown != Credential::Nothing {
                connection.admit();
            }
            app.principals.record_use(&caller.who, store::now());
            request.extensions_mut().insert(caller);
            next.run(request).await
        }
        Err(error) => {
            if let Error::Foreign { what, next } = &error {
                log_refusal(peer, what, next);
                let did = describe(request.method(), request.uri().path());
                let nobody = Caller::new(&connection, Principal::nobody(), Credential::Nothing);
                let (object, status) = (format!("{what} ({})", request.uri().path()), error.problem().status);
                app.audit.record_throttled(&nobody, AccessAction::Enter, &did, &object, status);
            }
            if let Error::Uncertified(why) = &error {
                let nobody = Caller::new(&connection, Principal::nobody(), Credential::Nothing);
                let did = describe(request.method(), request.uri().path());
                let (object, status) = (format!("{why} ({})", request.uri().path()), error.problem().status);
                app.audit.record_throttled(&nobody, AccessAction::Enter, &did, &object, status);
            }
            error.into_response()
        }
    }
}

/// Recognises the robot certificate of a connection, if it presented one.
pub fn recognise_certificate(
    app: &App,
    connection: &PortalConnection,
    known: Recogniser<'_>,
) -> Option<Result<CallerIdentity, CertificateRefusal>> {
    let own = connection.certificates.first()?;
    let authority = &app.robots.as_ref()?.authority;
    let shown = authority::read_robot_certificate(own).map_err(|error| CertificateRefusal::Nameless(error.to_string()));
    Some(shown.and_then(|shown| known.recognise_certificate(authority, &shown, store::now())))
}

/// Logs a refusal, so that the operator can allow it. Pages repeat their requests, and clients choose the text.
fn log_refusal(peer: ConnectionPeer, what: &str, next: &str) {
    static THROTTLE: LazyLock<Mutex<NoticeThrottle>> = LazyLock::new(Mutex::default);
    let admitted = THROTTLE.lock().admit(what, store::now());
    if admitted.is_some() {
        tracing::warn!("refused a request of {peer}: {what}; {next}");
    }
}

impl AdmissionRules<'_> {
    fn admit(
        &self,
        connection: &PortalConnection,
        method: &Method,
        uri: &Uri,
        headers: &HeaderMap,
    ) -> Result<Caller, Error> {
        if let ConnectionPeer::Unix(user) = connection.peer {
            return admit_user(connection, user);
        }
        let given = find_token(uri, headers);
        if given.is_none() && self.is_loopback_robot(connection, method, uri, headers) {
            return Ok(Caller::new(connection, Principal::local_robot(), Credential::Loopback));
        }
        if self.loopback && self.known.tokens.is_empty() && self.known.stored.is_empty() {
            elsewhere::check_local(headers, self.origins)?;
            let mut caller = Caller::new(connection, Principal::local(), Credential::Nothing);
            // Any token is accepted; it only owns robots' names.
            let token = given.as_deref().map(tokens::hash);
            caller.who.owner.clone_from(&token);
            caller.who.token = token;
            return Ok(caller);
        }
        match given {
            Some(token) => {
                let from = connection.peer.ip();
                let who = self.known.recognise(&token, from, store::now())?;
                Ok(Caller::from_identity(connection, who))
            }
            None => self.admit_session(connection, method, uri, headers),
        }
    }

    /// Returns true if the request is the handshake of a robot on this machine that needs no token. A browser with a
    /// session's cookie is a person's.
    fn is_loopback_robot(
        &self,
        connection: &PortalConnection,
        method: &Method,
        uri: &Uri,
        headers: &HeaderMap,
    ) -> bool {
        self.loopback_robots
            && connection.peer.ip().to_canonical().is_loopback()
            && !connection.forwarded
            && is_upgrade(headers)
            && is_open((self.find_access)(uri.path()), method, uri, headers)
            && matches!(cookies::session_cookie(connection, headers), Ok(None))
            && elsewhere::check_local(headers, self.origins).is_ok()
    }

    /// Recognises a session cookie if no token was sent; some requests need neither.
    fn admit_session(
        &self,
        connection: &PortalConnection,
        method: &Method,
        uri: &Uri,
        headers: &HeaderMap,
    ) -> Result<Caller, Error> {
        let access = (self.find_access)(uri.path());
        let open = is_open(access, method, uri, headers);
        // During a sign-in, a session is ignored: another site may have planted it.
        let signs_in = *method == Method::POST && access == Access::SignIn;
        let shown = if signs_in { None } else { cookies::session_cookie(connection, headers)? };
        let session = shown.map(|secret| {
            let who = self.known.recognise_session(&secret, store::now())?;
            cookies::check(connection, method, headers, &secret)?;
            Ok::<_, Error>(Caller::from_identity(connection, who))
        });
        match session {
            Some(Ok(caller)) => Ok(caller),
            Some(Err(error @ Error::Foreign { .. })) => Err(error),
            Some(Err(error)) if !open => Err(error),
            _ if open => {
                let nobody = Principal::nobody();
                Ok(Caller::new(connection, nobody, Credential::Nothing))
            }
            _ => Err(Error::Unauthorised("a token is needed")),
        }
    }
}

fn admit_user(connection: &PortalConnection, user: User) -> Result<Caller, Error> {
    let User { uid, is_member } = user;
    // The daemon runs as root. This thread does not, and its own user has no permissions.
    if uid == 0 || is_member {
        let name = match uid {
            0 => "root".to_owned(),
            uid => format!("user {uid}"),
        };
        return Ok(Caller::new(connection, Principal::admin(&name), Credential::User));
    }
    Err(Error::Foreign {
        what: format!("user {uid} may not use the daemon's socket"),
        next: "ask as root (sudo) or as a member of the group that admin_group names, or over TCP with --server"
            .to_owned(),
    })
}

/// Returns true if the route's access admits the request without a credential.
fn is_open(access: Access, method: &Method, uri: &Uri, headers: &HeaderMap) -> bool {
    let path = uri.path();
    match (access, is_upgrade(headers)) {
        (Access::Connect | Access::ReadOrConnect, true) => {
            *method == Method::GET && (path == "/" || is_service_path(path))
        }
        (Access::Code, false) => *method == Method::POST,
        (Access::Read | Access::ReadOrConnect, false) => {
            matches!(*method, Method::GET | Method::HEAD)
        }
        (Access::SignIn, false) => matches!(*method, Method::GET | Method::HEAD | Method::POST),
        _ => false,
    }
}

/// Returns true if the path has the form of a service's: `/NAME` or `/NAME/`.
fn is_service_path(path: &str) -> bool {
    let name = path.strip_prefix('/').unwrap_or_default();
    names::validate_service(name.strip_suffix('/').unwrap_or(name)).is_ok()
}

/// Returns the token of `Authorization`: `Bearer` everywhere and, at the registry, whose clients know nothing else,
/// also the password of `Basic`, whatever its user name. Browsers resend Basic credentials by themselves; the
/// registry is read-only.
fn authorization(uri: &Uri, headers: &HeaderMap) -> Option<String> {
    let (scheme, sent) = header_text(headers, header::AUTHORIZATION)?.split_once(' ')?;
    let sent = sent.trim();
    if scheme.eq_ignore_ascii_case("bearer") {
        return Some(sent.to_owned());
    }
    if scheme.eq_ignore_ascii_case("basic") && registry_clients::is_registry_path(uri.path()) {
        let pair = base64_simd::STANDARD.decode_to_vec(sent).ok()?;
        let (_, password) = std::str::from_utf8(&pair).ok()?.split_once(':')?;
        return Some(password.to_owned());
    }
    None
}

fn find_token(uri: &Uri, headers: &HeaderMap) -> Option<String> {
    let protocol = || {
        let token = protocols(headers).find_map(|protocol| protocol.strip_prefix(BEARER))?;
        Some(token.to_owned())
    };
    authorization(uri, headers).or_else(protocol).or_else(|| query_value(uri.query(), "token"))
}

#[cfg(test)]
mod tests;
