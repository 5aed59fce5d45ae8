//! Whether who asks may: decided for each request by its row of the table of routes, before its handler; and what was done,
//! recorded before it is answered.

use std::sync::Arc;

use access::decide::may_use_class;
use access::{Action, Object, Principal, Role, decide};
use axum::extract::rejection::RawPathParamsRejection;
use axum::extract::{RawPathParams, Request, State};
use axum::http::StatusCode;
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use choreographer::Handle;

use crate::app::App;
use crate::audit::{About, is_recorded};
use crate::errors::Error;
use crate::guard::Caller;
use crate::routes::{Access, Of, Route};
use crate::{recordings, stubs};

/// The class of robots that name none.
const DEFAULT: &str = "default";

/// Lets a request through that its caller may make.
pub async fn allowed(
    State((app, route)): State<(Arc<App>, &'static Route)>,
    params: Result<RawPathParams, RawPathParamsRejection>,
    mut request: Request,
    next: Next,
) -> Response {
    if let Err(RawPathParamsRejection::InvalidUtf8InPathParam(unreadable)) = &params {
        let why = format!("the address cannot be read: {}", unreadable.body_text());
        return Error::BadRequest(why).into_response();
    }
    let Access::May(action, of) = route.access else {
        return next.run(request).await;
    };
    let Some(caller) = request.extensions().get::<Caller>().cloned() else {
        return Error::Internal("telling who asks").into_response();
    };
    let caller = &caller;
    let named = |parameter: &str| {
        let params = params.as_ref().ok()?;
        let (_, value) = params.iter().find(|(name, _)| *name == parameter)?;
        Some(value)
    };
    let decided = match of {
        Of::Machine => caller.may(action, &Object::MACHINE),
        // Who may not even at a service of its own need not be heard further.
        Of::Handler => {
            let name = &caller.who.principal.name;
            caller.may(action, &Object::service("", Some(name)))
        }
        Of::Service(parameter) => {
            at_service(&app, caller, action, named(parameter).unwrap_or_default())
        }
        Of::Stub(parameter) => {
            let file = named(parameter).unwrap_or_default();
            let service = stubs::service(file).map_or(file, |(service, _)| service);
            at_service(&app, caller, action, service)
        }
        Of::Servant(parameter) => {
            at_servant(&app, caller, action, named(parameter).unwrap_or_default())
        }
        Of::Recording(parameter) => {
            at_recording(&app, caller, action, named(parameter).unwrap_or_default())
        }
        Of::Robot(parameter) => at_robot(
            &caller.who.principal,
            action,
            named(parameter).unwrap_or_default(),
        ),
    };
    let method = request.method().clone();
    let did = format!("{method} {}", request.uri().path());
    let object = match of {
        Of::Machine | Of::Handler => "the server".to_owned(),
        Of::Service(parameter) => format!("service {}", named(parameter).unwrap_or_default()),
        Of::Stub(parameter) => format!("stub {}", named(parameter).unwrap_or_default()),
        Of::Servant(parameter) => format!("servant {}", named(parameter).unwrap_or_default()),
        Of::Robot(parameter) => format!("robot {}", named(parameter).unwrap_or_default()),
        Of::Recording(parameter) => {
            format!("recording {}", named(parameter).unwrap_or_default())
        }
    };
    let about = About::default();
    request.extensions_mut().insert(about.clone());
    let response = match decided {
        Ok(()) => next.run(request).await,
        Err(error) => error.into_response(),
    };
    let status = response.status();
    // What fails can be tried without end: it does not push what was done out of the log.
    let failed = status.is_client_error() && is_recorded(action, &method);
    if status == StatusCode::FORBIDDEN || failed {
        app.audit
            .record_sparingly(caller, action, &did, &about.or(&object), status.as_u16());
    } else if is_recorded(action, &method) {
        app.audit
            .record(caller, action, &did, &about.or(&object), status.as_u16());
    }
    response
}

impl Caller {
    /// Whether it may; else why not.
    pub fn may(&self, action: Action, object: &Object<'_>) -> Result<(), Error> {
        Ok(decide(&self.who.principal, action, object)?)
    }

    /// Whether it may be told of a service.
    pub fn sees(&self, app: &App, service: &str) -> bool {
        self.who.principal.sees_all() || self.may_at(app, Action::See, service, None).is_ok()
    }

    /// Comes back when what it is answered about a service is to end: the daemon does, or whoever asked has shown a token that is not
    /// good any more.
    pub fn over(&self, app: &Arc<App>, service: &str) -> impl Future<Output = ()> + Send + use<> {
        let (app, who, service) = (Arc::clone(app), self.who.clone(), service.to_owned());
        async move {
            tokio::select! {
                () = app.ending.cancelled() => {}
                _ = app.principals.ended(&who, &service, false) => {}
            }
        }
    }

    /// Whether it may be told of a servant: a robot sees its own alone.
    pub fn sees_servant(&self, app: &App, handle: &Handle) -> bool {
        self.is_robot_of(&handle.robot) && self.sees(app, handle.service())
    }

    /// The one robot that it is, where it is a robot that has a name.
    pub fn own_robot(&self) -> Option<&str> {
        let principal = &self.who.principal;
        let own = principal.scope.robot.as_deref();
        own.filter(|_| principal.is(Role::Robot))
    }

    /// Whether it is no robot, or this one.
    pub fn is_robot_of(&self, robot: &str) -> bool {
        self.own_robot().is_none_or(|own| own == robot)
    }

    /// Whether it may do something to what is of a robot at a service: robots may to their own alone.
    pub fn may_of(&self, app: &App, action: Action, service: &str, robot: &str) -> bool {
        self.is_robot_of(robot) && self.may_at(app, action, service, None).is_ok()
    }

    /// Whether it may do something at a service, as a robot where one is named.
    pub fn may_at(
        &self,
        app: &App,
        action: Action,
        service: &str,
        robot: Option<&str>,
    ) -> Result<(), Error> {
        // What a deployer may depends on whose the service is; the others need not be looked up.
        let (exists, owner) = match self.who.principal.is(Role::Deployer) {
            true => match app.state.service_owner(service)? {
                Some(owner) => (true, owner),
                None => (false, None),
            },
            false => (true, None),
        };
        let object = Object {
            service: Some(service),
            exists,
            owner: owner.as_deref(),
            robot,
        };
        self.may(action, &object)
    }

    /// Whether it may name a class of the configuration.
    pub fn may_use_class(&self, class: &str) -> Result<(), Error> {
        match class == DEFAULT || may_use_class(&self.who.principal, class) {
            true => Ok(()),
            false => Err(Error::Forbidden {
                what: format!("{} may not be of class {class}", self.who.principal.name),
            }),
        }
    }
}

fn at_service(app: &App, caller: &Caller, action: Action, service: &str) -> Result<(), Error> {
    caller.may_at(app, action, service, None)?;
    known_to(app, caller, service)
}

/// Refuses a service that there is not, to those who are not told of all: the refusal names those that they see.
pub fn known_to(app: &App, caller: &Caller, service: &str) -> Result<(), Error> {
    if caller.who.principal.sees_all() || app.state.service_package(service)?.is_some() {
        return Ok(());
    }
    let mut refusal = app.catalogue.unknown(service)?;
    if let catalogue::Error::UnknownService { exists, .. } = &mut refusal {
        exists.retain(|name| caller.sees(app, name));
    }
    Err(refusal.into())
}

fn at_servant(app: &App, caller: &Caller, action: Action, id: &str) -> Result<(), Error> {
    let handle = app.choreographer.servant(id);
    let may = handle.map(|handle| caller.may_of(app, action, handle.service(), &handle.robot));
    hidden(
        caller,
        action,
        may.map_err(Error::from),
        format_args!("servant {id}"),
    )
}

fn at_recording(app: &App, caller: &Caller, action: Action, number: &str) -> Result<(), Error> {
    let known = recordings::known(app, number);
    let may = known.map(|known| caller.may_of(app, action, &known.service, &known.robot));
    hidden(caller, action, may, format_args!("recording {number}"))
}

/// Refuses what is not there as what somebody may not see: whether it is there is told to those alone who are told of all.
fn hidden(
    caller: &Caller,
    action: Action,
    may: Result<bool, Error>,
    object: std::fmt::Arguments<'_>,
) -> Result<(), Error> {
    let principal = &caller.who.principal;
    match may {
        Ok(true) => Ok(()),
        Err(error) if principal.is_unscoped() => Err(error),
        Err(error) if principal.sees_all() && action == Action::See => Err(error),
        _ => Err(access::Refusal::new(principal, action, object).into()),
    }
}

/// Whether somebody may be told of a robot.
pub fn at_robot(principal: &Principal, action: Action, robot: &str) -> Result<(), Error> {
    let own = principal.is(Role::Robot) && principal.scope.robot.as_deref() == Some(robot);
    match own || principal.sees_all() {
        true => Ok(()),
        false => Err(access::Refusal::new(principal, action, format_args!("robot {robot}")).into()),
    }
}
