//! `/api/v1/events`: the journal, as it is and as it grows.

use std::sync::Arc;

use axum::extract::State;
use axum::response::Response;
use axum::{Extension, Json};
use futures_util::StreamExt;
use serde::Deserialize;
use store::{EventFilter, Told};
use tokio::sync::watch;
use utoipa::IntoParams;

use crate::api_v1::{Answer, lines};
use crate::app::App;
use crate::errors::Error;
use crate::guard::Caller;
use crate::query::Query;

/// Events of one answer, where nobody says how many.
const EVENTS: u32 = 100;

/// Which events.
#[derive(Debug, Deserialize, IntoParams)]
pub struct Which {
    /// Only events with a greater number.
    #[serde(default)]
    since: i64,
    /// So many of the newest that there are; 100 by default.
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

impl Which {
    /// The newest `limit` of them after number `since` that the caller is told of, oldest first.
    fn read(
        &self,
        app: &App,
        caller: &Caller,
        since: i64,
        limit: u32,
    ) -> Result<Vec<api::Event>, Error> {
        let services = services_seen(app, caller)?;
        let told = services.as_deref().map(|services| Told {
            services,
            own_robot: caller.who.principal.scope.robot.as_deref(),
        });
        let filter = EventFilter {
            kind: self.kind.as_deref(),
            service: self.service.as_deref(),
            servant: self.servant.as_deref(),
            robot: self.robot.as_deref(),
            told,
        };
        Ok(app.state.events_of(filter, since, limit)?)
    }
}

/// Services with events that the caller may see, by name; none where it sees all that there is.
pub fn services_seen(app: &App, caller: &Caller) -> Result<Option<Vec<String>>, Error> {
    if caller.who.principal.sees_all() {
        return Ok(None);
    }
    let mut services = app.state.services_of_events()?;
    services.retain(|service| caller.sees(app, service));
    Ok(Some(services))
}

/// Whether somebody who does not see all is told of an event: a robot is told of itself, and everybody of services that they see;
/// the machine's own are for those who see it.
pub fn is_told(caller: &Caller, event: &api::Event, sees: &mut impl FnMut(&str) -> bool) -> bool {
    let own = caller.who.principal.scope.robot.as_deref();
    event.service.as_deref().is_some_and(sees)
        && own.is_none_or(|own| event.robot.as_deref().is_none_or(|robot| robot == own))
}

/// The journal.
pub async fn events(
    State(app): State<Arc<App>>,
    Query(which): Query<Which>,
    Extension(caller): Extension<Caller>,
) -> Answer<Vec<api::Event>> {
    let limit = which.limit.unwrap_or(EVENTS);
    Ok(Json(which.read(&app, &caller, which.since, limit)?))
}

/// One who follows the journal.
struct Follower {
    app: Arc<App>,
    caller: Caller,
    which: Which,
    /// Tells that there are more.
    grown: watch::Receiver<i64>,
    /// The number of the last that was looked at.
    last: i64,
}

impl Follower {
    /// What there is more of, as soon as there is some; none where it cannot be read: who follows asks again, and is told why.
    async fn next(&mut self) -> Option<Vec<api::Event>> {
        loop {
            self.grown.changed().await.ok()?;
            let newest = *self.grown.borrow_and_update();
            let Follower { app, caller, .. } = self;
            let events = self.which.read(app, caller, self.last, u32::MAX);
            let events = events
                .inspect_err(|error| tracing::error!("the journal cannot be followed: {error}"))
                .ok()?;
            let last = events.last().map_or(newest, |event| event.id.max(newest));
            self.last = self.last.max(last);
            if !events.is_empty() {
                return Some(events);
            }
        }
    }
}

/// The journal, and what comes to it from now on, until the caller leaves or may not know it any more. A caller that comes back
/// with the number of the last event it was told of misses none.
pub async fn follow(
    State(app): State<Arc<App>>,
    Query(which): Query<Which>,
    Extension(caller): Extension<Caller>,
) -> Result<Response, Error> {
    let place = app.live.place(&caller)?;
    // First, so that none is missed that comes meanwhile.
    let mut grown = app.state.watch_events();
    let newest = *grown.borrow_and_update();
    let limit = which.limit.unwrap_or(EVENTS);
    let there = which.read(&app, &caller, which.since, limit)?;
    let ending = caller.over(&app, "");
    let last = there.last().map_or(newest, |event| event.id.max(newest));
    let follower = Follower {
        last: last.max(which.since),
        app,
        caller,
        which,
        grown,
    };
    let more = futures_util::stream::unfold((follower, place), |(mut follower, place)| async {
        let events = follower.next().await?;
        Some((events, (follower, place)))
    });
    let all = futures_util::stream::once(async { there }).chain(more);
    Ok(lines(
        all.flat_map(futures_util::stream::iter).take_until(ending),
    ))
}
