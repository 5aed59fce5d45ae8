//! People look into a servant: `ws://host:9090/api/v1/servants/ID/inside` speaks rosbridge beside the servant's robot. It makes no
//! servant, keeps none alive, and is no session of the robot.
//!
//! | who | what it may there |
//! |---|---|
//! | may operate the service, or is the servant's robot | what the policy grants it |
//! | sees the servant otherwise | list and subscribe |

use std::collections::HashMap;
use std::sync::Arc;

use access::{Action, Grants, Refusal, Role, Standing};
use axum::Extension;
use axum::body::Body;
use axum::extract::{Path, Request, State};
use axum::http::{HeaderValue, StatusCode, header};
use axum::response::Response;
use bridge::{Granted, SessionOptions, Waiting};
use budget::Budget;
use bytes::Bytes;
use choreographer::Handle;
use hyper::upgrade::{OnUpgrade, Upgraded};
use parking_lot::Mutex;
use reach::Reach;
use tokio::sync::watch;

use crate::app::App;
use crate::errors::Error;
use crate::guard::Caller;
use crate::{handshake, robots};

/// Who may look into one servant at once, all together.
const MOST: usize = 16;
/// Of these, connections of one principal: nobody keeps all others out.
const MOST_EACH: usize = 4;

/// Who looks into which servant.
#[derive(Debug, Default)]
pub struct Lookers {
    /// Names of principals, by servant.
    all: Arc<Mutex<HashMap<String, Vec<String>>>>,
}

/// One connection of those that a servant may have.
#[derive(Debug)]
pub struct Place {
    all: Arc<Mutex<HashMap<String, Vec<String>>>>,
    servant: String,
    who: String,
}

impl Lookers {
    pub(crate) fn place(&self, servant: &str, who: &str) -> Result<Place, Error> {
        let mut all = self.all.lock();
        let there = all.entry(servant.to_owned()).or_default();
        let own = there.iter().filter(|other| *other == who).count();
        if there.len() >= MOST || own >= MOST_EACH {
            return Err(Error::TooManyLook {
                servant: servant.to_owned(),
                most: MOST,
                each: MOST_EACH,
            });
        }
        there.push(who.to_owned());
        Ok(Place {
            all: Arc::clone(&self.all),
            servant: servant.to_owned(),
            who: who.to_owned(),
        })
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        let mut all = self.all.lock();
        let Some(there) = all.get_mut(&self.servant) else {
            return;
        };
        if let Some(at) = there.iter().position(|other| *other == self.who) {
            there.swap_remove(at);
        }
        if there.is_empty() {
            all.remove(&self.servant);
        }
    }
}

/// What somebody may do inside.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Part {
    /// What the policy grants.
    Acts,
    /// Listening alone.
    Looks,
}

/// Whose servants are looked into, or what is kept of them.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Whose<'a> {
    pub service: &'a str,
    pub robot: &'a str,
    /// In words: servant, or recording.
    pub object: std::fmt::Arguments<'a>,
}

/// What the caller, who sees the service, may do inside a robot's servants there. A robot is let in where it may be that robot, and nowhere
/// else.
pub(crate) fn part(app: &App, caller: &Caller, whose: Whose<'_>) -> Result<Part, Error> {
    let principal = &caller.who.principal;
    let Whose {
        service,
        robot,
        object,
    } = whose;
    if caller.may_at(app, Action::Operate, service, None).is_ok() {
        return Ok(Part::Acts);
    }
    if !principal.is(Role::Robot) {
        return Ok(Part::Looks);
    }
    let connects = caller.may_at(app, Action::Connect, service, Some(robot));
    // Whose name a nameless robot's servant has is nobody else's business.
    let own = match principal.scope.robot.as_deref() {
        Some(own) => own == robot,
        None => {
            principal.is(Role::Viewer) && (robot.starts_with('~') || is_free(app, caller, robot)?)
        }
    };
    match (connects, principal.is(Role::Viewer)) {
        (Ok(()), _) if own => Ok(Part::Acts),
        (_, true) => Ok(Part::Looks),
        _ => Err(Refusal::new(principal, Action::See, object).into()),
    }
}

/// What the caller may use of what flows inside them now.
pub(crate) fn grants(app: &App, caller: &Caller, whose: Whose<'_>) -> Result<Arc<Grants>, Error> {
    let part = part(app, caller, whose)?;
    let standing = app
        .principals
        .standing_inside(&caller.who, whose.service, part);
    match standing {
        Standing::Granted(grants) => Ok(grants),
        Standing::Ended(reason) => Err(Error::Forbidden { what: reason }),
    }
}

/// Whether a robot's name is nobody's, or the caller's.
fn is_free(app: &App, caller: &Caller, robot: &str) -> Result<bool, Error> {
    let owner = app.state.owner_of_robot(robot)?;
    Ok(owner.is_none() || owner == caller.who.owner)
}

/// Somebody who looks into a servant, once the connection is a WebSocket.
pub struct Looker {
    pub handle: Arc<Handle>,
    pub reach: Arc<dyn Reach>,
    /// What all its connections may hold.
    pub budget: Budget,
    /// What it may, as it changes.
    pub granted: Granted,
    pub caller: Caller,
}

/// A servant that the caller may look into, and what the caller may do there.
pub struct Door {
    app: Arc<App>,
    handle: Arc<Handle>,
    caller: Caller,
    part: Part,
}

impl Door {
    /// Of the servant of this id.
    pub fn of(app: &Arc<App>, id: &str, caller: Caller) -> Result<Self, Error> {
        let handle = app.choreographer.servant(id)?;
        let whose = Whose {
            service: handle.service(),
            robot: &handle.robot,
            object: format_args!("servant {id}"),
        };
        let part = part(app, &caller, whose)?;
        Ok(Self {
            app: Arc::clone(app),
            handle,
            caller,
            part,
        })
    }

    /// Becomes a WebSocket of this subprotocol, at which `serve` speaks for as long as the caller may look inside.
    pub fn open<Served: Future<Output = ()> + Send>(
        self,
        mut request: Request,
        protocol: Option<&'static str>,
        serve: impl FnOnce(Looker, reach::Stream, Bytes) -> Served + Send + 'static,
    ) -> Result<Response, Error> {
        let accept = handshake::accept(&request)?;
        let id = &self.handle.id;
        let Some(reach) = self.handle.reach() else {
            return Err(Error::NotThereYet(id.clone()));
        };
        let place = self.app.inside.place(id, &self.caller.who.principal.name)?;
        let Some(upgrade) = request.extensions_mut().remove::<OnUpgrade>() else {
            return Err(Error::BadRequest(
                "this connection cannot become a WebSocket".to_owned(),
            ));
        };
        notes(&self.app, &self.caller, &self.handle)("looks inside");
        let sessions = self.app.sessions.clone();
        sessions.spawn(async move {
            match upgrade.await {
                Ok(upgraded) => self.session(upgraded, reach, serve).await,
                Err(error) => tracing::debug!("a connection was lost at its upgrade: {error}"),
            }
            drop(place);
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

    async fn session<Served: Future<Output = ()>>(
        self,
        upgraded: Upgraded,
        reach: Arc<dyn Reach>,
        serve: impl FnOnce(Looker, reach::Stream, Bytes) -> Served,
    ) {
        let Self {
            app,
            handle,
            caller,
            part,
        } = self;
        let (io, read_ahead) = robots::unwrapped(upgraded);
        let memory = app.choreographer.memory();
        let service = handle.service().to_owned();
        let (standing, granted) =
            watch::channel(app.principals.standing_inside(&caller.who, &service, part));
        let refused = notes(&app, &caller, &handle);
        let used = notes(&app, &caller, &handle);
        let looker = Looker {
            handle,
            reach,
            budget: memory.client(&caller.peer.client(None)),
            granted: Granted::by(granted)
                .telling(move |operation| refused(&format!("was refused {operation}")))
                .noting(move |operation| used(&format!("inside: {operation}"))),
            caller: caller.clone(),
        };
        tokio::select! {
            () = serve(looker, io, read_ahead) => {}
            () = app.principals.follow_inside(&caller.who, &service, part, &standing) => {}
        }
    }
}

/// Becomes a WebSocket that speaks rosbridge inside the servant.
pub async fn inside(
    State(app): State<Arc<App>>,
    Path(id): Path<String>,
    Extension(caller): Extension<Caller>,
    request: Request,
) -> Result<Response, Error> {
    let door = Door::of(&app, &id, caller)?;
    let protocol = robots::rosbridge_protocol(request.headers())?;
    let bridge = app.choreographer.bridge_options().clone();
    door.open(request, protocol, async move |looker, io, read_ahead| {
        let waiting = Waiting::new(io, &read_ahead, &bridge).within(&looker.budget);
        let who = &looker.caller.who.principal;
        let options = SessionOptions {
            budget: looker.budget,
            client: who.name.clone(),
            granted: looker.granted,
            ..SessionOptions::default()
        };
        let end = looker.reach.serve_inside(waiting, options).await;
        let id = &looker.handle.id;
        tracing::debug!("{who} looks into servant {id} no more: {end:?}");
    })
}

/// Records what somebody does inside; where it is done again and again, once a minute.
fn notes(app: &Arc<App>, caller: &Caller, handle: &Handle) -> impl Fn(&str) + Send + Sync + use<> {
    let (app, caller) = (Arc::clone(app), caller.clone());
    let object = format!(
        "servant {} of robot {} at service {}",
        handle.id,
        handle.robot,
        handle.service()
    );
    move |did| {
        let (action, status) = match did {
            "looks inside" => (Action::See, StatusCode::SWITCHING_PROTOCOLS),
            did if did.starts_with("was refused") => (Action::Operate, StatusCode::FORBIDDEN),
            _ => (Action::Operate, StatusCode::OK),
        };
        app.audit
            .record_sparingly(&caller, action, did, &object, status.as_u16());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_servant_is_looked_into_by_so_many_and_nobody_keeps_the_others_out() {
        let lookers = Lookers::default();
        let mut eves: Vec<_> = (0..MOST_EACH)
            .map(|_| lookers.place("s1", "eve").expect("room"))
            .collect();
        let refused = lookers.place("s1", "eve").expect_err("hers are taken");
        assert!(matches!(refused, Error::TooManyLook { .. }), "{refused}");
        let elsewhere = lookers.place("s2", "eve").expect("another servant");
        let others: Vec<_> = (0..MOST - MOST_EACH)
            .map(|index| lookers.place("s1", &format!("p{index}")).expect("room"))
            .collect();
        lookers.place("s1", "late").expect_err("all are taken");
        eves.pop();
        let late = lookers.place("s1", "late").expect("room again");
        drop((eves, elsewhere, others, late));
        assert!(lookers.all.lock().is_empty(), "nothing is left behind");
    }
}
