//! `/api/v1/pushes`: pushes that run and those that ended lately, what they print, and their cancellation.

use std::convert::Infallible;
use std::sync::Arc;

use access::{AccessAction, AccessObject};
use api::{NDJSON, PushEvent, PushState, PushStatus};
use axum::body::Body;
use axum::extract::{Path, State};
use axum::http::header;
use axum::response::{IntoResponse, Response};
use axum::{Extension, Json};
use futures_util::StreamExt;
use push::RunningPush;
use serde::Deserialize;
use utoipa::IntoParams;

use crate::app::App;
use crate::audit::AuditObject;
use crate::authorisation::conceal_missing;
use crate::caller::Caller;
use crate::errors::Error;
use crate::json::{JsonResult, json_lines};
use crate::query::Query;

/// Query of the output of a push.
#[derive(Debug, Default, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
pub struct PushOutputQuery {
    /// True to follow the output until the push has ended.
    #[serde(default)]
    follow: bool,
}

/// Lists the pushes that the caller may see, newest first.
pub async fn list(State(app): State<Arc<App>>, Extension(caller): Extension<Caller>) -> JsonResult<Vec<PushStatus>> {
    let mut all = app.pusher.pushes()?;
    all.retain(|push| is_allowed(&app, &caller, AccessAction::See, push));
    for push in &mut all {
        set_permissions(&app, &caller, push);
    }
    Ok(Json(all))
}

/// Returns what a push printed so far, or follows it until it has ended.
pub async fn output(
    State(app): State<Arc<App>>,
    Path(number): Path<String>,
    Query(which): Query<PushOutputQuery>,
    Extension(caller): Extension<Caller>,
) -> Result<Response, Error> {
    let push = find_push(&app, &caller, AccessAction::Logs, &number)?;
    // A slow reader keeps events in memory for that long.
    let place = app.live.acquire_slot(&caller)?;
    if let Some(running) = app.pusher.running_push(push.number) {
        if !which.follow {
            return Ok(stream_events(running.output(), place));
        }
        let ending = caller.wait_for_end(&app, "");
        return Ok(follow_output(&running, place, ending));
    }
    let stored = app.pusher.push_output(push.number)?.unwrap_or_default();
    if stored.is_empty() {
        // What a push printed that ended with its daemon is lost.
        let next = Some("push it again; what was built is kept".to_owned());
        let lost = push::Error::Failed { message: push.message.unwrap_or_default(), next, log: Vec::new() };
        let last = PushEvent::Error { problem: Error::from(lost).problem() };
        return Ok(stream_events(vec![last], place));
    }
    let whole = futures_util::stream::iter([Ok::<_, Infallible>(stored)]).inspect(move |_| {
        let _held = &place;
    });
    Ok(([(header::CONTENT_TYPE, NDJSON)], Body::from_stream(whole)).into_response())
}

/// Sends events, and holds `place` meanwhile.
fn stream_events(events: Vec<PushEvent>, place: impl Send + 'static) -> Response {
    json_lines(futures_util::stream::iter(events).inspect(move |_| {
        let _held = &place;
    }))
}

/// Cancels a running push. It ends, as its output tells, when nothing is left of it.
pub async fn cancel(
    State(app): State<Arc<App>>,
    Path(number): Path<String>,
    Extension(caller): Extension<Caller>,
    Extension(about): Extension<AuditObject>,
) -> JsonResult<PushStatus> {
    let push = find_push(&app, &caller, AccessAction::Deploy, &number)?;
    about.set(match &push.service {
        Some(service) => format!("push {number} of service {service}"),
        None => format!("push {number}"),
    });
    let refusal = |why| Error::PushNotCancelled { number: push.number, why };
    let running = app.pusher.running_push(push.number).ok_or_else(|| refusal("it has ended"))?;
    if !running.cancel() {
        return Err(refusal("it is publishing, or has ended"));
    }
    Ok(Json(push))
}

/// Sends the output of a push to the client that started it, and holds `guard` meanwhile.
pub fn stream_output(running: &Arc<RunningPush>, guard: impl Send + 'static) -> Response {
    // By its number the client can cancel the push before it has read anything.
    let location = [(header::LOCATION, format!("/api/v1/pushes/{}", running.number))];
    (location, follow_output(running, guard, std::future::pending())).into_response()
}

/// Sends the output of a push until it has ended, or until `ending` resolves.
fn follow_output(
    running: &Arc<RunningPush>,
    held: impl Send + 'static,
    ending: impl Future<Output = ()> + Send + 'static,
) -> Response {
    let events = futures_util::stream::unfold((running.follow(), held), |(mut follower, held)| async move {
        let events = follower.next().await?;
        Some((futures_util::stream::iter(events), (follower, held)))
    });
    json_lines(events.flatten().take_until(ending))
}

/// Returns a push on which the caller may perform the action. One that is not known is refused like one that is not
/// allowed, unless the caller sees everything.
fn find_push(app: &App, caller: &Caller, action: AccessAction, number: &str) -> Result<PushStatus, Error> {
    let wanted = number.parse::<u64>().ok();
    let found = app.pusher.pushes()?.into_iter().find(|push| Some(push.number) == wanted);
    let may = match &found {
        Some(push) => Ok(is_allowed(app, caller, action, push)),
        None => Err(Error::UnknownPush(number.to_owned())),
    };
    conceal_missing(caller, action, may, format_args!("push {number}"))?;
    let mut push = found.ok_or_else(|| Error::UnknownPush(number.to_owned()))?;
    set_permissions(app, caller, &mut push);
    Ok(push)
}

fn set_permissions(app: &App, caller: &Caller, push: &mut PushStatus) {
    push.can_read = is_allowed(app, caller, AccessAction::Logs, push);
    push.can_cancel = push.state == PushState::Running && is_allowed(app, caller, AccessAction::Deploy, push);
}

/// Returns true if the caller may perform the action on the push. It belongs to whoever pushes; those who may see its
/// service, or read the logs of that, may do the same with the push, but not cancel it.
fn is_allowed(app: &App, caller: &Caller, action: AccessAction, push: &PushStatus) -> bool {
    let service = push.service.as_deref();
    let pushed = AccessObject::service(service.unwrap_or_default(), Some(&push.by));
    if caller.check_access(action, &pushed).is_ok() {
        return true;
    }
    match (action, service) {
        (AccessAction::See, Some(service)) => caller.can_see(app, service),
        (AccessAction::Logs, Some(service)) => caller.check_service_access(app, action, service, None).is_ok(),
        _ => false,
    }
}
