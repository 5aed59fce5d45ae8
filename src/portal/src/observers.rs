//! Observers of servants, running for as long as the servants do: black boxes, whose last seconds are written to a
//! file ([`crate::recordings`]) when a robot was answered later than it accepts, and goal monitors
//! ([`crate::goals`]).

pub mod servants;

use std::sync::Arc;
use std::time::Duration;

use choreographer::{AnsweredRequest, Handle};
use observe::{BlackBox, BlackBoxSettings, GoalMonitor, ObservedServant};
use reach::Reach;
use tokio::sync::broadcast::error::RecvError;
use tokio::time::MissedTickBehavior;
use tokio_util::task::AbortOnDropHandle;

use crate::app::App;
use crate::{goals, recordings};
use servants::ServantObservers;

/// Interval at which new and ended servants are looked for.
const LOOK: Duration = Duration::from_secs(1);
/// Timeout for joining a servant's ROS; then it is tried again.
const JOINS: Duration = Duration::from_secs(60);
/// Delay between attempts.
const TRIES: Duration = Duration::from_secs(5);

/// Runs the observers until the daemon stops, after removing orphaned files.
pub async fn run_observers(app: Arc<App>) {
    recordings::sweep(&app).await;
    let mut answered = app.choreographer.subscribe_answers();
    let mut looks = tokio::time::interval(LOOK);
    looks.set_missed_tick_behavior(MissedTickBehavior::Skip);
    loop {
        tokio::select! {
            _ = looks.tick() => update_observers(&app),
            answered = answered.recv() => match answered {
                Ok(answered) => record_late_answer(&app, &answered),
                // A late answer may be among those missed; the next one will be seen.
                Err(RecvError::Lagged(_)) => {}
                Err(RecvError::Closed) => return,
            },
            () = app.ending.cancelled() => return,
        }
    }
}

/// Starts observing new servants and drops observers of ended ones.
fn update_observers(app: &Arc<App>) {
    let servants = app.choreographer.servants();
    let mut all = app.observers.all.lock();
    all.retain(|id, observed| {
        if let Some(kept) = &observed.kept {
            kept.evict();
        }
        servants.iter().any(|handle| handle.id == *id)
    });
    for handle in servants {
        if all.contains_key(&handle.id) {
            continue;
        }
        let Some(reach) = handle.reach() else {
            continue;
        };
        let id = handle.id.clone();
        // A servant that is slow to join delays no other.
        let joining = tokio::spawn(start_observing(Arc::clone(app), handle, reach));
        let observed =
            ServantObservers { _joining: Some(AbortOnDropHandle::new(joining)), ..ServantObservers::default() };
        all.insert(id, observed);
    }
}

/// Starts observing a servant once its ROS is available.
async fn start_observing(app: Arc<App>, handle: Arc<Handle>, reach: Arc<dyn Reach>) {
    let joins = || start_observers(&app, &handle, &*reach);
    let Some((kept, goals)) = app.ending.run_until_cancelled(retry_until_ready(joins)).await else {
        return;
    };
    let mut all = app.observers.all.lock();
    let Some(observed) = all.get_mut(&handle.id) else {
        return;
    };
    if let Some(goals) = &goals {
        goals::report_ended_goals(&app, &handle, goals);
    }
    (observed.kept, observed.goals) = (kept, goals);
}

/// Repeats `joins` until it succeeds.
async fn retry_until_ready<T, Joins: Future<Output = Option<T>>>(mut joins: impl FnMut() -> Joins) -> T {
    loop {
        if let Ok(Some(joined)) = tokio::time::timeout(JOINS, joins()).await {
            return joined;
        }
        tokio::time::sleep(TRIES).await;
    }
}

/// Observers started for a servant.
type StartedObservers = (Option<Arc<BlackBox>>, Option<Arc<GoalMonitor>>);

/// Returns `None` if the servant is about to end.
async fn start_observers(app: &App, handle: &Handle, reach: &dyn Reach) -> Option<StartedObservers> {
    let mut kept = None;
    if !app.options.black_box.span.is_zero() {
        let options = app.options.black_box.clone();
        let options = BlackBoxSettings {
            span: options.span,
            bytes: options.memory,
            budget: app.choreographer.memory().servant(&handle.id),
            wanted: Arc::new(move |topic| options.matches_topic(topic)),
        };
        kept = Some(Arc::new(BlackBox::start(observed_servant(reach).await?, options)));
    }
    let mut goals = None;
    if !handle.revision.interface.actions.is_empty() {
        goals = Some(Arc::new(GoalMonitor::start(observed_servant(reach).await?)));
    }
    Some((kept, goals))
}

/// Joins a servant's ROS in order to observe it.
pub(crate) async fn observed_servant(reach: &dyn Reach) -> Option<ObservedServant> {
    let looked = reach.open_inside().await.ok()?;
    Some(ObservedServant { bus: looked.bus, registry: looked.registry, held: looked.held })
}

/// Records the servant if the request took longer than its robot accepts.
fn record_late_answer(app: &Arc<App>, answered: &AnsweredRequest) {
    if app.options.black_box.span.is_zero() {
        return;
    }
    let Ok(handle) = app.choreographer.servant(&answered.servant) else {
        return;
    };
    let accepts = app.choreographer.accepted_time(&handle);
    let Some(accepts) = accepts.filter(|accepts| answered.total > *accepts) else {
        return;
    };
    if !app.observers.is_due(&handle) {
        return;
    }
    let why = format!("a request took {:.0} ms, but its robot accepts at most {accepts:.0} ms", answered.total);
    let app = Arc::clone(app);
    app.sessions.clone().spawn(async move {
        if let Err(error) = recordings::write_recording(&app, &handle, &why).await {
            let about = recordings::event_subject(&handle);
            let journal = app.choreographer.journal();
            journal.warning(recordings::NOT_RECORDED, &error.one_line(), &about);
        }
    });
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;

    use tokio::time::Instant;

    use super::*;

    #[tokio::test(start_paused = true)]
    async fn a_servant_that_cannot_be_joined_is_tried_again() {
        let tries = Cell::new(0);
        let joins = || {
            tries.set(tries.get() + 1);
            let number = tries.get();
            async move {
                match number {
                    // It does not answer.
                    1 => std::future::pending().await,
                    // It refuses.
                    2 => None,
                    number => Some(number),
                }
            }
        };
        let began = Instant::now();
        assert_eq!(retry_until_ready(joins).await, 3);
        assert_eq!(began.elapsed(), JOINS + TRIES * 2);
    }
}
