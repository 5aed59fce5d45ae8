//! Programs in servants: `ws://host:9090/api/v1/servants/ID/exec` runs one as the servant's user, within its limits and
//! namespaces, for callers with the permission `exec` ([`api::exec`] describes the messages).
//!
//! A session ends with its program, its servant, its connection and its caller's permission, and with the daemon; then
//! the program is killed with all that it has started. Without traffic it lasts as long as the connection.

mod request;
mod session;

use std::sync::Arc;

use access::{AccessAction, ConnectionAccess};
use axum::Extension;
use axum::extract::{Path, Request, State};
use axum::http::StatusCode;
use axum::response::Response;
use hyper::upgrade::{OnUpgrade, Upgraded};
use servant::exec::ExecSession;
use tokio::sync::oneshot;
use tokio_tungstenite::WebSocketStream;
use tokio_tungstenite::tungstenite::protocol::Role;
use tracing::Instrument;

use crate::app::App;
use crate::caller::Caller;
use crate::errors::Error;
use crate::{audit, handshake, headers, robots};

pub use request::ExecQuery;
use session::ExecOutcome;

/// Limit on the exec sessions of one principal. A servant has its own limit.
const MAX_SESSIONS: usize = 4;

/// Runs a program in a servant and upgrades to a WebSocket with its streams.
pub async fn open_exec(
    State(app): State<Arc<App>>,
    Path(id): Path<String>,
    Extension(caller): Extension<Caller>,
    mut request: Request,
) -> Result<Response, Error> {
    if !app.options.exec {
        return Err(Error::ExecOff);
    }
    let asked = ExecQuery::parse(request.uri().query())?;
    let accept = handshake::accept(&request)?;
    if !headers::protocols(request.headers()).any(|offered| offered == api::exec::PROTOCOL) {
        let spoken = api::exec::PROTOCOL;
        return Err(Error::BadRequest(format!("this address speaks {spoken}, which the client does not offer")));
    }
    let handle = app.choreographer.servant(&id)?;
    check_whole_service(&app, &caller, handle.service())?;
    handle.check_container()?;
    let container = handle.container().ok_or_else(|| Error::NotRunning(id.clone()))?;
    let who = &caller.who.principal.name;
    let slot = app.execs.acquire(who.clone(), MAX_SESSIONS);
    let slot = slot.ok_or_else(|| Error::TooManyExecs { who: who.clone(), most: MAX_SESSIONS })?;
    let Some(upgrade) = request.extensions_mut().remove::<OnUpgrade>() else {
        return Err(Error::BadRequest("this connection cannot become a WebSocket".to_owned()));
    };
    let object =
        format!("servant {id} of robot {} at service {}: {}", handle.robot, handle.service(), asked.describe());
    let span = handle.span(caller.connection_span().id());
    let service = handle.service().to_owned();
    let sessions = app.sessions.clone();
    let (answer, answered) = oneshot::channel();
    // A task of its own: a client that leaves while the program is started can neither keep that out of the audit log
    // nor tear the request to the shim.
    let serving = async move {
        let started = container.exec(asked.spec(), asked.terminal_size()).await.map_err(|error| match error {
            servant::Error::Ended { .. } => Error::NotRunning(id),
            error => choreographer::Error::from(error).into(),
        });
        let status = match &started {
            Ok(_) => StatusCode::SWITCHING_PROTOCOLS.as_u16(),
            Err(error) => error.problem().status,
        };
        app.audit.record(&caller, AccessAction::Exec, "start a program", &object, status);
        let program = match started {
            Ok(program) => program,
            Err(error) => {
                // The client may have left.
                let _ = answer.send(Err(error));
                return;
            }
        };
        let _ = answer.send(Ok(()));
        let outcome = match upgrade.await {
            Ok(upgraded) => serve(&app, &caller, &service, upgraded, program).await,
            Err(error) => {
                tracing::debug!("a connection was lost at its upgrade: {error}");
                ExecOutcome::Left
            }
        };
        drop(slot);
        let object = describe_end(&object, &outcome.describe());
        app.audit.record(&caller, AccessAction::Exec, "end of a program", &object, StatusCode::OK.as_u16());
    };
    sessions.spawn(serving.instrument(span));
    answered.await.unwrap_or(Err(Error::Internal("starting a program")))?;
    Ok(handshake::switch_protocols(accept, Some(api::exec::PROTOCOL)))
}

/// Adds its outcome to what is recorded of a program; the command is cut rather than the outcome.
fn describe_end(object: &str, outcome: &str) -> String {
    let room = audit::LONGEST.saturating_sub(outcome.chars().count() + 2);
    format!("{}: {outcome}", object.chars().take(room).collect::<String>())
}

/// Serves a session for as long as the caller has the permission and the daemon runs.
async fn serve(
    app: &Arc<App>,
    caller: &Caller,
    service: &str,
    upgraded: Upgraded,
    program: ExecSession,
) -> ExecOutcome {
    let (io, read_ahead) = robots::into_raw_stream(upgraded);
    let config = session::socket_config();
    let socket = WebSocketStream::from_partially_read(io, read_ahead.to_vec(), Role::Server, Some(config)).await;
    let ending = async {
        tokio::select! {
            () = app.ending.cancelled() => "the daemon ends".to_owned(),
            reason = app.principals.wait_for_end(&caller.who, service, true) => reason,
        }
    };
    session::serve(socket, program, ending).await
}

/// Refuses a caller to whom the policy grants only a part of the service: a program can use all of it.
fn check_whole_service(app: &App, caller: &Caller, service: &str) -> Result<(), Error> {
    let what = match app.principals.connection_access(&caller.who, service) {
        ConnectionAccess::Granted(grants) if grants.is_everything() => return Ok(()),
        ConnectionAccess::Granted(grants) => {
            let who = &caller.who.principal.name;
            format!("a program in a servant needs all of {service}, but {who} is granted only {grants}")
        }
        ConnectionAccess::Ended(reason) => reason,
    };
    Err(Error::Forbidden { what })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_long_command_does_not_hide_its_outcome() {
        assert_eq!(describe_end("servant s: ls", "exit status 0"), "servant s: ls: exit status 0");
        let long = describe_end(&"é".repeat(1000), "killed: this token was revoked");
        assert_eq!(long.chars().count(), audit::LONGEST);
        assert!(long.starts_with("éé") && long.ends_with("é: killed: this token was revoked"), "{long}");
    }
}
