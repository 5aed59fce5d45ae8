//! Looking into a servant: `ws://host:9090/api/v1/servants/ID/inside` speaks rosbridge beside the servant's robot.
//! Such a connection creates no servant, keeps none alive, and is not a session of the robot.
//!
//! | caller | permissions inside |
//! |---|---|
//! | may operate the service, or is the servant's robot | the operations that the policy grants |
//! | may otherwise see the servant | list and subscribe |

pub mod connections;

use std::sync::Arc;

use access::{AccessAction, AccessDenied, ConnectionAccess, Grants, Role};
use axum::Extension;
use axum::extract::{Path, Request, State};
use axum::http::StatusCode;
use axum::response::Response;
use bridge::{ClientGrants, SessionOptions, WaitingConnection};
use budget::Budget;
use bytes::Bytes;
use choreographer::Handle;
use hyper::upgrade::{OnUpgrade, Upgraded};
use reach::Reach;
use tokio::sync::watch;
use tracing::Instrument;

use crate::app::App;
use crate::caller::Caller;
use crate::errors::Error;
use crate::{handshake, robots};
use connections::InsideRole;

/// Target of a request for access: a robot's servants, or a recording of them.
#[derive(Debug, Clone, Copy)]
pub(crate) struct InsideTarget<'a> {
    pub service: &'a str,
    pub robot: &'a str,
    /// Description: servant or recording.
    pub object: std::fmt::Arguments<'a>,
}

/// Determines what the caller, who may see the service, may do inside a robot's servants. A robot has access where it
/// may act as that robot, and nowhere else.
pub(crate) fn inside_role(app: &App, caller: &Caller, whose: InsideTarget<'_>) -> Result<InsideRole, Error> {
    let principal = &caller.who.principal;
    let InsideTarget { service, robot, object } = whose;
    if caller.check_service_access(app, AccessAction::Operate, service, None).is_ok() {
        return Ok(InsideRole::Acts);
    }
    if !principal.has_role(Role::Robot) {
        return Ok(InsideRole::Looks);
    }
    let connects = caller.check_service_access(app, AccessAction::Connect, service, Some(robot));
    // The generated name of a nameless robot's servant is not revealed to others.
    let own = match principal.scope.robot.as_deref() {
        Some(own) => own == robot,
        None => principal.has_role(Role::Viewer) && (robot.starts_with('~') || is_robot_name_free(app, caller, robot)?),
    };
    match (connects, principal.has_role(Role::Viewer)) {
        (Ok(()), _) if own => Ok(InsideRole::Acts),
        (_, true) => Ok(InsideRole::Looks),
        _ => Err(AccessDenied::new(principal, AccessAction::See, object).into()),
    }
}

/// Returns the caller's current grants inside the target.
pub(crate) fn inside_grants(app: &App, caller: &Caller, whose: InsideTarget<'_>) -> Result<Arc<Grants>, Error> {
    let part = inside_role(app, caller, whose)?;
    let standing = app.principals.inside_access(&caller.who, whose.service, part);
    match standing {
        ConnectionAccess::Granted(grants) => Ok(grants),
        ConnectionAccess::Ended(reason) => Err(Error::Forbidden { what: reason }),
    }
}

/// Returns true if the robot's name has no owner, or the caller owns it.
fn is_robot_name_free(app: &App, caller: &Caller, robot: &str) -> Result<bool, Error> {
    let owner = app.state.find_robot_owner(robot)?;
    Ok(owner.is_none() || owner == caller.who.owner)
}

/// A connection that looks into a servant, after its WebSocket upgrade.
pub struct InsideSession {
    pub handle: Arc<Handle>,
    pub reach: Arc<dyn Reach>,
    /// Memory budget of all the caller's connections.
    pub budget: Budget,
    /// Current grants, updated as they change.
    pub granted: ClientGrants,
    pub caller: Caller,
}

/// Permission of a caller to look into a servant.
pub struct InsideAccess {
    app: Arc<App>,
    handle: Arc<Handle>,
    caller: Caller,
    part: InsideRole,
}

impl InsideAccess {
    /// Checks whether the caller may look into the servant with this id.
    pub fn authorise(app: &Arc<App>, id: &str, caller: Caller) -> Result<Self, Error> {
        let handle = app.choreographer.servant(id)?;
        let whose =
            InsideTarget { service: handle.service(), robot: &handle.robot, object: format_args!("servant {id}") };
        let part = inside_role(app, &caller, whose)?;
        Ok(Self { app: Arc::clone(app), handle, caller, part })
    }

    /// Upgrades to a WebSocket with this subprotocol, on which `serve` runs for as long as the caller has access.
    pub fn upgrade<Served: Future<Output = ()> + Send>(
        self,
        mut request: Request,
        protocol: Option<&'static str>,
        serve: impl FnOnce(InsideSession, reach::UpgradedStream, Bytes) -> Served + Send + 'static,
    ) -> Result<Response, Error> {
        let accept = handshake::accept(&request)?;
        let id = &self.handle.id;
        let Some(reach) = self.handle.reach() else {
            return Err(Error::NotThereYet(id.clone()));
        };
        let place = self.app.inside.acquire(id, &self.caller.who.principal.name)?;
        let Some(upgrade) = request.extensions_mut().remove::<OnUpgrade>() else {
            return Err(Error::BadRequest("this connection cannot become a WebSocket".to_owned()));
        };
        audit_recorder(&self.app, &self.caller, &self.handle)("looks inside");
        let sessions = self.app.sessions.clone();
        let span = self.handle.span(self.caller.connection_span().id());
        let serving = async move {
            match upgrade.await {
                Ok(upgraded) => self.run(upgraded, reach, serve).await,
                Err(error) => tracing::debug!("a connection was lost at its upgrade: {error}"),
            }
            drop(place);
        };
        sessions.spawn(serving.instrument(span));
        Ok(handshake::switch_protocols(accept, protocol))
    }

    async fn run<Served: Future<Output = ()>>(
        self,
        upgraded: Upgraded,
        reach: Arc<dyn Reach>,
        serve: impl FnOnce(InsideSession, reach::UpgradedStream, Bytes) -> Served,
    ) {
        let Self { app, handle, caller, part } = self;
        let (io, read_ahead) = robots::into_raw_stream(upgraded);
        let memory = app.choreographer.memory();
        let service = handle.service().to_owned();
        let (standing, granted) = watch::channel(app.principals.inside_access(&caller.who, &service, part));
        let refused = audit_recorder(&app, &caller, &handle);
        let used = audit_recorder(&app, &caller, &handle);
        let looker = InsideSession {
            handle,
            reach,
            budget: memory.client(&caller.peer.budget_name(None)),
            granted: ClientGrants::from_standing(granted)
                .with_refusal_observer(move |operation| refused(&format!("was refused {operation}")))
                .with_use_observer(move |operation| used(&format!("inside: {operation}"))),
            caller: caller.clone(),
        };
        tokio::select! {
            () = serve(looker, io, read_ahead) => {}
            () = app.principals.follow_inside_access(&caller.who, &service, part, &standing) => {}
        }
    }
}

/// Upgrades to a WebSocket that speaks rosbridge inside the servant.
pub async fn open_inside(
    State(app): State<Arc<App>>,
    Path(id): Path<String>,
    Extension(caller): Extension<Caller>,
    request: Request,
) -> Result<Response, Error> {
    let door = InsideAccess::authorise(&app, &id, caller)?;
    let protocol = robots::rosbridge_protocol(request.headers())?;
    let bridge = app.choreographer.bridge_options().clone();
    door.upgrade(request, protocol, async move |looker, io, read_ahead| {
        let waiting = WaitingConnection::new(io, &read_ahead, &bridge).with_budget(&looker.budget);
        let who = &looker.caller.who.principal;
        let options = SessionOptions {
            budget: looker.budget,
            client: who.name.clone(),
            granted: looker.granted,
            ..SessionOptions::default()
        };
        let end = looker.reach.serve_inside(waiting, options).await;
        let id = &looker.handle.id;
        tracing::debug!("{who} stopped looking into servant {id}: {end:?}");
    })
}

/// Returns a function that records what the caller does inside; repeated actions once a minute.
fn audit_recorder(app: &Arc<App>, caller: &Caller, handle: &Handle) -> impl Fn(&str) + Send + Sync + use<> {
    let (app, caller) = (Arc::clone(app), caller.clone());
    let object = format!("servant {} of robot {} at service {}", handle.id, handle.robot, handle.service());
    move |did| {
        let (action, status) = match did {
            "looks inside" => (AccessAction::See, StatusCode::SWITCHING_PROTOCOLS),
            did if did.starts_with("was refused") => (AccessAction::Operate, StatusCode::FORBIDDEN),
            _ => (AccessAction::Operate, StatusCode::OK),
        };
        app.audit.record_throttled(&caller, action, did, &object, status.as_u16());
    }
}
