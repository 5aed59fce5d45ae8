//! `/api/v1/events`: the journal, as a list and as a stream.

use std::sync::Arc;

use axum::extract::State;
use axum::response::Response;
use axum::{Extension, Json};
use futures_util::StreamExt;
use serde::Deserialize;
use store::{EventFilter, EventVisibility};
use tokio::sync::watch;
use utoipa::IntoParams;

use crate::app::App;
use crate::caller::Caller;
use crate::errors::Error;
use crate::json::{JsonResult, json_lines};
use crate::query::Query;

/// Default number of events in a response.
const EVENTS: u32 = 100;

/// Query of the journal.
#[derive(Debug, Deserialize, IntoParams)]
pub struct EventQuery {
    /// Only events with a greater number.
    #[serde(default)]
    since: i64,
    /// Number of events, the newest ones (default: 100).
    limit: Option<u32>,
    /// Only events of this kind, such as `node-hung`.
    kind: Option<String>,
    /// Only events of this service.
    service: Option<String>,
    /// Only events of this servant.
    servant: Option<String>,
    /// Only events of this robot.
    robot: Option<String>,
}

impl EventQuery {
    /// Returns the newest `limit` events after number `since` that the caller may see, oldest first.
    fn read(&self, app: &App, caller: &Caller, since: i64, limit: u32) -> Result<Vec<api::Event>, Error> {
        let services = visible_services(app, caller)?;
        let told = services
            .as_deref()
            .map(|services| EventVisibility { services, own_robot: caller.who.principal.scope.robot.as_deref() });
        let filter = EventFilter {
            kind: self.kind.as_deref(),
            service: self.service.as_deref(),
            servant: self.servant.as_deref(),
            robot: self.robot.as_deref(),
            told,
        };
        Ok(app.state.filtered_events(filter, since, limit)?)
    }
}

/// Returns the services with events that the caller may see, or `None` if it may see everything.
pub fn visible_services(app: &App, caller: &Caller) -> Result<Option<Vec<String>>, Error> {
    if caller.who.principal.sees_all() {
        return Ok(None);
    }
    let mut services = app.state.services_with_events()?;
    services.retain(|service| caller.can_see(app, service));
    Ok(Some(services))
}

/// Returns true if a caller that does not see everything may see the event: a robot sees its own events, everybody
/// those of services that they see; the machine's own events require access to the machine.
pub fn is_visible(caller: &Caller, event: &api::Event, sees: &mut impl FnMut(&str) -> bool) -> bool {
    let own = caller.who.principal.scope.robot.as_deref();
    event.service.as_deref().is_some_and(sees)
        && own.is_none_or(|own| event.robot.as_deref().is_none_or(|robot| robot == own))
}

/// Lists events of the journal.
pub async fn events(
    State(app): State<Arc<App>>,
    Query(which): Query<EventQuery>,
    Extension(caller): Extension<Caller>,
) -> JsonResult<Vec<api::Event>> {
    let limit = which.limit.unwrap_or(EVENTS);
    Ok(Json(which.read(&app, &caller, which.since, limit)?))
}

/// A caller that follows the journal.
struct Follower {
    app: Arc<App>,
    caller: Caller,
    which: EventQuery,
    /// Notifies of new events.
    grown: watch::Receiver<i64>,
    /// Number of the last event examined.
    last: i64,
}

impl Follower {
    /// Waits for new events; `None` if the journal cannot be read. The client then asks again and is told the reason.
    async fn next(&mut self) -> Option<Vec<api::Event>> {
        loop {
            self.grown.changed().await.ok()?;
            let newest = *self.grown.borrow_and_update();
            let Follower { app, caller, .. } = self;
            let events = self.which.read(app, caller, self.last, u32::MAX);
            let events = events.inspect_err(|error| tracing::error!("the journal cannot be followed: {error}")).ok()?;
            let last = events.last().map_or(newest, |event| event.id.max(newest));
            self.last = self.last.max(last);
            if !events.is_empty() {
                return Some(events);
            }
        }
    }
}

/// Streams the journal and new events until the caller disconnects or loses access. A caller that reconnects with the
/// number of its last event misses none.
pub async fn follow(
    State(app): State<Arc<App>>,
    Query(which): Query<EventQuery>,
    Extension(caller): Extension<Caller>,
) -> Result<Response, Error> {
    let place = app.live.acquire_slot(&caller)?;
    // Subscribes before reading, so that no event is missed in between.
    let mut grown = app.state.watch_events();
    let newest = *grown.borrow_and_update();
    let limit = which.limit.unwrap_or(EVENTS);
    let there = which.read(&app, &caller, which.since, limit)?;
    let ending = caller.wait_for_end(&app, "");
    let last = there.last().map_or(newest, |event| event.id.max(newest));
    let follower = Follower { last: last.max(which.since), app, caller, which, grown };
    let more = futures_util::stream::unfold((follower, place), |(mut follower, place)| async {
        let events = follower.next().await?;
        Some((events, (follower, place)))
    });
    let all = futures_util::stream::once(async { there }).chain(more);
    Ok(json_lines(all.flat_map(futures_util::stream::iter).take_until(ending)))
}
