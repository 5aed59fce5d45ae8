//! What servants and the machine did: recorded every ten seconds, kept as that for an hour and by the minute for a day.

mod figures;
mod recorder;

use std::sync::Arc;

use api::Millis;
use api::history::{MachineHistory, ServantHistory};
use axum::extract::State;
use axum::{Extension, Json};
use serde::Deserialize;
use store::{RecordedFilter, RecordedLine, Told};
use utoipa::IntoParams;

use crate::api_v1::Answer;
use crate::app::App;
use crate::errors::Error;
use crate::guard::Caller;
use crate::query::Query;
pub use recorder::keep;

/// Times that one answer has, over all servants.
const MOST: usize = 20_000;
/// Servants that are looked at for one answer.
const SERVANTS: u32 = 1_000;

/// How finely is recorded, and for how long.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Step {
    seconds: u32,
    /// Of them.
    kept: u32,
}

const FINE: Step = Step {
    seconds: 10,
    kept: 360,
};
const COARSE: Step = Step {
    seconds: 60,
    kept: 1_440,
};

impl Step {
    fn millis(self) -> Millis {
        Millis::from(self.seconds) * 1_000
    }

    /// Milliseconds for which it is kept.
    fn kept(self) -> Millis {
        self.millis() * Millis::from(self.kept)
    }

    fn asked(seconds: Option<u32>) -> Result<Step, Error> {
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

/// Of when.
#[derive(Debug, Clone, Copy, Deserialize, IntoParams)]
pub struct When {
    /// Milliseconds since 1970; as long ago as the step is kept by default.
    from: Option<u64>,
    /// Milliseconds since 1970; now by default.
    to: Option<u64>,
    /// Seconds: 10, which are kept for an hour, or 60, kept for a day and the default.
    step: Option<u32>,
}

/// Whose, and of when.
#[derive(Debug, Deserialize, IntoParams)]
pub struct Whose {
    /// Only of this servant.
    servant: Option<String>,
    /// Only of servants of this service.
    service: Option<String>,
    /// Only of servants of this robot.
    robot: Option<String>,
    /// Milliseconds since 1970; as long ago as the step is kept by default.
    from: Option<u64>,
    /// Milliseconds since 1970; now by default.
    to: Option<u64>,
    /// Seconds: 10, which are kept for an hour, or 60, kept for a day and the default.
    step: Option<u32>,
}

/// A time that was asked for, and its step.
struct Asked {
    step: Step,
    from: Millis,
    to: Millis,
}

impl Asked {
    fn of(when: When) -> Result<Asked, Error> {
        let step = Step::asked(when.step)?;
        let now = store::now();
        let oldest = now.saturating_sub(step.kept());
        // What is older than what is kept, or to come, is not there: SQLite's numbers need not hold it.
        let from = when.from.unwrap_or(oldest).max(oldest);
        let to = when.to.unwrap_or(now).min(now);
        if when.from.zip(when.to).is_some_and(|(from, to)| from > to) {
            return Err(Error::BadRequest("from is after to".to_owned()));
        }
        Ok(Asked { step, from, to })
    }
}

/// What servants did, those of the last day that have ended included.
pub async fn servants(
    State(app): State<Arc<App>>,
    Query(whose): Query<Whose>,
    Extension(caller): Extension<Caller>,
) -> Answer<Vec<ServantHistory>> {
    let asked = Asked::of(When {
        from: whose.from,
        to: whose.to,
        step: whose.step,
    })?;
    let services = services_seen(&app, &caller)?;
    let filter = RecordedFilter {
        // The machine's has an address of its own.
        servant: whose.servant.as_deref(),
        service: whose.service.as_deref(),
        robot: whose.robot.as_deref(),
        told: services.as_deref().map(|services| Told {
            services,
            own_robot: caller.own_robot(),
        }),
    };
    let mut found = app.state.recorded(filter, asked.from, SERVANTS)?;
    found.retain(|one| one.servant != recorder::THE_MACHINE);
    let mut left = MOST;
    let mut told = Vec::new();
    for one in found {
        let history = history(&app, one, &asked, left)?;
        left -= history.figures.time.len();
        told.push(history);
        if left == 0 {
            return Err(Error::BadRequest(format!(
                "that is more than {MOST} times; ask for one servant, one robot, or a shorter time (from, to)"
            )));
        }
    }
    Ok(Json(told))
}

/// Services with samples that the caller may see, by name; none where it sees all that there is.
fn services_seen(app: &App, caller: &Caller) -> Result<Option<Vec<String>>, Error> {
    if caller.who.principal.sees_all() {
        return Ok(None);
    }
    let mut services = app.state.services_recorded()?;
    services.retain(|service| caller.sees(app, service));
    Ok(Some(services))
}

fn history(
    app: &App,
    one: RecordedLine,
    asked: &Asked,
    most: usize,
) -> Result<ServantHistory, Error> {
    let when = (asked.from, asked.to);
    let samples = app.state.samples(one.id, asked.step.seconds, when, most)?;
    // While it was not there another servant of the robot's was.
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

/// What the machine did.
pub async fn machine(
    State(app): State<Arc<App>>,
    Query(when): Query<When>,
) -> Answer<MachineHistory> {
    let asked = Asked::of(when)?;
    let filter = RecordedFilter {
        servant: Some(recorder::THE_MACHINE),
        ..RecordedFilter::default()
    };
    let mut samples = Vec::new();
    for one in app.state.recorded(filter, asked.from, 1)? {
        let when = (asked.from, asked.to);
        samples = app.state.samples(one.id, asked.step.seconds, when, MOST)?;
    }
    Ok(Json(MachineHistory {
        step: asked.step.seconds,
        figures: figures::machine_figures(&samples),
    }))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_asked_badly_is_refused_in_words() {
        let asked = |from, to, step| Asked::of(When { from, to, step });
        let refused = |from, to, step| match asked(from, to, step) {
            Err(Error::BadRequest(words)) => words,
            other => panic!("{:?}", other.map(|asked| asked.from)),
        };
        assert!(refused(None, None, Some(7)).contains("step=10"));
        assert_eq!(refused(Some(2), Some(1), None), "from is after to");
        let all = asked(Some(0), Some(Millis::MAX), Some(10)).expect("what there is");
        assert!(all.to <= store::now() && all.to - all.from <= FINE.kept() + 1_000);
    }
}
