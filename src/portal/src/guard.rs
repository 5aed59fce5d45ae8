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

use std::borrow::Cow;
use std::fmt;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::sync::Arc;
use std::time::{Duration, Instant};

use access::{Action, Principal};
use axum::extract::{Request, State};
use axum::http::{HeaderMap, Method, Uri, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use catalogue::names;
use parking_lot::Mutex;
use tokio_rustls::rustls::pki_types::CertificateDer;

use crate::app::App;
use crate::errors::Error;
use crate::people::cookies;
use crate::principals::{Identity, Recognising, Shown, Uncertified};
use crate::routes::{self, Access};
use crate::tokens;

/// Shortest time between two log lines about the same refusal.
const AGAIN: Duration = Duration::from_secs(60);
/// Most different refusals that are logged within that time; their text is chosen by the client.
const DIFFERENT: usize = 32;

/// The other end of a connection.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Peer {
    /// An address.
    Tcp(SocketAddr),
    /// A user of this machine.
    Unix(User),
}

/// A user of this machine, by the kernel's word.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct User {
    /// The number.
    pub uid: u32,
    /// Whether the process was in the group whose members are admins when it connected.
    pub is_member: bool,
}

impl fmt::Display for Peer {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Peer::Tcp(address) => address.fmt(out),
            Peer::Unix(user) => write!(out, "user {}", user.uid),
        }
    }
}

impl Peer {
    /// Its address; users of this machine are at its own.
    pub fn ip(&self) -> IpAddr {
        match self {
            Peer::Tcp(address) => address.ip(),
            Peer::Unix(_) => Ipv4Addr::LOCALHOST.into(),
        }
    }

    /// The name of its memory budget: its IP address or, for connections from this machine (a proxy's), its robot's name.
    pub fn client(&self, robot: Option<&str>) -> String {
        match (self, robot) {
            (Peer::Tcp(address), _) if !address.ip().is_loopback() => address.ip().to_string(),
            (_, Some(robot)) => robot.to_owned(),
            (Peer::Tcp(address), None) => address.ip().to_string(),
            (Peer::Unix(user), None) => format!("user {}", user.uid),
        }
    }
}

/// What is known of a connection before its first request.
#[derive(Debug, Clone)]
pub struct Connection {
    /// The other end.
    pub peer: Peer,
    /// Whether nobody on the way can overhear or change what is sent: through TLS, or on this machine's own socket.
    pub secure: bool,
    /// Whether a proxy that the operator named asks for somebody else, whose address the peer is then.
    pub forwarded: bool,
    /// The certificates that the client has shown in TLS, its own first; none where it showed none.
    pub certificates: Arc<[CertificateDer<'static>]>,
}

impl Connection {
    /// One without TLS.
    pub fn plain(peer: Peer) -> Connection {
        Connection {
            peer,
            secure: matches!(peer, Peer::Unix(_)),
            forwarded: false,
            certificates: Arc::default(),
        }
    }
}

/// Who asks.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Caller {
    /// From where.
    pub peer: Peer,
    /// Whether nobody on the way can overhear or change what is sent.
    pub secure: bool,
    /// Whether a proxy that the operator named asks for it.
    pub forwarded: bool,
    /// Who. Nobody gets the page, `/healthz`, and a WebSocket on which it must first send `auth`.
    pub who: Identity,
}

impl Caller {
    /// Whether it has said who it is, where that is asked for.
    pub fn is_known(&self) -> bool {
        !self.who.principal.roles.is_empty()
    }

    pub(crate) fn new(connection: &Connection, principal: Principal, shown: Shown) -> Caller {
        let who = Identity {
            principal: Arc::new(principal),
            shown,
            token: None,
            owner: None,
        };
        Caller::by(connection, who)
    }

    fn by(connection: &Connection, who: Identity) -> Caller {
        Caller {
            peer: connection.peer,
            secure: connection.secure,
            forwarded: connection.forwarded,
            who,
        }
    }
}

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
                rules.check_origin(headers)?;
                check_part(headers)?;
                return Ok(Caller::by(&connection, certified?));
            }
        }
        rules.admit(&connection, request.method(), uri, headers)
    });
    match admitted {
        Ok(caller) => {
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
            error.into_response()
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
            check_direct(headers)?;
            self.check_host(headers)?;
            self.check_origin(headers)?;
            check_part(headers)?;
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

    fn check_host(&self, headers: &HeaderMap) -> Result<(), Error> {
        let host = header_text(headers, header::HOST).unwrap_or_default();
        if is_loopback_host(without_port(host)) {
            return Ok(());
        }
        Err(Error::Foreign {
            what: format!(
                "the request is addressed to {host:?}, but this portal serves this machine alone"
            ),
            next:
                "use 127.0.0.1 or localhost, or configure tokens, as a proxy in front of it needs"
                    .to_owned(),
        })
    }

    fn check_origin(&self, headers: &HeaderMap) -> Result<(), Error> {
        let Some(origin) = header_text(headers, header::ORIGIN) else {
            return Ok(());
        };
        let of_this_machine = origin.split_once("://").is_some_and(|(scheme, host)| {
            scheme.starts_with("http") && is_loopback_host(without_port(host))
        });
        if of_this_machine
            || self
                .origins
                .iter()
                .any(|allowed| allowed.trim_end_matches('/') == origin)
        {
            return Ok(());
        }
        Err(Error::Foreign {
            what: format!("a page of {origin} may not use this portal"),
            next: format!("if it should, add it to the configuration: origins = [{origin:?}]"),
        })
    }
}

/// Refuses what a page of another site loads as a part of itself (an image, a script, a frame): the browser keeps the answer
/// from the page, but tells it whether there was one, and so what there is here. Browsers say where a request comes from (Fetch
/// Metadata, W3C); those with an origin are decided by that, and a person who follows a link is answered.
pub fn check_part(headers: &HeaderMap) -> Result<(), Error> {
    let is = |name: &str, values: &[&str]| {
        let said = headers.get(name).and_then(|value| value.to_str().ok());
        said.is_some_and(|said| values.contains(&said))
    };
    let elsewhere = is("sec-fetch-site", &["cross-site", "same-site"]);
    let follows = is("sec-fetch-mode", &["navigate"]) && is("sec-fetch-dest", &["document"]);
    match elsewhere && !follows && !headers.contains_key(header::ORIGIN) {
        true => Err(Error::Foreign {
            what: "a page of another site may not have this portal's answers as parts of itself"
                .to_owned(),
            next: "open the address itself, or ask with a token (Authorization: Bearer TOKEN)"
                .to_owned(),
        }),
        false => Ok(()),
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

/// Headers that proxies add.
const FORWARDED: [&str; 6] = [
    "forwarded",
    "via",
    "x-forwarded-for",
    "x-forwarded-host",
    "x-forwarded-proto",
    "x-real-ip",
];

/// Refuses requests with a proxy's headers: their callers are on other machines, whatever `Host` says.
fn check_direct(headers: &HeaderMap) -> Result<(), Error> {
    match FORWARDED.iter().find(|name| headers.contains_key(**name)) {
        None => Ok(()),
        Some(name) => Err(Error::Foreign {
            what: format!(
                "a proxy passes this request on (its header {name} says so), and this portal has no tokens by which to \
                 tell who asks"
            ),
            next: "configure tokens, and send one: Authorization: Bearer TOKEN, or ?token=TOKEN"
                .to_owned(),
        }),
    }
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

fn token_in(uri: &Uri, headers: &HeaderMap) -> Option<String> {
    let bearer = header_text(headers, header::AUTHORIZATION).and_then(|value| {
        let (scheme, token) = value.split_once(' ')?;
        scheme
            .eq_ignore_ascii_case("bearer")
            .then(|| token.trim().to_owned())
    });
    let protocol = || {
        let token = protocols(headers).find_map(|protocol| protocol.strip_prefix(BEARER))?;
        Some(token.to_owned())
    };
    bearer
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

fn without_port(host: &str) -> &str {
    match host.rsplit_once(':') {
        Some((name, port))
            if port.bytes().all(|byte| byte.is_ascii_digit()) && !name.ends_with(':') =>
        {
            name
        }
        _ => host,
    }
}

fn is_loopback_host(host: &str) -> bool {
    let bare = host.trim_start_matches('[').trim_end_matches(']');
    host.eq_ignore_ascii_case("localhost")
        || bare
            .parse::<IpAddr>()
            .is_ok_and(|address| address.is_loopback())
}

#[cfg(test)]
mod tests {
    use access::Guesses;

    use super::*;
    use crate::principals::{Lasting, Stored};
    use crate::tokens::Tokens;

    struct Ask<'a> {
        rules: Rules<'a>,
        method: Method,
        headers: HeaderMap,
    }

    fn ask<'a>(rules: &Rules<'a>) -> Ask<'a> {
        Ask {
            rules: Rules { ..*rules },
            method: Method::GET,
            headers: HeaderMap::new(),
        }
        .with("host", "127.0.0.1:9090")
    }

    impl Ask<'_> {
        fn with(mut self, name: &'static str, value: &str) -> Self {
            self.headers
                .insert(name, value.parse().expect("a header value"));
            self
        }

        fn by(mut self, method: Method) -> Self {
            self.method = method;
            self
        }

        fn at(&self, uri: &str) -> Result<Caller, u16> {
            self.told(uri).map_err(|error| error.problem().status)
        }

        fn told(&self, uri: &str) -> Result<Caller, Error> {
            let peer = Peer::Tcp("127.0.0.1:5000".parse().expect("an address"));
            let uri = uri.parse().expect("a URI");
            let connection = Connection::plain(peer);
            self.rules
                .admit(&connection, &self.method, &uri, &self.headers)
        }
    }

    fn tokens() -> Tokens {
        Tokens::new(&["open sesame".to_owned()]).expect("a token")
    }

    #[test]
    fn on_loopback_nobody_needs_a_token() {
        let none = Tokens::default();
        let rules = Rules {
            loopback: true,
            known: Recognising {
                tokens: &none,
                stored: &Stored::default(),
                guesses: &Mutex::new(Guesses::default()),
                lasting: Lasting::default(),
            },
            origins: &[],
        };
        assert!(
            ask(&rules)
                .at("/api/v1/services")
                .expect("let through")
                .is_known()
        );
        for host in ["localhost", "localhost:9090", "[::1]:9090", "127.0.0.1"] {
            ask(&rules).with("host", host).at("/").expect(host);
        }
        for origin in [
            "http://localhost:8080",
            "http://127.0.0.1:9090",
            "https://[::1]:1",
        ] {
            ask(&rules).with("origin", origin).at("/").expect(origin);
        }
    }

    #[test]
    fn pages_from_elsewhere_cannot_use_a_portal_on_loopback() {
        let none = Tokens::default();
        let origins = ["https://tool.example".to_owned()];
        let rules = Rules {
            loopback: true,
            known: Recognising {
                tokens: &none,
                stored: &Stored::default(),
                guesses: &Mutex::new(Guesses::default()),
                lasting: Lasting::default(),
            },
            origins: &origins,
        };
        assert_eq!(
            ask(&rules)
                .with("host", "evil.example:9090")
                .at("/opencv_apps"),
            Err(403),
            "DNS rebinding"
        );
        for origin in [
            "https://evil.example",
            "null",
            "http://localhost.evil.example",
        ] {
            assert_eq!(
                ask(&rules).with("origin", origin).at("/opencv_apps"),
                Err(403),
                "{origin}"
            );
        }
        ask(&rules)
            .with("origin", "https://tool.example")
            .at("/opencv_apps")
            .expect("configured");
    }

    #[test]
    fn pages_from_elsewhere_have_no_answers_as_parts_of_themselves() {
        let none = Tokens::default();
        let rules = Rules {
            loopback: true,
            known: Recognising {
                tokens: &none,
                stored: &Stored::default(),
                guesses: &Mutex::new(Guesses::default()),
                lasting: Lasting::default(),
            },
            origins: &[],
        };
        let loads = |site: &str, mode: &str, dest: &str| {
            let ask = ask(&rules).with("sec-fetch-site", site);
            let ask = ask
                .with("sec-fetch-mode", mode)
                .with("sec-fetch-dest", dest);
            ask.at("/api/v1/services").map(|_| ())
        };
        for (site, mode, dest) in [
            ("cross-site", "no-cors", "image"),
            ("cross-site", "no-cors", "script"),
            ("cross-site", "no-cors", "empty"),
            ("cross-site", "navigate", "iframe"),
            ("cross-site", "navigate", "object"),
            ("same-site", "no-cors", "style"),
            ("same-site", "navigate", "frame"),
        ] {
            assert_eq!(loads(site, mode, dest), Err(403), "{site} {mode} {dest}");
        }
        for (site, mode, dest) in [
            ("same-origin", "cors", "empty"),
            ("same-origin", "no-cors", "image"),
            ("none", "navigate", "document"),
            ("cross-site", "navigate", "document"),
        ] {
            assert_eq!(loads(site, mode, dest), Ok(()), "{site} {mode} {dest}");
        }
        // By its origin it is decided whether a page of this machine may.
        let page = ask(&rules)
            .with("sec-fetch-site", "same-site")
            .with("origin", "http://localhost:8080");
        page.at("/opencv_apps").expect("a page of this machine");
    }

    #[test]
    fn an_origin_that_a_sandboxed_page_has_is_named_with_what_to_write() {
        let none = Tokens::default();
        let closed = Rules {
            loopback: true,
            known: Recognising {
                tokens: &none,
                stored: &Stored::default(),
                guesses: &Mutex::new(Guesses::default()),
                lasting: Lasting::default(),
            },
            origins: &[],
        };
        let refused = ask(&closed)
            .with("origin", "null")
            .told("/opencv_apps")
            .expect_err("nobody's page");
        let next = refused.problem().next.unwrap_or_default();
        assert!(next.contains(r#"origins = ["null"]"#), "{next}");
        let origins = ["null".to_owned()];
        let opened = Rules {
            origins: &origins,
            ..closed
        };
        ask(&opened)
            .with("origin", "null")
            .at("/opencv_apps")
            .expect("configured");
    }

    #[test]
    fn what_a_proxy_passes_on_needs_tokens() {
        let (none, some) = (Tokens::default(), tokens());
        let mut rules = Rules {
            loopback: true,
            known: Recognising {
                tokens: &none,
                stored: &Stored::default(),
                guesses: &Mutex::new(Guesses::default()),
                lasting: Lasting::default(),
            },
            origins: &[],
        };
        for (name, value) in [
            ("x-forwarded-proto", "https"),
            ("x-forwarded-for", "203.0.113.7"),
            ("forwarded", "for=203.0.113.7"),
            ("via", "1.1 proxy"),
        ] {
            // Its client may name whatever host it likes.
            let refused = ask(&rules).with("host", "localhost").with(name, value);
            assert_eq!(refused.at("/api/v1/services"), Err(403), "{name}");
        }
        rules.known.tokens = &some;
        ask(&rules)
            .with("x-forwarded-proto", "https")
            .at("/api/v1/services?token=open+sesame")
            .expect("a token says who asks");
    }

    #[test]
    fn without_configured_tokens_any_token_owns_robots_names() {
        let none = Tokens::default();
        let open = Rules {
            loopback: true,
            known: Recognising {
                tokens: &none,
                stored: &Stored::default(),
                guesses: &Mutex::new(Guesses::default()),
                lasting: Lasting::default(),
            },
            origins: &[],
        };
        let caller = ask(&open).at("/x?robot=r&token=mine").expect("let through");
        assert_eq!(caller.who.token, Some(tokens::hash("mine")));
    }

    #[test]
    fn configured_tokens_are_needed_on_loopback_as_beyond() {
        let some = tokens();
        for loopback in [true, false] {
            let rules = Rules {
                loopback,
                known: Recognising {
                    tokens: &some,
                    stored: &Stored::default(),
                    guesses: &Mutex::new(Guesses::default()),
                    lasting: Lasting::default(),
                },
                origins: &[],
            };
            let far = || ask(&rules).with("host", "localhost");
            for path in [
                "/api/v1/services",
                "/metrics",
                "/opencv_apps",
                "/stubs",
                "/v2/",
            ] {
                assert_eq!(far().at(path), Err(401), "{path}");
            }
            assert_eq!(far().at("/x?token=wrong"), Err(401));
            let bearer = |word: &str| far().with("authorization", &format!("Bearer {word}"));
            assert_eq!(bearer("wrong").at("/api/v1/services"), Err(401));
            for known in [
                bearer("open sesame").at("/api/v1/services"),
                far()
                    .with("origin", "https://far.example")
                    .at("/api/v1/services?token=open+sesame"),
                far()
                    .with("sec-websocket-protocol", "rosbridge, bearer.open sesame")
                    .at("/opencv_apps?token=wrong"),
            ] {
                let known = known.expect("a known token");
                assert_eq!(known.who.token, Some(tokens::hash("open sesame")));
                assert!(known.who.principal.is(access::Role::Admin));
            }
        }
    }

    #[test]
    fn without_a_token_only_the_page_health_and_handshakes_are_open() {
        let some = tokens();
        let rules = Rules {
            loopback: true,
            known: Recognising {
                tokens: &some,
                stored: &Stored::default(),
                guesses: &Mutex::new(Guesses::default()),
                lasting: Lasting::default(),
            },
            origins: &[],
        };
        let handshake = |method: Method| ask(&rules).by(method).with("upgrade", "WebSocket");
        for path in ["/", "/healthz", "/assets/portal.js"] {
            let caller = ask(&rules).at(path).expect(path);
            assert!(!caller.is_known(), "{path}");
            ask(&rules).by(Method::HEAD).at(path).expect(path);
            assert_eq!(ask(&rules).by(Method::POST).at(path), Err(401), "{path}");
        }
        // Who shows a pairing code is nobody until then.
        let caller = ask(&rules).by(Method::POST).at("/api/v1/pair");
        assert!(!caller.expect("may show a code").is_known());
        for method in [Method::GET, Method::HEAD, Method::PUT, Method::DELETE] {
            let refused = ask(&rules).by(method.clone()).at("/api/v1/pair");
            assert_eq!(refused, Err(401), "{method}");
        }
        assert_eq!(handshake(Method::POST).at("/api/v1/pair"), Err(401));
        assert_eq!(
            ask(&rules).by(Method::POST).at("/api/v1/renew"),
            Err(401),
            "needs its certificate"
        );
        for path in ["/", "/opencv_apps", "/opencv_apps/?robot=r1"] {
            let caller = handshake(Method::GET).at(path).expect("may send auth");
            assert!(!caller.is_known(), "{path}");
            for method in [Method::HEAD, Method::POST, Method::DELETE, Method::PATCH] {
                let refused = handshake(method.clone()).at(path);
                assert_eq!(refused, Err(401), "{method} {path}");
            }
        }
        for path in [
            "/api",
            "/api/",
            "/api/v1/services",
            "/metrics",
            "/metrics/",
            "/stubs",
            "/stubs/opencv_apps.tar.gz",
            "/v2",
            "/v2/",
            "/assets",
            "/assets/deep/er",
            "//opencv_apps",
            "/opencv_apps/more",
            "/opencv_apps//",
            "/%61pi",
        ] {
            assert_eq!(handshake(Method::GET).at(path), Err(401), "{path}");
        }
    }

    #[test]
    fn only_root_and_members_use_the_socket() {
        for (uid, is_member, admitted) in [
            (0, false, true),
            (1, false, false),
            (1, true, true),
            (privilege::DEFAULT_USER, false, false),
        ] {
            let user = User { uid, is_member };
            match admit_user(&Connection::plain(Peer::Unix(user)), user) {
                Ok(caller) => assert!(
                    admitted && caller.who.principal.is(access::Role::Admin),
                    "{uid}"
                ),
                Err(error) => assert!(!admitted && error.problem().status == 403, "{uid}: {error}"),
            }
        }
    }

    #[test]
    fn queries_are_decoded() {
        let uri: Uri = "/x?a=1&robot=r%2F1+b&bad=%zz".parse().expect("a URI");
        assert_eq!(query(uri.query(), "robot").as_deref(), Some("r/1 b"));
        assert_eq!(query(uri.query(), "bad").as_deref(), Some("%zz"));
        assert_eq!(query(uri.query(), "none"), None);
    }
}
