//! Robots: `ws://host:9090/<service>?robot=ID&token=…&resume=…`, with requirements ([`api::sla`]) such as
//! `&rrt=100ms&max_rrt=300ms`.
//!
//! Where tokens are configured, a client without one can only send `auth`; before that it gets no servant and no
//! information.

use std::pin::pin;
use std::sync::Arc;

use access::{AccessAction, ConnectionAccess};
use api::Stated;
use axum::Extension;
use axum::extract::{Path, Request, State};
use axum::http::{HeaderMap, Method, StatusCode, Uri, header};
use axum::response::{IntoResponse, Response};
use bridge::{ClientGrants, SessionEnd, SessionOptions, WaitingConnection};
use bytes::BytesMut;
use catalogue::names;
use hyper::upgrade::{OnUpgrade, Upgraded};
use hyper_util::rt::TokioIo;
use reach::{Reach, UpgradedStream};
use tokio::io::{AsyncRead, AsyncReadExt};
use tokio::net::{TcpStream, UnixStream};
use tokio::sync::{mpsc, watch};
use tokio_rustls::server::TlsStream;
use tracing::{Instrument, Span};

use super::{App, auth, handshake, headers, page, query};
use crate::caller::{Caller, ConnectionPeer, PortalConnection};
use crate::errors::Error;
use crate::permissions::check_service_known;
use crate::principals::identity::CallerIdentity;
use crate::tokens::{self, AuthMessage};
use choreographer::{Lease, ServantRequest};
use store::Owner;

/// Close code for "try again later" (RFC 6455 and its registry).
const TRY_AGAIN_LATER: u16 = 1013;
/// Close code for a policy violation.
const POLICY: u16 = 1008;
/// Close reason for a client that was not authenticated in time.
const CROWDED_REASON: &str =
    "too many unauthenticated connections; send the auth message sooner, or a token in the address";
/// Bytes that a stub may send before its servant is ready.
const STUB_AHEAD: usize = 64 * 1024;
/// Queue size of messages about a waiting robot's position.
const NEWS: usize = 4;
/// Length of the generated name of a nameless robot: 128 bits of a hash, so that nobody finds another resume token
/// with the same name.
const NAMELESS: usize = 32;
/// Maximum length of a node's name in bytes.
const LONGEST_NODE: usize = 256;

/// `/`: the page, or the default service.
pub async fn root(State(app): State<Arc<App>>, Extension(caller): Extension<Caller>, request: Request) -> Response {
    if !headers::is_upgrade(request.headers()) {
        return page::index(request.method(), request.headers());
    }
    match app.options.default_service.clone() {
        Some(service) => connect(app, service, caller, request).await.unwrap_or_else(IntoResponse::into_response),
        // Only authorised callers learn which services exist.
        None if !caller.is_known() => Error::Unauthorised("a token is needed").into_response(),
        None => {
            let refusal =
                check_service_known(&app, &caller, "").and_then(|()| Err(app.catalogue.unknown_service("")?.into()));
            refusal.map_or_else(IntoResponse::into_response, |()| StatusCode::NOT_FOUND.into_response())
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
    if names::RESERVED_NAMES.contains(&service.as_str()) {
        let path = request.uri().path().to_owned();
        return Error::UnknownPath { path }.into_response();
    }
    self::service(app, service, caller, request).await
}

/// `/<service>`: the connection to its servant, or an explanation.
pub async fn service(
    State(app): State<Arc<App>>,
    Path(service): Path<String>,
    Extension(caller): Extension<Caller>,
    request: Request,
) -> Response {
    let answer = if headers::is_upgrade(request.headers()) {
        connect(app, service, caller, request).await
    } else {
        explain(&app, &service, &caller, request.method())
    };
    answer.unwrap_or_else(IntoResponse::into_response)
}

/// Explains the service to somebody who opens its address in a browser.
fn explain(app: &App, service: &str, caller: &Caller, method: &Method) -> Result<Response, Error> {
    if !matches!(*method, Method::GET | Method::HEAD) {
        return Err(Error::BadRequest(format!("{method} is not supported here; connect to services by WebSocket")));
    }
    caller.check_service_access(app, AccessAction::See, service, None)?;
    check_service_known(app, caller, service)?;
    let revision = app.catalogue.current_revision(service)?;
    let answer = serde_json::json!({
        "service": service,
        "revision": revision.number,
        "address": app.address(service),
        "protocol": "rosbridge v2 over WebSocket",
        "next": "connect with any rosbridge client, such as roslibpy or roslibjs; ?robot=ID finds the same servant \
                 again",
        "interface": format!("/api/v1/services/{service}/interface"),
    });
    Ok((StatusCode::UPGRADE_REQUIRED, [(header::UPGRADE, "websocket")], axum::Json(answer)).into_response())
}

/// A robot's request, as given by the URL.
struct RobotRequest {
    service: String,
    robot: Option<String>,
    /// True for the configured default robot, which everybody shares.
    shared: bool,
    resume: Option<String>,
    /// True if a robot's stub asks, in the link protocol.
    link: bool,
    /// Node that the stub represents; stubs of earlier versions do not send it here.
    node: String,
    /// Stated requirements.
    stated: Stated,
}

impl RobotRequest {
    fn parse(app: &App, service: String, link: bool, uri: &Uri) -> Result<RobotRequest, Error> {
        let named = query::query_value(uri.query(), "robot");
        let shared = named.is_none() && uri.path() == "/" && app.options.default_robot.is_some();
        let robot = if shared { app.options.default_robot.clone() } else { named };
        if let Some(robot) = &robot {
            names::validate_robot(robot).map_err(catalogue::Error::from)?;
        }
        let node = query::query_value(uri.query(), "node").unwrap_or_default();
        check_node(&node)?;
        let stated = Stated::read(query::query_pairs(uri.query()));
        Ok(RobotRequest {
            node,
            stated: stated.map_err(Error::Unstatable)?,
            link,
            service,
            robot,
            shared,
            resume: query::query_value(uri.query(), "resume").filter(|token| !token.is_empty()),
        })
    }
}

/// Checks the name of a node; it is stored with the stub's requirements and displayed.
fn check_node(node: &str) -> Result<(), Error> {
    let is_name = |c: char| c.is_ascii_alphanumeric() || "_/".contains(c);
    if node.len() <= LONGEST_NODE && node.chars().all(is_name) {
        Ok(())
    } else {
        Err(Error::BadRequest(format!(
            "node={:?} does not name a node; write letters, digits, _ and /, at most {LONGEST_NODE}",
            node.chars().take(LONGEST_NODE).collect::<String>()
        )))
    }
}

impl RobotRequest {
    /// Applies the caller's token: the holder of a robot's token is that robot.
    fn apply_identity(&mut self, caller: &Caller) -> Result<(), Error> {
        if let Some(own) = &caller.who.principal.scope.robot
            && (self.robot.is_none() || self.shared)
        {
            (self.robot, self.shared) = (Some(own.clone()), false);
        }
        if self.link && self.robot.is_none() {
            Err(Error::BadRequest("a link needs the robot's id: ?robot=ID".to_owned()))
        } else {
            Ok(())
        }
    }

    /// Returns the robot's name if it belongs to one robot.
    fn own_name(&self) -> Option<&str> {
        self.robot.as_deref().filter(|_| !self.shared)
    }

    /// Returns the resume token, bound to the caller.
    fn bound_resume(&self, caller: &Caller) -> Option<String> {
        let token = self.resume.as_deref()?;
        Some(tokens::bind_resume_token(caller.who.resume_binding().as_deref(), token))
    }
}

async fn connect(app: Arc<App>, service: String, caller: Caller, mut request: Request) -> Result<Response, Error> {
    let accept = handshake::accept(&request)?;
    let link = asks_for_link(request.headers())?;
    let mut asked = RobotRequest::parse(&app, service, link, request.uri())?;
    // A stub must send its token with the handshake; without one it learns nothing, not even which services exist.
    if asked.link && !caller.is_known() {
        return Err(Error::Unauthorised("a link needs a token"));
    }
    if caller.is_known() {
        asked.apply_identity(&caller)?;
        let allowed = check_access(&app, &asked, &caller);
        audit_connect(&app, &asked, &caller, &allowed);
        allowed?;
    }
    // An unauthenticated caller must not learn whether the service exists: the auth message comes first.
    if caller.is_known() && app.state.service_package(&asked.service)?.is_none() {
        return Err(app.catalogue.unknown_service(&asked.service)?.into());
    }
    // An unauthenticated caller must be let in to authenticate. If there is no room, a stub is refused by the HTTP
    // status; a robot that only speaks rosbridge is let in and learns its position, and the reason of a refusal, from
    // status messages.
    let lease = if caller.is_known() {
        let lease = request_lease(&app, &asked, &caller)?;
        if asked.link {
            lease.wait_admitted().await?;
            claim_robot_name(&app, &asked, &caller)?;
        }
        Some(lease)
    } else {
        None
    };
    let Some(upgrade) = request.extensions_mut().remove::<OnUpgrade>() else {
        return Err(Error::BadRequest("this connection cannot become a WebSocket".to_owned()));
    };
    let protocol = if asked.link { Some(link::SUBPROTOCOL) } else { rosbridge_protocol(request.headers())? };
    let sessions = app.sessions.clone();
    let connection = request.extensions_mut().remove::<PortalConnection>();
    if let (Some(connection), Some(_)) = (&connection, &lease) {
        connection.admit();
    }
    let span = caller.connection_span();
    let serving = async move {
        match upgrade.await {
            Ok(upgraded) => {
                let (io, read_ahead) = into_raw_stream(upgraded);
                serve_session(app, asked, caller, lease, connection, io, read_ahead).await;
            }
            Err(error) => tracing::debug!("a connection was lost at its upgrade: {error}"),
        }
    };
    sessions.spawn(serving.instrument(span));
    Ok(handshake::switch_protocols(accept, protocol))
}

/// Returns true if a robot's stub asks in a version of the link protocol that is supported here.
fn asks_for_link(headers: &HeaderMap) -> Result<bool, Error> {
    let offered: Vec<&str> =
        headers::protocols(headers).filter(|protocol| protocol.starts_with(link::SUBPROTOCOLS)).collect();
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

/// Returns the subprotocol to select. A browser gives up if it offered some and none is selected; one that is a token
/// must not be written into a response.
pub fn rosbridge_protocol(headers: &HeaderMap) -> Result<Option<&'static str>, Error> {
    if headers::protocols(headers).any(|protocol| protocol == headers::ROSBRIDGE) {
        return Ok(Some(headers::ROSBRIDGE));
    }
    if headers::protocols(headers).any(|protocol| protocol.starts_with(headers::BEARER)) {
        Err(Error::BadRequest(format!(
            "a token alone cannot be chosen as the subprotocol; offer {} before it",
            headers::ROSBRIDGE
        )))
    } else {
        Ok(None)
    }
}

/// Requests a lease on the servant.
fn request_lease(app: &App, asked: &RobotRequest, caller: &Caller) -> Result<Lease, Error> {
    let (service, stated) = (&asked.service, asked.stated.clone());
    let request = match &asked.robot {
        None => {
            let (robot, anonymous) = generated_name(asked.bound_resume(caller).as_deref());
            ServantRequest { anonymous, ..ServantRequest::new(service, &robot) }
        }
        Some(robot) => {
            let request = ServantRequest::new(service, robot);
            if asked.link { request.with_stub(&asked.node) } else { request }
        }
    };
    Ok(app.choreographer.ensure(request.with_stated(stated))?)
}

/// Checks whether the caller may act as that robot at that service, with those requirements.
fn check_access(app: &App, asked: &RobotRequest, caller: &Caller) -> Result<(), Error> {
    caller.check_service_access(app, AccessAction::Connect, &asked.service, asked.robot.as_deref())?;
    if let Some(class) = &asked.stated.class {
        caller.check_class(class)?;
    }
    // A stub is given access to everything that its node uses.
    if asked.link
        && let ConnectionAccess::Granted(grants) = app.principals.connection_access(&caller.who, &asked.service)
        && !grants.is_everything()
    {
        return Err(Error::Forbidden {
            what: format!(
                "a stub needs all of {}, but {} is granted only {grants}",
                asked.service, caller.who.principal.name
            ),
        });
    }
    check_service_known(app, caller, &asked.service)?;
    match asked.own_name() {
        Some(robot) => check_owner(robot, app.state.find_robot_owner(robot)?, caller),
        None => Ok(()),
    }
}

/// Records in the audit log that somebody connected or was refused. Runs in the background, because it waits for the
/// disk.
fn audit_connect(app: &Arc<App>, asked: &RobotRequest, caller: &Caller, allowed: &Result<(), Error>) {
    let status = match allowed {
        Ok(()) => StatusCode::SWITCHING_PROTOCOLS.as_u16(),
        Err(error) => error.problem().status,
    };
    let did = if asked.link { "connected by a stub" } else { "connected by rosbridge" };
    let object = match &asked.robot {
        Some(robot) => format!("service {} as robot {robot}", asked.service),
        None => format!("service {}", asked.service),
    };
    let (app, caller) = (Arc::clone(app), caller.clone());
    let sessions = app.sessions.clone();
    sessions.spawn_blocking(move || {
        app.audit.record_throttled(&caller, AccessAction::Connect, did, &object, status);
    });
}

/// Binds the robot's name to its first user. Not before there is room, so that a refused robot leaves nothing behind.
fn claim_robot_name(app: &App, asked: &RobotRequest, caller: &Caller) -> Result<(), Error> {
    let Some(robot) = asked.own_name() else {
        return Ok(());
    };
    // Where tokens are configured, a name used before there were any goes to the first caller with a token.
    let claim = !app.principals.has_no_credentials();
    let own = caller.who.owner.as_ref();
    let owner = app.state.claim_robot(robot, own, claim)?;
    check_owner(robot, owner, caller)
}

/// Refuses a robot's name that belongs to somebody else.
fn check_owner(robot: &str, owner: Option<Owner>, caller: &Caller) -> Result<(), Error> {
    if owner.is_some() && owner != caller.who.owner {
        return Err(Error::RobotTaken(robot.to_owned()));
    }
    Ok(())
}

/// Returns a name for a nameless robot (one that no robot can claim, so that nobody can take it over) and whether the
/// name is unique to this connection. It is not with a resume token, here bound to its holder, who can return under
/// the same name.
fn generated_name(resume: Option<&str>) -> (String, bool) {
    match resume {
        Some(bound) => (format!("~{}", &bound[..NAMELESS]), false),
        None => (format!("~{}", names::random(NAMELESS)), true),
    }
}

/// Returns the upgraded connection and the bytes already read from it. Without hyper's wrappers, reads and writes go
/// straight to the socket.
pub fn into_raw_stream(upgraded: Upgraded) -> (UpgradedStream, bytes::Bytes) {
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

/// Authenticates the sender of the first message; returns the bytes read beyond it, or the close code and reason.
async fn recognise(
    app: &App,
    caller: &Caller,
    io: &mut UpgradedStream,
    read_ahead: bytes::Bytes,
) -> Result<(CallerIdentity, bytes::Bytes), (u16, String)> {
    let from = caller.peer.ip();
    let recognise = |message: &AuthMessage, now| app.principals.recognise_auth(message, from, now);
    let awaited = auth::read_auth_message(io, read_ahead, recognise);
    match tokio::time::timeout(app.options.handshake, awaited).await {
        Ok(heard) => heard.map_err(|error| (POLICY, error.to_string())),
        Err(_) => Err((POLICY, "no auth message received; send a token".to_owned())),
    }
}

/// Waits until this connection must make way for newer unauthenticated ones.
async fn wait_until_dropped(connection: Option<&PortalConnection>) {
    match connection {
        Some(connection) => connection.wait_until_dropped().await,
        None => std::future::pending().await,
    }
}

async fn serve_session(
    app: Arc<App>,
    mut asked: RobotRequest,
    mut caller: Caller,
    lease: Option<Lease>,
    connection: Option<PortalConnection>,
    mut io: UpgradedStream,
    mut read_ahead: bytes::Bytes,
) {
    if asked.link {
        return serve_stub(&app, &asked, &caller, lease, io, read_ahead).await;
    }
    if lease.is_none() {
        let awaited = recognise(&app, &caller, &mut io, read_ahead);
        let recognised = tokio::select! {
            recognised = awaited => recognised,
            () = wait_until_dropped(connection.as_ref()) => Err((TRY_AGAIN_LATER, CROWDED_REASON.to_owned())),
        };
        match recognised {
            Ok((who, rest)) => {
                read_ahead = rest;
                caller.who = who;
                Span::current().record("principal", &*caller.who.principal.name);
            }
            Err((code, reason)) => return bridge::refuse(io, code, &reason).await,
        }
    }
    if let Some(connection) = connection {
        connection.admit();
    }
    let allowed = asked.apply_identity(&caller).and_then(|()| check_access(&app, &asked, &caller));
    if lease.is_none() {
        audit_connect(&app, &asked, &caller, &allowed);
    }
    if let Err(error) = allowed {
        return bridge::refuse(io, POLICY, &error.one_line()).await;
    }
    let memory = app.choreographer.memory();
    let budget = memory.client(&caller.peer.budget_name(asked.robot.as_deref()));
    let mut waiting = WaitingConnection::new(io, &read_ahead, app.choreographer.bridge_options()).with_budget(&budget);
    let (news, told) = mpsc::channel(NEWS);
    let taking = wait_for_servant(&app, &asked, &caller, lease, &news);
    let ended = app.principals.wait_for_end(&caller.who, &asked.service, false);
    let taken = tokio::select! {
        taken = waiting.wait_for_with_news(taking, told) => taken,
        reason = ended => return waiting.refuse(POLICY, &reason).await,
    };
    let (lease, reach) = match taken {
        Ok(Ok(taken)) => taken,
        Ok(Err(error)) => return waiting.refuse(close_code(&error), &error.one_line()).await,
        // Dropping the lease gives up its place in the queue and a servant that only it could have used.
        Err(end) => {
            tracing::debug!("a robot left before {} was ready: {end:?}", asked.service);
            return;
        }
    };
    let client = match (&asked.robot, caller.peer) {
        (Some(robot), _) => robot.clone(),
        (None, ConnectionPeer::Tcp(address)) => address.to_string(),
        (None, user) => user.to_string(),
    };
    let now = app.principals.connection_access(&caller.who, &asked.service);
    let (standing, granted) = watch::channel(now);
    let options = SessionOptions {
        budget,
        client,
        resume: asked.bound_resume(&caller),
        granted: ClientGrants::from_standing(granted).with_refusal_observer(audit_refusal(&app, &asked, &caller)),
        ..SessionOptions::default()
    };
    let handle = lease.handle();
    let span = handle.span(Span::current().id());
    let end = tokio::select! {
        end = reach.serve_rosbridge(waiting, options).instrument(span) => end,
        () = app.principals.follow_access(&caller.who, &asked.service, &standing) => return,
    };
    match end {
        SessionEnd::Client { code, .. } => {
            tracing::debug!("{} left servant {} (code {code})", handle.robot, handle.id);
        }
        SessionEnd::Closed { code, reason } => {
            tracing::info!("closed the connection of {} to servant {} ({code}: {reason})", handle.robot, handle.id);
        }
        SessionEnd::Lost(reason) => {
            tracing::info!("lost {} at servant {}: {reason}", handle.robot, handle.id)
        }
    }
}

/// Returns a function that records operations refused for lack of a grant.
fn audit_refusal(app: &Arc<App>, asked: &RobotRequest, caller: &Caller) -> impl Fn(&str) + Send + Sync + 'static {
    let (app, caller, service) = (Arc::clone(app), caller.clone(), asked.service.clone());
    move |operation| {
        let did = format!("was refused {operation}");
        let object = format!("service {service}");
        let status = StatusCode::FORBIDDEN.as_u16();
        app.audit.record_throttled(&caller, AccessAction::Connect, &did, &object, status);
    }
}

/// Returns the close code for a robot that gets no servant.
fn close_code(error: &Error) -> u16 {
    if error.is_final() { POLICY } else { TRY_AGAIN_LATER }
}

/// Returns the requested servant once it is ready, and its lease.
async fn wait_for_servant(
    app: &App,
    asked: &RobotRequest,
    caller: &Caller,
    lease: Option<Lease>,
    news: &mpsc::Sender<String>,
) -> Result<(Lease, Arc<dyn Reach>), Error> {
    let lease = match lease {
        Some(lease) => lease,
        None => self::request_lease(app, asked, caller)?,
    };
    wait_for_admission(&lease, news).await?;
    claim_robot_name(app, asked, caller)?;
    let reach = lease.wait_ready().await?;
    Ok((lease, reach))
}

/// Waits for admission and reports the robot's position whenever it changes.
async fn wait_for_admission(lease: &Lease, news: &mpsc::Sender<String>) -> Result<(), choreographer::Error> {
    let mut standing = lease.handle().watch_standing();
    let mut admitted = pin!(lease.wait_admitted());
    loop {
        let stands = standing.borrow_and_update().as_ref().map(ToString::to_string);
        if let Some(stands) = stands {
            // A robot that does not read gets the next report.
            let _ = news.try_send(stands);
        }
        tokio::select! {
            biased;
            admitted = &mut admitted => return admitted,
            Ok(()) = standing.changed() => {}
        }
    }
}

/// Serves a connection of a robot's stub.
async fn serve_stub(
    app: &App,
    asked: &RobotRequest,
    caller: &Caller,
    lease: Option<Lease>,
    mut io: UpgradedStream,
    read_ahead: bytes::Bytes,
) {
    let Some(lease) = lease else {
        let error = Error::Internal("taking a servant");
        return bridge::refuse(io, TRY_AGAIN_LATER, &error.one_line()).await;
    };
    let mut read_ahead = BytesMut::from(read_ahead);
    let ready = tokio::select! {
        ready = lease.wait_ready() => ready,
        reason = app.principals.wait_for_end(&caller.who, &asked.service, true) => {
            return bridge::refuse(io, POLICY, &reason).await;
        }
        () = wait_for_close(&mut io, &mut read_ahead) => {
            tracing::debug!("a stub left before {} was ready", asked.service);
            return;
        }
    };
    let reach = match ready {
        Ok(reach) => reach,
        Err(error) => {
            let error = Error::from(error);
            return bridge::refuse(io, TRY_AGAIN_LATER, &error.one_line()).await;
        }
    };
    let (robot, node) = (asked.robot.as_deref().unwrap_or_default(), &*asked.node);
    let servant = lease.handle().span(Span::current().id());
    let span = tracing::error_span!(parent: &servant, "link", robot, node);
    let end = Box::pin(app.principals.wait_for_end(&caller.who, &asked.service, true));
    let lost = tokio::select! {
        lost = reach.serve_link(io, &read_ahead, end).instrument(span) => lost,
        () = app.ending.cancelled() => "the daemon is ending".to_owned(),
    };
    tracing::info!("the link of {robot} to servant {} ended: {lost}", lease.handle().id);
}

/// Buffers what the connection sends, up to a limit; returns when the connection has ended.
async fn wait_for_close<S: AsyncRead + Unpin>(io: &mut S, kept: &mut BytesMut) {
    while kept.len() < STUB_AHEAD {
        if !matches!(io.read_buf(kept).await, Ok(1..)) {
            return;
        }
    }
    std::future::pending().await
}

#[cfg(test)]
mod tests {
    use axum::http::HeaderValue;

    use super::*;

    #[test]
    fn what_cannot_name_a_node_is_refused() {
        let long = "/".to_owned() + &"n".repeat(LONGEST_NODE - 1);
        for node in ["", "/detector", "ns/node_2", "/_anonymous_1", &long] {
            check_node(node).expect(node);
        }
        for node in ["/a b", "/a\nb", "<svg>", "/é", &(long + "n")] {
            let refused = check_node(node).expect_err(node).to_string();
            assert!(refused.len() < LONGEST_NODE + 200, "{refused}");
        }
    }

    #[test]
    fn a_token_among_the_subprotocols_is_never_chosen() {
        let offers = |text: &'static str| {
            let mut headers = HeaderMap::new();
            headers.insert(header::SEC_WEBSOCKET_PROTOCOL, HeaderValue::from_static(text));
            rosbridge_protocol(&headers).map_err(|error| error.problem().detail)
        };
        assert_eq!(offers("rosbridge, bearer.secret"), Ok(Some("rosbridge")));
        assert_eq!(offers("bearer.secret,rosbridge"), Ok(Some("rosbridge")));
        assert_eq!(offers("something.else"), Ok(None));
        let refused = offers("bearer.secret").expect_err("a token alone");
        assert!(refused.contains("offer rosbridge") && !refused.contains("secret"), "{refused}");
    }

    #[test]
    fn who_holds_the_resume_token_comes_back_to_the_same_servant() {
        let bound = |resume| tokens::bind_resume_token(None, resume);
        let named = |resume| generated_name(Some(&bound(resume)));
        assert_eq!(named("secret"), named("secret"));
        assert_ne!(named("secret"), named("other"));
        assert_ne!(generated_name(None).0, generated_name(None).0);
        assert!(names::validate_robot(&named("secret").0).is_err(), "no robot can claim it");
        for name in [named("secret").0, generated_name(None).0] {
            assert!(name.len() > 32, "{name} can be found");
        }
    }
}
