//! History of servants and machine: recorded every ten seconds, kept in this resolution for an hour and per minute
//! for a day.

mod figures;
mod recorder;

use std::sync::Arc;

use api::Millis;
use api::history::{MachineHistory, ServantHistory};
use axum::extract::State;
use axum::{Extension, Json};
use serde::Deserialize;
use store::{EventVisibility, RecordedSeries, SeriesFilter};
use utoipa::IntoParams;

use crate::app::App;
use crate::caller::Caller;
use crate::errors::Error;
use crate::json::JsonResult;
use crate::query::Query;
pub use recorder::record_history;

/// Limit on the samples in a response, over all servants.
const MAX_SAMPLES: usize = 20_000;
/// Limit on the servants examined for a response.
const SERVANTS: u32 = 1_000;

/// Resolution of recorded samples and their retention.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct HistoryStep {
    seconds: u32,
    /// Number of steps kept.
    kept: u32,
}

const FINE: HistoryStep = HistoryStep { seconds: 10, kept: 360 };
const COARSE: HistoryStep = HistoryStep { seconds: 60, kept: 1_440 };

impl HistoryStep {
    fn millis(self) -> Millis {
        Millis::from(self.seconds) * 1_000
    }

    /// Returns the retention in milliseconds.
    fn retention(self) -> Millis {
        self.millis() * Millis::from(self.kept)
    }

    fn parse(seconds: Option<u32>) -> Result<HistoryStep, Error> {
        let steps = [FINE, COARSE];
        let seconds = seconds.unwrap_or(COARSE.seconds);
        let step = steps.into_iter().find(|step| step.seconds == seconds);
        step.ok_or_else(|| {
            Error::BadRequest(format!(
                "there is no step of {seconds} s; ask for step={} (kept for an hour) or step={} (kept for a day)",
                FINE.seconds, COARSE.seconds
            ))
        })
    }
}

/// Query: which period.
#[derive(Debug, Clone, Copy, Deserialize, IntoParams)]
pub struct TimeQuery {
    /// Start in milliseconds since 1970 (default: as far back as the step is kept).
    from: Option<u64>,
    /// End in milliseconds since 1970 (default: now).
    to: Option<u64>,
    /// Step in seconds: 10 (kept for an hour) or 60 (kept for a day; the default).
    step: Option<u32>,
}

/// Query: which servants and which period.
#[derive(Debug, Deserialize, IntoParams)]
pub struct ServantHistoryQuery {
    /// Only this servant.
    servant: Option<String>,
    /// Only servants of this service.
    service: Option<String>,
    /// Only servants of this robot.
    robot: Option<String>,
    /// Start in milliseconds since 1970 (default: as far back as the step is kept).
    from: Option<u64>,
    /// End in milliseconds since 1970 (default: now).
    to: Option<u64>,
    /// Step in seconds: 10 (kept for an hour) or 60 (kept for a day; the default).
    step: Option<u32>,
}

/// A requested period and its step.
struct RequestedPeriod {
    step: HistoryStep,
    from: Millis,
    to: Millis,
}

impl RequestedPeriod {
    fn parse(when: TimeQuery) -> Result<RequestedPeriod, Error> {
        let step = HistoryStep::parse(when.step)?;
        let now = store::now();
        let oldest = now.saturating_sub(step.retention());
        // Clamped to what can exist, so that the numbers fit into SQLite's integers.
        let from = when.from.unwrap_or(oldest).max(oldest);
        let to = when.to.unwrap_or(now).min(now);
        if when.from.zip(when.to).is_some_and(|(from, to)| from > to) {
            return Err(Error::BadRequest("from is after to".to_owned()));
        }
        Ok(RequestedPeriod { step, from, to })
    }
}

/// Returns the history of servants, including those of the last day that have ended.
pub async fn servants(
    State(app): State<Arc<App>>,
    Query(whose): Query<ServantHistoryQuery>,
    Extension(caller): Extension<Caller>,
) -> JsonResult<Vec<ServantHistory>> {
    let asked = RequestedPeriod::parse(TimeQuery { from: whose.from, to: whose.to, step: whose.step })?;
    let services = visible_services(&app, &caller)?;
    let filter = SeriesFilter {
        // The machine's history has an endpoint of its own.
        servant: whose.servant.as_deref(),
        service: whose.service.as_deref(),
        robot: whose.robot.as_deref(),
        told: services.as_deref().map(|services| EventVisibility { services, own_robot: caller.own_robot() }),
    };
    let mut found = app.state.recorded_series(filter, asked.from, SERVANTS)?;
    found.retain(|one| one.servant != recorder::THE_MACHINE);
    let mut left = MAX_SAMPLES;
    let mut told = Vec::new();
    for one in found {
        let history = history(&app, one, &asked, left)?;
        left -= history.figures.time.len();
        told.push(history);
        if left == 0 {
            return Err(Error::BadRequest(format!(
                "that is more than {MAX_SAMPLES} points in time; ask for one servant, one robot, or a shorter time \
                 (from, to)"
            )));
        }
    }
    Ok(Json(told))
}

/// Returns the services with samples that the caller may see, or `None` if it may see everything.
fn visible_services(app: &App, caller: &Caller) -> Result<Option<Vec<String>>, Error> {
    if caller.who.principal.sees_all() {
        return Ok(None);
    }
    let mut services = app.state.services_with_samples()?;
    services.retain(|service| caller.can_see(app, service));
    Ok(Some(services))
}

fn history(app: &App, one: RecordedSeries, asked: &RequestedPeriod, most: usize) -> Result<ServantHistory, Error> {
    let when = (asked.from, asked.to);
    let samples = app.state.samples(one.id, asked.step.seconds, when, most)?;
    // Before this one began, the robot had another servant.
    let lived = (asked.from.max(one.began), asked.to);
    Ok(ServantHistory {
        local: app.state.local_periods(&one.service, &one.robot, lived)?,
        figures: figures::servant_figures(&samples),
        step: asked.step.seconds,
        servant: one.servant,
        service: one.service,
        robot: one.robot,
        began: one.began,
        seen: one.seen,
    })
}

/// Returns the history of the machine.
pub async fn machine(State(app): State<Arc<App>>, Query(when): Query<TimeQuery>) -> JsonResult<MachineHistory> {
    let asked = RequestedPeriod::parse(when)?;
    let filter = SeriesFilter { servant: Some(recorder::THE_MACHINE), ..SeriesFilter::default() };
    let mut samples = Vec::new();
    for one in app.state.recorded_series(filter, asked.from, 1)? {
        let when = (asked.from, asked.to);
        samples = app.state.samples(one.id, asked.step.seconds, when, MAX_SAMPLES)?;
    }
    Ok(Json(MachineHistory { step: asked.step.seconds, figures: figures::machine_figures(&samples) }))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_asked_badly_is_refused_in_words() {
        let asked = |from, to, step| RequestedPeriod::parse(TimeQuery { from, to, step });
        let refused = |from, to, step| match asked(from, to, step) {
            Err(Error::BadRequest(words)) => words,
            other => panic!("{:?}", other.map(|asked| asked.from)),
        };
        assert!(refused(None, None, Some(7)).contains("step=10"));
        assert_eq!(refused(Some(2), Some(1), None), "from is after to");
        let all = asked(Some(0), Some(Millis::MAX), Some(10)).expect("what there is");
        assert!(all.to <= store::now() && all.to - all.from <= FINE.retention() + 1_000);
    }
}
