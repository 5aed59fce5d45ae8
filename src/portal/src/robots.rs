//! Robots: `ws://host:9090/<service>?robot=ID&token=…&resume=…`, and on which terms ([`api::sla`]): `&rrt=100ms&max_rrt=300ms`.
//!
//! Where tokens are configured, a client without one can only send `auth`: it gets no servant and no information before.

use std::pin::pin;
use std::sync::Arc;

use access::{Action, Standing};
use api::Stated;
use axum::Extension;
use axum::body::Body;
use axum::extract::{Path, Request, State};
use axum::http::{HeaderMap, HeaderValue, Method, StatusCode, Uri, header};
use axum::response::{IntoResponse, Response};
use bridge::{Granted, SessionEnd, SessionOptions, Waiting};
use bytes::BytesMut;
use catalogue::names;
use hyper::upgrade::{OnUpgrade, Upgraded};
use hyper_util::rt::TokioIo;
use reach::{Reach, Stream};
use tokio::io::{AsyncRead, AsyncReadExt};
use tokio::net::{TcpStream, UnixStream};
use tokio::sync::{mpsc, watch};
use tokio_rustls::server::TlsStream;

use super::guard::{self, Caller, Connection, Peer};
use super::{App, allowed, auth, handshake, page};
use crate::errors::Error;
use crate::principals::Identity;
use crate::tokens::{self, AuthMessage};
use choreographer::{Lease, ServantRequest};
use store::Owner;

/// Close code for "try again later" (RFC 6455 and its registry).
const TRY_AGAIN_LATER: u16 = 1013;
/// Close code for a policy that was violated.
const POLICY: u16 = 1008;
/// Why a client is sent away of whom nobody knows yet who it is.
const CROWDED: &str = "too many connect and do not say who they are; send the auth message sooner, or a token in the address";
/// Bytes that a robot's stub may send before its servant is there.
const STUB_AHEAD: usize = 64 * 1024;
/// Words about where a robot stands that may wait to be sent.
const NEWS: usize = 4;
/// Characters by which a robot is called that gave no name, which are shown: so many that nobody finds a resume token with the same ones
/// (128 bits of a hash).
const NAMELESS: usize = 32;
/// Bytes of a node's name.
const LONGEST_NODE: usize = 256;

/// `/`: the page, or the default service.
pub async fn root(
    State(app): State<Arc<App>>,
    Extension(caller): Extension<Caller>,
    request: Request,
) -> Response {
    if !guard::is_upgrade(request.headers()) {
        return page::index(request.method(), request.headers());
    }
    match app.options.default_service.clone() {
        Some(service) => connect(app, service, caller, request)
            .await
            .unwrap_or_else(IntoResponse::into_response),
        // What there is, is told to those who may ask.
        None if !caller.is_known() => Error::Unauthorised("a token is needed").into_response(),
        None => {
            let refusal = allowed::known_to(&app, &caller, "")
                .and_then(|()| Err(app.catalogue.unknown("")?.into()));
            refusal.map_or_else(IntoResponse::into_response, |()| {
                StatusCode::NOT_FOUND.into_response()
            })
        }
    }
}

/// `/<service>/`, as some clients write it: the same as without the slash.
pub async fn service_with_slash(
    app: State<Arc<App>>,
    service: Path<String>,
    caller: Extension<Caller>,
    request: Request,
) -> Response {
    if names::RESERVED.contains(&service.as_str()) {
        let path = request.uri().path().to_owned();
        return Error::UnknownPath { path }.into_response();
    }
    self::service(app, service, caller, request).await
}

/// `/<service>`: its servant, or an explanation.
pub async fn service(
    State(app): State<Arc<App>>,
    Path(service): Path<String>,
    Extension(caller): Extension<Caller>,
    request: Request,
) -> Response {
    let answer = if guard::is_upgrade(request.headers()) {
        connect(app, service, caller, request).await
    } else {
        explain(&app, &service, &caller, request.method())
    };
    answer.unwrap_or_else(IntoResponse::into_response)
}

/// What someone is told who opens a service's address in a browser.
fn explain(app: &App, service: &str, caller: &Caller, method: &Method) -> Result<Response, Error> {
    if !matches!(*method, Method::GET | Method::HEAD) {
        return Err(Error::BadRequest(format!(
            "{method} is not answered here; services are reached by WebSocket"
        )));
    }
    caller.may_at(app, Action::See, service, None)?;
    allowed::known_to(app, caller, service)?;
    let revision = app.catalogue.current(service)?;
    let answer = serde_json::json!({
        "service": service,
        "revision": revision.number,
        "address": app.address(service),
        "protocol": "rosbridge v2 over WebSocket",
        "next": "connect with any rosbridge client, such as roslibpy or roslibjs; ?robot=ID finds the same servant again",
        "interface": format!("/api/v1/services/{service}/interface"),
    });
    Ok((
        StatusCode::UPGRADE_REQUIRED,
        [(header::UPGRADE, "websocket")],
        axum::Json(answer),
    )
        .into_response())
}

/// What the address says about the robot.
struct RobotRequest {
    service: String,
    robot: Option<String>,
    /// The configured default robot, which is everybody's.
    shared: bool,
    resume: Option<String>,
    /// A robot's stub asks, in the link's protocol.
    link: bool,
    /// The node that the stub stands for; stubs of earlier versions do not say it here.
    node: String,
    /// On which terms.
    stated: Stated,
}

impl RobotRequest {
    fn read(app: &App, service: String, link: bool, uri: &Uri) -> Result<RobotRequest, Error> {
        let named = guard::query(uri.query(), "robot");
        let shared = named.is_none() && uri.path() == "/" && app.options.default_robot.is_some();
        let robot = if shared {
            app.options.default_robot.clone()
        } else {
            named
        };
        if let Some(robot) = &robot {
            names::robot(robot).map_err(catalogue::Error::from)?;
        }
        let node = guard::query(uri.query(), "node").unwrap_or_default();
        check_node(&node).map_err(Error::BadRequest)?;
        let stated = Stated::read(guard::pairs(uri.query()));
        Ok(RobotRequest {
            node,
            stated: stated.map_err(Error::Unstatable)?,
            link,
            service,
            robot,
            shared,
            resume: guard::query(uri.query(), "resume").filter(|token| !token.is_empty()),
        })
    }
}

/// Refuses what cannot name a node; it is kept with what its stub states, and shown.
fn check_node(node: &str) -> Result<(), String> {
    let is_name = |c: char| c.is_ascii_alphanumeric() || "_/".contains(c);
    match node.len() <= LONGEST_NODE && node.chars().all(is_name) {
        true => Ok(()),
        false => Err(format!(
            "node={:?} does not name a node; write letters, digits, _ and /, at most {LONGEST_NODE}",
            node.chars().take(LONGEST_NODE).collect::<String>()
        )),
    }
}

impl RobotRequest {
    /// Takes for granted what the caller's token says: who has one of a robot is that robot.
    fn by(&mut self, caller: &Caller) -> Result<(), Error> {
        if let Some(own) = &caller.who.principal.scope.robot
            && (self.robot.is_none() || self.shared)
        {
            (self.robot, self.shared) = (Some(own.clone()), false);
        }
        match self.link && self.robot.is_none() {
            true => Err(Error::BadRequest(
                "a link needs the robot's id: ?robot=ID".to_owned(),
            )),
            false => Ok(()),
        }
    }

    /// The robot's name, where it is its own.
    fn own_name(&self) -> Option<&str> {
        self.robot.as_deref().filter(|_| !self.shared)
    }

    /// The resume token, bound to the caller.
    fn bound_resume(&self, caller: &Caller) -> Option<String> {
        let token = self.resume.as_deref()?;
        Some(tokens::bound_to(caller.who.bound_by().as_deref(), token))
    }
}

async fn connect(
    app: Arc<App>,
    service: String,
    caller: Caller,
    mut request: Request,
) -> Result<Response, Error> {
    let accept = handshake::accept(&request)?;
    let link = asks_for_link(request.headers())?;
    let mut asked = RobotRequest::read(&app, service, link, request.uri())?;
    // A stub shows its token at once; without it nothing is told, not even what there is.
    if asked.link && !caller.is_known() {
        return Err(Error::Unauthorised("a link needs a token"));
    }
    if caller.is_known() {
        asked.by(&caller)?;
        let allowed = check(&app, &asked, &caller);
        note(&app, &asked, &caller, &allowed);
        allowed?;
    }
    // Who has yet to show a token is not told what there is, nor whether this is: the auth message comes first.
    if caller.is_known() && app.state.service_package(&asked.service)?.is_none() {
        return Err(app.catalogue.unknown(&asked.service)?.into());
    }
    // Who has not shown a token must be let in to show one. Where there is no room, a stub is told by the HTTP status; a robot
    // that speaks rosbridge alone is let in, and told by status messages where it stands, and why it is refused.
    let lease = if caller.is_known() {
        let lease = lease(&app, &asked, &caller)?;
        if asked.link {
            lease.admitted().await?;
            claim(&app, &asked, &caller)?;
        }
        Some(lease)
    } else {
        None
    };
    let Some(upgrade) = request.extensions_mut().remove::<OnUpgrade>() else {
        return Err(Error::BadRequest(
            "this connection cannot become a WebSocket".to_owned(),
        ));
    };
    let protocol = match asked.link {
        true => Some(link::SUBPROTOCOL),
        false => rosbridge_protocol(request.headers())?,
    };
    let sessions = app.sessions.clone();
    let connection = request.extensions_mut().remove::<Connection>();
    if let (Some(connection), Some(_)) = (&connection, &lease) {
        connection.admit();
    }
    sessions.spawn(async move {
        match upgrade.await {
            Ok(upgraded) => {
                let (io, read_ahead) = unwrapped(upgraded);
                session(app, asked, caller, lease, connection, io, read_ahead).await;
            }
            Err(error) => tracing::debug!("a connection was lost at its upgrade: {error}"),
        }
    });
    let mut response = Response::new(Body::empty());
    *response.status_mut() = StatusCode::SWITCHING_PROTOCOLS;
    let headers = response.headers_mut();
    headers.insert(header::CONNECTION, HeaderValue::from_static("Upgrade"));
    headers.insert(header::UPGRADE, HeaderValue::from_static("websocket"));
    headers.insert(header::SEC_WEBSOCKET_ACCEPT, accept);
    if let Some(protocol) = protocol {
        let protocol = HeaderValue::from_static(protocol);
        headers.insert(header::SEC_WEBSOCKET_PROTOCOL, protocol);
    }
    Ok(response)
}

/// Whether a robot's stub asks, in a version of the link's protocol that is spoken here.
fn asks_for_link(headers: &HeaderMap) -> Result<bool, Error> {
    let offered: Vec<&str> = guard::protocols(headers)
        .filter(|protocol| protocol.starts_with(link::SUBPROTOCOLS))
        .collect();
    match offered.as_slice() {
        [] => Ok(false),
        offered if offered.contains(&link::SUBPROTOCOL) => Ok(true),
        offered => Err(Error::BadRequest(format!(
            "the stub speaks {}, this server {}; install the stub again from /stubs, or the server's newer version",
            offered.join(", "),
            link::SUBPROTOCOL
        ))),
    }
}

/// The subprotocol to choose: a browser gives up where it offered some and none is chosen, and the one that is a token must not
/// be written into an answer.
pub fn rosbridge_protocol(headers: &HeaderMap) -> Result<Option<&'static str>, Error> {
    if guard::protocols(headers).any(|protocol| protocol == guard::ROSBRIDGE) {
        return Ok(Some(guard::ROSBRIDGE));
    }
    match guard::protocols(headers).any(|protocol| protocol.starts_with(guard::BEARER)) {
        false => Ok(None),
        true => Err(Error::BadRequest(format!(
            "a token alone is no subprotocol that can be chosen; offer {} before it",
            guard::ROSBRIDGE
        ))),
    }
}

/// The right to the servant that is asked for.
fn lease(app: &App, asked: &RobotRequest, caller: &Caller) -> Result<Lease, Error> {
    let (service, stated) = (&asked.service, asked.stated.clone());
    let request = match &asked.robot {
        None => {
            let (robot, anonymous) = nameless(asked.bound_resume(caller).as_deref());
            ServantRequest {
                anonymous,
                ..ServantRequest::new(service, &robot)
            }
        }
        Some(robot) => {
            let request = ServantRequest::new(service, robot);
            match asked.link {
                true => request.by_stub(&asked.node),
                false => request,
            }
        }
    };
    Ok(app.choreographer.ensure(request.stating(stated))?)
}

/// Whether the caller may be that robot at that service, on those terms.
fn check(app: &App, asked: &RobotRequest, caller: &Caller) -> Result<(), Error> {
    caller.may_at(app, Action::Connect, &asked.service, asked.robot.as_deref())?;
    if let Some(class) = &asked.stated.class {
        caller.may_use_class(class)?;
    }
    // A stub is given everything that its node uses.
    if asked.link
        && let Standing::Granted(grants) = app.principals.standing(&caller.who, &asked.service)
        && !grants.is_everything()
    {
        return Err(Error::Forbidden {
            what: format!(
                "a stub needs all of {}, and {} is granted {grants}",
                asked.service, caller.who.principal.name
            ),
        });
    }
    allowed::known_to(app, caller, &asked.service)?;
    match asked.own_name() {
        Some(robot) => check_owner(robot, app.state.owner_of_robot(robot)?, caller),
        None => Ok(()),
    }
}

/// Records that somebody connected, or was refused, aside: it does not wait for that.
fn note(app: &Arc<App>, asked: &RobotRequest, caller: &Caller, allowed: &Result<(), Error>) {
    let status = match allowed {
        Ok(()) => StatusCode::SWITCHING_PROTOCOLS.as_u16(),
        Err(error) => error.problem().status,
    };
    let did = match asked.link {
        true => "connected by a stub",
        false => "connected by rosbridge",
    };
    let object = match &asked.robot {
        Some(robot) => format!("service {} as robot {robot}", asked.service),
        None => format!("service {}", asked.service),
    };
    let (app, caller) = (Arc::clone(app), caller.clone());
    let sessions = app.sessions.clone();
    sessions.spawn_blocking(move || {
        app.audit
            .record_sparingly(&caller, Action::Connect, did, &object, status);
    });
}

/// Binds the robot's name to whoever uses it first. Not before there is room for it: who is refused leaves nothing behind.
fn claim(app: &App, asked: &RobotRequest, caller: &Caller) -> Result<(), Error> {
    let Some(robot) = asked.own_name() else {
        return Ok(());
    };
    // Where tokens are configured, a name used before there were any goes to the first who has one.
    let claim = !app.principals.names_nobody();
    let own = caller.who.owner.as_ref();
    let owner = app.state.robot_owner(robot, own, claim)?;
    check_owner(robot, owner, caller)
}

/// Nobody takes over another's robot.
fn check_owner(robot: &str, owner: Option<Owner>, caller: &Caller) -> Result<(), Error> {
    if owner.is_some() && owner != caller.who.owner {
        return Err(Error::RobotTaken(robot.to_owned()));
    }
    Ok(())
}

/// A name for a robot that gave none (one that no robot can give, so nobody takes it over), and whether nobody can come
/// back under it: who holds the resume token, here bound to who shows it, can.
fn nameless(resume: Option<&str>) -> (String, bool) {
    match resume {
        Some(bound) => (format!("~{}", &bound[..NAMELESS]), false),
        None => (format!("~{}", names::random(NAMELESS)), true),
    }
}

/// A connection behind its upgrade, and what was already read from it. Without hyper's wrapping around them, reads and writes go
/// straight to the socket.
pub fn unwrapped(upgraded: Upgraded) -> (Stream, bytes::Bytes) {
    match upgraded.downcast::<TokioIo<TcpStream>>() {
        Ok(parts) => (Box::new(parts.io.into_inner()), parts.read_buf),
        Err(upgraded) => match upgraded.downcast::<TokioIo<UnixStream>>() {
            Ok(parts) => (Box::new(parts.io.into_inner()), parts.read_buf),
            Err(upgraded) => match upgraded.downcast::<TokioIo<TlsStream<TcpStream>>>() {
                Ok(parts) => (Box::new(parts.io.into_inner()), parts.read_buf),
                Err(upgraded) => (Box::new(TokioIo::new(upgraded)), bytes::Bytes::new()),
            },
        },
    }
}

/// Who sends the first message of a connection, and what was read beyond it; else with which code it is closed, and why.
async fn recognise(
    app: &App,
    caller: &Caller,
    io: &mut Stream,
    read_ahead: bytes::Bytes,
) -> Result<(Identity, bytes::Bytes), (u16, String)> {
    let from = caller.peer.ip();
    let recognise = |message: &AuthMessage, now| app.principals.recognise_auth(message, from, now);
    let awaited = auth::first_message(io, read_ahead, recognise);
    match tokio::time::timeout(app.options.handshake, awaited).await {
        Ok(heard) => heard.map_err(|reason| (POLICY, reason)),
        Err(_) => Err((POLICY, "no auth message came; send a token".to_owned())),
    }
}

/// Comes back when newer connections of strangers need the place of this one.
async fn dropped(connection: Option<&Connection>) {
    match connection {
        Some(connection) => connection.dropped().await,
        None => std::future::pending().await,
    }
}

async fn session(
    app: Arc<App>,
    mut asked: RobotRequest,
    mut caller: Caller,
    lease: Option<Lease>,
    connection: Option<Connection>,
    mut io: Stream,
    mut read_ahead: bytes::Bytes,
) {
    if asked.link {
        return linked(&app, &asked, &caller, lease, io, read_ahead).await;
    }
    if lease.is_none() {
        let awaited = recognise(&app, &caller, &mut io, read_ahead);
        let recognised = tokio::select! {
            recognised = awaited => recognised,
            () = dropped(connection.as_ref()) => Err((TRY_AGAIN_LATER, CROWDED.to_owned())),
        };
        match recognised {
            Ok((who, rest)) => {
                read_ahead = rest;
                caller.who = who;
            }
            Err((code, reason)) => return bridge::refuse(io, code, &reason).await,
        }
    }
    if let Some(connection) = connection {
        connection.admit();
    }
    let allowed = asked
        .by(&caller)
        .and_then(|()| check(&app, &asked, &caller));
    if lease.is_none() {
        note(&app, &asked, &caller, &allowed);
    }
    if let Err(error) = allowed {
        return bridge::refuse(io, POLICY, &error.in_a_line()).await;
    }
    let memory = app.choreographer.memory();
    let budget = memory.client(&caller.peer.client(asked.robot.as_deref()));
    let mut waiting =
        Waiting::new(io, &read_ahead, app.choreographer.bridge_options()).within(&budget);
    let (news, told) = mpsc::channel(NEWS);
    let taking = servant(&app, &asked, &caller, lease, &news);
    let ended = app.principals.ended(&caller.who, &asked.service, false);
    let taken = tokio::select! {
        taken = waiting.until_told(taking, told) => taken,
        reason = ended => return waiting.refuse(POLICY, &reason).await,
    };
    let (lease, reach) = match taken {
        Ok(Ok(taken)) => taken,
        Ok(Err(error)) => return waiting.refuse(code(&error), &error.in_a_line()).await,
        // With its lease its place in the queue is given up, and the servant that only it could have used.
        Err(end) => {
            tracing::debug!("a robot left before {} was ready: {end:?}", asked.service);
            return;
        }
    };
    let client = match (&asked.robot, caller.peer) {
        (Some(robot), _) => robot.clone(),
        (None, Peer::Tcp(address)) => address.to_string(),
        (None, user) => user.to_string(),
    };
    let now = app.principals.standing(&caller.who, &asked.service);
    let (standing, granted) = watch::channel(now);
    let options = SessionOptions {
        budget,
        client,
        resume: asked.bound_resume(&caller),
        granted: Granted::by(granted).telling(refusals(&app, &asked, &caller)),
        ..SessionOptions::default()
    };
    let end = tokio::select! {
        end = reach.serve_rosbridge(waiting, options) => end,
        () = app.principals.follow(&caller.who, &asked.service, &standing) => return,
    };
    let handle = lease.handle();
    match end {
        SessionEnd::Client { code, .. } => {
            tracing::debug!("{} left servant {} (code {code})", handle.robot, handle.id);
        }
        SessionEnd::Closed { code, reason } => {
            tracing::info!(
                "closed the connection of {} to servant {} ({code}: {reason})",
                handle.robot,
                handle.id
            );
        }
        SessionEnd::Lost(reason) => {
            tracing::info!("lost {} at servant {}: {reason}", handle.robot, handle.id)
        }
    }
}

/// Records operations that were refused because nothing grants them.
fn refusals(
    app: &Arc<App>,
    asked: &RobotRequest,
    caller: &Caller,
) -> impl Fn(&str) + Send + Sync + 'static {
    let (app, caller, service) = (Arc::clone(app), caller.clone(), asked.service.clone());
    move |operation| {
        let did = format!("was refused {operation}");
        let object = format!("service {service}");
        let status = StatusCode::FORBIDDEN.as_u16();
        app.audit
            .record_sparingly(&caller, Action::Connect, &did, &object, status);
    }
}

/// With which code a robot's connection is closed that has no servant.
fn code(error: &Error) -> u16 {
    match error.is_final() {
        true => POLICY,
        false => TRY_AGAIN_LATER,
    }
}

/// The servant that is asked for, once it is ready, and its lease.
async fn servant(
    app: &App,
    asked: &RobotRequest,
    caller: &Caller,
    lease: Option<Lease>,
    news: &mpsc::Sender<String>,
) -> Result<(Lease, Arc<dyn Reach>), Error> {
    let lease = match lease {
        Some(lease) => lease,
        None => self::lease(app, asked, caller)?,
    };
    admitted(&lease, news).await?;
    claim(app, asked, caller)?;
    let reach = lease.ready().await?;
    Ok((lease, reach))
}

/// Waits until there is room, and tells where the robot stands meanwhile, whenever that changes.
async fn admitted(lease: &Lease, news: &mpsc::Sender<String>) -> Result<(), choreographer::Error> {
    let mut standing = lease.handle().watch_standing();
    let mut admitted = pin!(lease.admitted());
    loop {
        let stands = standing
            .borrow_and_update()
            .as_ref()
            .map(ToString::to_string);
        if let Some(stands) = stands {
            // One that does not read is told the next time.
            let _ = news.try_send(stands);
        }
        tokio::select! {
            biased;
            admitted = &mut admitted => return admitted,
            Ok(()) = standing.changed() => {}
        }
    }
}

/// A connection of a robot's stub.
async fn linked(
    app: &App,
    asked: &RobotRequest,
    caller: &Caller,
    lease: Option<Lease>,
    mut io: Stream,
    read_ahead: bytes::Bytes,
) {
    let Some(lease) = lease else {
        let error = Error::Internal("taking a servant");
        return bridge::refuse(io, TRY_AGAIN_LATER, &error.in_a_line()).await;
    };
    let mut read_ahead = BytesMut::from(read_ahead);
    let ready = tokio::select! {
        ready = lease.ready() => ready,
        reason = app.principals.ended(&caller.who, &asked.service, true) => {
            return bridge::refuse(io, POLICY, &reason).await;
        }
        () = left(&mut io, &mut read_ahead) => {
            tracing::debug!("a stub left before {} was ready", asked.service);
            return;
        }
    };
    let reach = match ready {
        Ok(reach) => reach,
        Err(error) => {
            let error = Error::from(error);
            return bridge::refuse(io, TRY_AGAIN_LATER, &error.in_a_line()).await;
        }
    };
    let robot = asked.robot.as_deref().unwrap_or_default();
    let lost = tokio::select! {
        lost = reach.serve_link(io, &read_ahead) => lost.to_string(),
        () = app.ending.cancelled() => "the daemon is ending".to_owned(),
        reason = app.principals.ended(&caller.who, &asked.service, true) => reason,
    };
    tracing::info!(
        "the link of {robot} to servant {} ended: {lost}",
        lease.handle().id
    );
}

/// Keeps what comes from a connection, as far as there is room for it; comes back when the connection has ended.
async fn left<S: AsyncRead + Unpin>(io: &mut S, kept: &mut BytesMut) {
    while kept.len() < STUB_AHEAD {
        if !matches!(io.read_buf(kept).await, Ok(1..)) {
            return;
        }
    }
    std::future::pending().await
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_cannot_name_a_node_is_refused() {
        let long = "/".to_owned() + &"n".repeat(LONGEST_NODE - 1);
        for node in ["", "/detector", "ns/node_2", "/_anonymous_1", &long] {
            assert_eq!(check_node(node), Ok(()), "{node}");
        }
        for node in ["/a b", "/a\nb", "<svg>", "/é", &(long + "n")] {
            let refused = check_node(node).expect_err(node);
            assert!(refused.len() < LONGEST_NODE + 200, "{refused}");
        }
    }

    #[test]
    fn a_token_among_the_subprotocols_is_never_chosen() {
        let offers = |text: &'static str| {
            let mut headers = HeaderMap::new();
            headers.insert(
                header::SEC_WEBSOCKET_PROTOCOL,
                HeaderValue::from_static(text),
            );
            rosbridge_protocol(&headers).map_err(|error| error.problem().detail)
        };
        assert_eq!(offers("rosbridge, bearer.secret"), Ok(Some("rosbridge")));
        assert_eq!(offers("bearer.secret,rosbridge"), Ok(Some("rosbridge")));
        assert_eq!(offers("something.else"), Ok(None));
        let refused = offers("bearer.secret").expect_err("a token alone");
        assert!(
            refused.contains("offer rosbridge") && !refused.contains("secret"),
            "{refused}"
        );
    }

    #[test]
    fn who_holds_the_resume_token_comes_back_to_the_same_servant() {
        let bound = |resume| tokens::bound_to(None, resume);
        let named = |resume| nameless(Some(&bound(resume)));
        assert_eq!(named("secret"), named("secret"));
        assert_ne!(named("secret"), named("other"));
        assert_ne!(nameless(None).0, nameless(None).0);
        assert!(
            names::robot(&named("secret").0).is_err(),
            "no robot can claim it"
        );
        for name in [named("secret").0, nameless(None).0] {
            assert!(name.len() > 32, "{name} can be found");
        }
    }
}
