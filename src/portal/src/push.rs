//! `POST /api/v1/push`: options in the query, the archive in the body, events as JSON lines in the response.

use std::io;
use std::sync::Arc;

use access::{AccessAction, AccessObject, ConnectionAccess};
use api::{PushEvent, PushOptions};
use axum::Extension;
use axum::body::Body;
use axum::extract::{OriginalUri, State};
use axum::response::{IntoResponse, Response};
use futures_util::{FutureExt, StreamExt, TryStreamExt};
use push::{Deployer, Published, PushResult, ReceptionGuard, UnderlayUse};

use crate::app::App;
use crate::audit::AuditObject;
use crate::caller::Caller;
use crate::errors::Error;
use crate::query::query_value;
use crate::{pushes, views};

/// Starts a push and sends its events. It goes on without this client when the archive is complete.
pub async fn push(
    State(app): State<Arc<App>>,
    OriginalUri(uri): OriginalUri,
    Extension(caller): Extension<Caller>,
    Extension(about): Extension<AuditObject>,
    body: Body,
) -> Response {
    let archive = body.into_data_stream().map_err(io::Error::other).boxed();
    let pusher = Arc::clone(&app.pusher);
    let (options, by) = match read_options(uri.query()).and_then(|options| {
        let by = deployer(&app, caller.clone());
        pusher.check_request(&options, &by)?;
        Ok((options, by))
    }) {
        Ok(read) => read,
        Err(error) => {
            pusher.discard(archive);
            return error.into_response();
        }
    };
    let pushed = describe_push(&options);
    about.set(pushed.clone());
    let started = pusher.start(options, by, archive, move |outcome| {
        let outcome = outcome.map_err(Error::from);
        match &outcome {
            Ok(done) => {
                let unchanged = if done.unchanged { ": unchanged" } else { "" };
                let object = match &done.published {
                    Published::Service(name) => format!("service {name}{unchanged}"),
                    Published::Underlay(underlay) => format!("underlay {}{unchanged}", underlay.name),
                };
                app.audit.record(&caller, AccessAction::Deploy, "push", &object, 200);
            }
            Err(error) => {
                let (object, status) = (format!("{pushed}: {error}"), error.problem().status);
                app.audit.record_throttled(&caller, AccessAction::Deploy, "push", &object, status);
            }
        }
        match outcome.and_then(|done| done_event(&app, done)) {
            Ok(event) => event,
            Err(error) => PushEvent::Error { problem: error.problem() },
        }
    });
    match started {
        // Owned by the response: if the client disconnects while it sends, the push is cancelled.
        Ok(running) => pushes::stream_output(&running, ReceptionGuard::new(Arc::clone(&running))),
        Err(error) => Error::from(error).into_response(),
    }
}

/// Describes what is pushed, before the service's name is known for certain.
fn describe_push(options: &PushOptions) -> String {
    match (options.name.as_ref().or(options.apt.as_ref()), &options.as_underlay) {
        (Some(name), _) => format!("service {name}"),
        (None, Some(name)) => format!("underlay {name}"),
        (None, None) if options.source.is_empty() => "a package".to_owned(),
        (None, None) => format!("package {}", options.source),
    }
}

/// Returns the permissions of the pushing caller, checked when the service's name is known, which without `--name` is
/// after the build.
pub fn deployer(app: &Arc<App>, caller: Caller) -> Deployer {
    let principal = &caller.who.principal;
    let name = principal.name.clone();
    let owner = (!principal.is_unscoped()).then(|| name.clone());
    let (known, who) = (Arc::clone(app), caller.who.clone());
    let over = move || {
        let (app, who) = (Arc::clone(&known), who.clone());
        async move { app.principals.wait_for_end(&who, "", false).await }.boxed()
    };
    let of_underlays = caller.clone();
    let may_use_underlay = move |what: UnderlayUse, name: &str, owner: Option<Option<&str>>| {
        let action = match what {
            UnderlayUse::StandOn => AccessAction::See,
            UnderlayUse::Publish => AccessAction::Deploy,
        };
        let (exists, owner) = (owner.is_some(), owner.flatten());
        let may = of_underlays.check_access(action, &AccessObject { service: Some(name), exists, owner, robot: None });
        may.map_err(|error| push::Error::NotAllowed(error.to_string()))
    };
    let (seeing, of_services) = (Arc::clone(app), caller.clone());
    let may_see = Box::new(move |name: &str| of_services.can_see(&seeing, name));
    let app = Arc::clone(app);
    let may = move |name: &str| {
        if let ConnectionAccess::Ended(reason) = app.principals.connection_access(&caller.who, name) {
            return Err(push::Error::NotAllowed(reason));
        }
        let may = caller.check_service_access(&app, AccessAction::Deploy, name, None);
        may.map_err(|error| push::Error::NotAllowed(error.to_string()))
    };
    let may_use_underlay = Box::new(may_use_underlay);
    Deployer { name, owner, may: Box::new(may), may_see, may_use_underlay, over: Box::new(over) }
}

fn done_event(app: &App, done: PushResult) -> Result<PushEvent, Error> {
    let PushResult { published, layers, took, unchanged } = done;
    let took = took.as_millis() as u64;
    Ok(match published {
        Published::Service(name) => {
            PushEvent::Done { service: Box::new(views::service(app, &name)?), layers, took, unchanged }
        }
        Published::Underlay(underlay) => PushEvent::Underlay { underlay, layers, took, unchanged },
    })
}

fn read_options(query_of: Option<&str>) -> Result<PushOptions, Error> {
    match query_value(query_of, "options") {
        Some(text) => serde_json::from_str(&text)
            .map_err(|error| Error::BadRequest(format!("the push options cannot be read: {error}"))),
        None => Ok(PushOptions::default()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_push_is_told_by_the_name_of_its_service() {
        let named = |name: Option<&str>, apt: Option<&str>, source: &str| {
            let (name, apt) = (name.map(str::to_owned), apt.map(str::to_owned));
            describe_push(&PushOptions { name, apt, source: source.to_owned(), ..PushOptions::default() })
        };
        assert_eq!(named(Some("people"), Some("opencv_apps"), "x"), "service people");
        assert_eq!(named(None, Some("opencv_apps"), ""), "service opencv_apps");
        assert_eq!(named(None, None, "student_vision"), "package student_vision");
        assert_eq!(named(None, None, ""), "a package");
        let underlay = PushOptions { as_underlay: Some("maps".to_owned()), ..PushOptions::default() };
        assert_eq!(describe_push(&underlay), "underlay maps");
    }

    #[test]
    fn options_come_in_the_query() {
        let options = read_options(Some("options=%7B%22apt%22%3A%22opencv_apps%22%7D")).expect("valid");
        assert_eq!(options.apt.as_deref(), Some("opencv_apps"));
        assert_eq!(read_options(None).expect("none"), PushOptions::default());
        let refused = read_options(Some("options=%7B%22nope%22%3A1%7D")).expect_err("unknown").problem();
        assert_eq!(refused.status, 400);
        assert!(refused.detail.contains("nope"), "{refused:?}");
    }
}
