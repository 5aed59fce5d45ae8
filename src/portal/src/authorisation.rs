//! Authorisation: decided for each request by its row of the route table, before the handler runs. What was done is
//! written to the audit log before the response is sent.

use std::sync::Arc;

use access::{AccessAction, AccessObject, Principal, Role};
use axum::extract::rejection::RawPathParamsRejection;
use axum::extract::{RawPathParams, Request, State};
use axum::http::StatusCode;
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};

use crate::app::App;
use crate::audit::{AuditObject, is_recorded};
use crate::caller::Caller;
use crate::errors::Error;
use crate::permissions::check_service_known;
use crate::route_access::{Access, AccessTarget, DescribeRequest};
use crate::{recordings, stubs};

/// Middleware that passes a request on if its caller may make it.
pub async fn authorise(
    State((app, access, describe)): State<(Arc<App>, Access, DescribeRequest)>,
    params: Result<RawPathParams, RawPathParamsRejection>,
    mut request: Request,
    next: Next,
) -> Response {
    if let Err(RawPathParamsRejection::InvalidUtf8InPathParam(unreadable)) = &params {
        let why = format!("cannot parse the address: {}", unreadable.body_text());
        return Error::BadRequest(why).into_response();
    }
    let Access::May(action, of) = access else {
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
        AccessTarget::Service(parameter) => check_service(&app, caller, action, named(parameter).unwrap_or_default()),
        AccessTarget::Stub(parameter) => {
            let file = named(parameter).unwrap_or_default();
            let service = stubs::parse_file_name(file).map_or(file, |(service, _)| service);
            check_service(&app, caller, action, service)
        }
        AccessTarget::Servant(parameter) => check_servant(&app, caller, action, named(parameter).unwrap_or_default()),
        AccessTarget::Recording(parameter) => {
            check_recording(&app, caller, action, named(parameter).unwrap_or_default())
        }
        AccessTarget::Robot(parameter) => {
            check_robot(&caller.who.principal, action, named(parameter).unwrap_or_default())
        }
    };
    let method = request.method().clone();
    let did = describe(&method, request.uri().path());
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
        app.audit.record_throttled(caller, action, &did, &about.get_or(&object), status.as_u16());
    } else if is_recorded(action, &method) {
        app.audit.record(caller, action, &did, &about.get_or(&object), status.as_u16());
    }
    response
}

fn check_service(app: &App, caller: &Caller, action: AccessAction, service: &str) -> Result<(), Error> {
    caller.check_service_access(app, action, service, None)?;
    check_service_known(app, caller, service)
}

fn check_servant(app: &App, caller: &Caller, action: AccessAction, id: &str) -> Result<(), Error> {
    // The log is what remains of a servant that has ended.
    if action == AccessAction::Logs
        && let Some(ended) = app.choreographer.kept_log(id)
    {
        let may = caller.is_allowed_for_robot(app, action, &ended.service, &ended.robot);
        return conceal_missing(caller, action, Ok(may), format_args!("servant {id}"));
    }
    let handle = app.choreographer.servant(id);
    let may = handle.map(|handle| caller.is_allowed_for_robot(app, action, handle.service(), &handle.robot));
    conceal_missing(caller, action, may.map_err(Error::from), format_args!("servant {id}"))
}

fn check_recording(app: &App, caller: &Caller, action: AccessAction, number: &str) -> Result<(), Error> {
    let known = recordings::find_recording(app, number);
    let may = known.map(|known| caller.is_allowed_for_robot(app, action, &known.service, &known.robot));
    conceal_missing(caller, action, may, format_args!("recording {number}"))
}

/// Refuses a missing object like a forbidden one: only callers that see everything learn whether it exists.
pub fn conceal_missing(
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
