//! Authorisation: decided for each request by its row of the route table, before the handler runs. What was done is
//! written to the audit log before the response is sent.

use std::sync::Arc;

use access::decide::can_use_class;
use access::{AccessAction, AccessObject, Principal, Role, decide};
use axum::extract::rejection::RawPathParamsRejection;
use axum::extract::{RawPathParams, Request, State};
use axum::http::StatusCode;
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use choreographer::Handle;

use crate::app::App;
use crate::audit::{AuditObject, is_recorded};
use crate::errors::Error;
use crate::guard::Caller;
use crate::routes::{Access, AccessTarget, Route};
use crate::{recordings, stubs};

/// Class of robots that name none.
const DEFAULT: &str = "default";

/// Middleware that passes a request on if its caller may make it.
pub async fn authorise(
    State((app, route)): State<(Arc<App>, &'static Route)>,
    params: Result<RawPathParams, RawPathParamsRejection>,
    mut request: Request,
    next: Next,
) -> Response {
    if let Err(RawPathParamsRejection::InvalidUtf8InPathParam(unreadable)) = &params {
        let why = format!("cannot parse the address: {}", unreadable.body_text());
        return Error::BadRequest(why).into_response();
    }
    let Access::May(action, of) = route.access else {
        return next.run(request).await;
    };
    let Some(caller) = request.extensions().get::<Caller>().cloned() else {
        return Error::Internal("identifying the caller").into_response();
    };
    let caller = &caller;
    let named = |parameter: &str| {
        let params = params.as_ref().ok()?;
        let (_, value) = params.iter().find(|(name, _)| *name == parameter)?;
        Some(value)
    };
    let decided = match of {
        AccessTarget::Machine => caller.check_access(action, &AccessObject::MACHINE),
        // A caller that may not do this even at a service of its own is refused before the handler runs.
        AccessTarget::Handler => {
            let name = &caller.who.principal.name;
            caller.check_access(action, &AccessObject::service("", Some(name)))
        }
        AccessTarget::Service(parameter) => {
            check_service(&app, caller, action, named(parameter).unwrap_or_default())
        }
        AccessTarget::Stub(parameter) => {
            let file = named(parameter).unwrap_or_default();
            let service = stubs::parse_file_name(file).map_or(file, |(service, _)| service);
            check_service(&app, caller, action, service)
        }
        AccessTarget::Servant(parameter) => {
            check_servant(&app, caller, action, named(parameter).unwrap_or_default())
        }
        AccessTarget::Recording(parameter) => {
            check_recording(&app, caller, action, named(parameter).unwrap_or_default())
        }
        AccessTarget::Robot(parameter) => check_robot(
            &caller.who.principal,
            action,
            named(parameter).unwrap_or_default(),
        ),
    };
    let method = request.method().clone();
    let did = format!("{method} {}", request.uri().path());
    let object = match of {
        AccessTarget::Machine | AccessTarget::Handler => "the server".to_owned(),
        AccessTarget::Service(parameter) => {
            format!("service {}", named(parameter).unwrap_or_default())
        }
        AccessTarget::Stub(parameter) => format!("stub {}", named(parameter).unwrap_or_default()),
        AccessTarget::Servant(parameter) => {
            format!("servant {}", named(parameter).unwrap_or_default())
        }
        AccessTarget::Robot(parameter) => format!("robot {}", named(parameter).unwrap_or_default()),
        AccessTarget::Recording(parameter) => {
            format!("recording {}", named(parameter).unwrap_or_default())
        }
    };
    let about = AuditObject::default();
    request.extensions_mut().insert(about.clone());
    let response = match decided {
        Ok(()) => next.run(request).await,
        Err(error) => error.into_response(),
    };
    let status = response.status();
    // Failures can be repeated without end; they must not push what was done out of the log.
    let failed = status.is_client_error() && is_recorded(action, &method);
    if status == StatusCode::FORBIDDEN || failed {
        app.audit.record_throttled(
            caller,
            action,
            &did,
            &about.get_or(&object),
            status.as_u16(),
        );
    } else if is_recorded(action, &method) {
        app.audit.record(
            caller,
            action,
            &did,
            &about.get_or(&object),
            status.as_u16(),
        );
    }
    response
}

impl Caller {
    /// Checks whether the caller may perform the action on the object.
    pub fn check_access(
        &self,
        action: AccessAction,
        object: &AccessObject<'_>,
    ) -> Result<(), Error> {
        Ok(decide(&self.who.principal, action, object)?)
    }

    /// Returns true if the caller may see the service.
    pub fn can_see(&self, app: &App, service: &str) -> bool {
        self.who.principal.sees_all()
            || self
                .check_service_access(app, AccessAction::See, service, None)
                .is_ok()
    }

    /// Waits until responses about a service must end: the daemon stops, or the caller's credential has become
    /// invalid.
    pub fn wait_for_end(
        &self,
        app: &Arc<App>,
        service: &str,
    ) -> impl Future<Output = ()> + Send + use<> {
        let (app, who, service) = (Arc::clone(app), self.who.clone(), service.to_owned());
        async move {
            tokio::select! {
                () = app.ending.cancelled() => {}
                _ = app.principals.wait_for_end(&who, &service, false) => {}
            }
        }
    }

    /// Returns true if the caller may see the servant: a robot sees only its own.
    pub fn can_see_servant(&self, app: &App, handle: &Handle) -> bool {
        self.can_act_for_robot(&handle.robot) && self.can_see(app, handle.service())
    }

    /// Returns the robot that the caller is, if it is a named robot.
    pub fn own_robot(&self) -> Option<&str> {
        let principal = &self.who.principal;
        let own = principal.scope.robot.as_deref();
        own.filter(|_| principal.has_role(Role::Robot))
    }

    /// Returns true unless the caller is another robot.
    pub fn can_act_for_robot(&self, robot: &str) -> bool {
        self.own_robot().is_none_or(|own| own == robot)
    }

    /// Returns true if the caller may perform the action on what belongs to a robot at a service; robots are limited
    /// to their own.
    pub fn is_allowed_for_robot(
        &self,
        app: &App,
        action: AccessAction,
        service: &str,
        robot: &str,
    ) -> bool {
        self.can_act_for_robot(robot)
            && self
                .check_service_access(app, action, service, None)
                .is_ok()
    }

    /// Checks whether the caller may perform the action on a service, as a robot if one is named.
    pub fn check_service_access(
        &self,
        app: &App,
        action: AccessAction,
        service: &str,
        robot: Option<&str>,
    ) -> Result<(), Error> {
        // Only a deployer's permissions depend on the owner of the service.
        let (exists, owner) = if self.who.principal.has_role(Role::Deployer) {
            match app.state.service_owner(service)? {
                Some(owner) => (true, owner),
                None => (false, None),
            }
        } else {
            (true, None)
        };
        let object = AccessObject {
            service: Some(service),
            exists,
            owner: owner.as_deref(),
            robot,
        };
        self.check_access(action, &object)
    }

    /// Checks whether the caller may use a class of the configuration.
    pub fn check_class(&self, class: &str) -> Result<(), Error> {
        if class == DEFAULT || can_use_class(&self.who.principal, class) {
            Ok(())
        } else {
            Err(Error::Forbidden {
                what: format!("{} may not use class {class}", self.who.principal.name),
            })
        }
    }
}

fn check_service(
    app: &App,
    caller: &Caller,
    action: AccessAction,
    service: &str,
) -> Result<(), Error> {
    caller.check_service_access(app, action, service, None)?;
    check_service_known(app, caller, service)
}

/// Refuses an unknown service. A caller that may not see all services is shown only those it may see.
pub fn check_service_known(app: &App, caller: &Caller, service: &str) -> Result<(), Error> {
    if caller.who.principal.sees_all() || app.state.service_package(service)?.is_some() {
        return Ok(());
    }
    let mut refusal = app.catalogue.unknown_service(service)?;
    if let catalogue::Error::UnknownService { exists, .. } = &mut refusal {
        exists.retain(|name| caller.can_see(app, name));
    }
    Err(refusal.into())
}

fn check_servant(app: &App, caller: &Caller, action: AccessAction, id: &str) -> Result<(), Error> {
    let handle = app.choreographer.servant(id);
    let may = handle
        .map(|handle| caller.is_allowed_for_robot(app, action, handle.service(), &handle.robot));
    conceal_missing(
        caller,
        action,
        may.map_err(Error::from),
        format_args!("servant {id}"),
    )
}

fn check_recording(
    app: &App,
    caller: &Caller,
    action: AccessAction,
    number: &str,
) -> Result<(), Error> {
    let known = recordings::find_recording(app, number);
    let may =
        known.map(|known| caller.is_allowed_for_robot(app, action, &known.service, &known.robot));
    conceal_missing(caller, action, may, format_args!("recording {number}"))
}

/// Refuses a missing object like a forbidden one: only callers that see everything learn whether it exists.
fn conceal_missing(
    caller: &Caller,
    action: AccessAction,
    may: Result<bool, Error>,
    object: std::fmt::Arguments<'_>,
) -> Result<(), Error> {
    let principal = &caller.who.principal;
    match may {
        Ok(true) => Ok(()),
        Err(error) if principal.is_unscoped() => Err(error),
        Err(error) if principal.sees_all() && action == AccessAction::See => Err(error),
        _ => Err(access::AccessDenied::new(principal, action, object).into()),
    }
}

/// Checks whether the principal may see the robot.
pub fn check_robot(principal: &Principal, action: AccessAction, robot: &str) -> Result<(), Error> {
    let own = principal.has_role(Role::Robot) && principal.scope.robot.as_deref() == Some(robot);
    if own || principal.sees_all() {
        Ok(())
    } else {
        Err(access::AccessDenied::new(principal, action, format_args!("robot {robot}")).into())
    }
}
