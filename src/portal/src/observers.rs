//! Observers of servants, running for as long as the servants do: black boxes, whose last seconds are written to a
//! file ([`crate::recordings`]) when a robot was answered later than it accepts, and goal monitors
//! ([`crate::goals`]).

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use choreographer::{AnsweredRequest, Handle};
use observe::{BlackBox, BlackBoxSettings, GoalMonitor, ObservedServant};
use parking_lot::Mutex;
use reach::Reach;
use tokio::sync::broadcast::error::RecvError;
use tokio::time::{Instant, MissedTickBehavior};
use tokio_util::task::AbortOnDropHandle;

use crate::app::App;
use crate::errors::Error;
use crate::{goals, recordings};

/// Interval at which new and ended servants are looked for.
const LOOK: Duration = Duration::from_secs(1);
/// Minimum interval between two automatic recordings of a servant.
const PAUSE: Duration = Duration::from_secs(60);
/// Minimum interval between two requested recordings of a servant.
const TAKEN: Duration = Duration::from_secs(5);
/// Timeout for joining a servant's ROS; then it is tried again.
const JOINS: Duration = Duration::from_secs(60);
/// Delay between attempts.
const TRIES: Duration = Duration::from_secs(5);

/// Black box settings of the configuration.
#[derive(Debug, Clone)]
pub struct BlackBoxOptions {
    /// How far back messages are kept; zero disables black boxes.
    pub span: Duration,
    /// Memory limit per servant in bytes, including the overhead per message.
    pub memory: usize,
    /// Topics to record: names, or prefixes ending in `*`.
    pub topics: Vec<String>,
    /// Maximum number of files; beyond it, the service with most files loses its oldest.
    pub files: usize,
    /// Maximum size of all files in bytes.
    pub disk: u64,
}

impl BlackBoxOptions {
    fn matches_topic(&self, topic: &str) -> bool {
        self.topics
            .iter()
            .any(|pattern| match pattern.strip_suffix('*') {
                Some(begins) => topic.starts_with(begins),
                None => topic == pattern,
            })
    }
}

/// Observers of all servants.
#[derive(Default)]
pub struct Observers {
    all: Mutex<HashMap<String, ServantObservers>>,
    /// Time of the last automatic recording, by servant or, for nameless robots, by service, because each of their
    /// connections has a servant of its own.
    written: Mutex<HashMap<String, Instant>>,
    /// Held while a file is written: which files are removed for it depends on those that exist.
    pub(crate) writing: tokio::sync::Mutex<()>,
}

#[derive(Default)]
struct ServantObservers {
    kept: Option<Arc<BlackBox>>,
    goals: Option<Arc<GoalMonitor>>,
    /// Time of the last requested recording.
    taken: Option<Instant>,
    /// Task that joins the servant's ROS; aborted when dropped.
    _joining: Option<AbortOnDropHandle<()>>,
}

impl Observers {
    /// Returns the black box of a servant.
    pub(crate) fn black_box(&self, servant: &str) -> Option<Arc<BlackBox>> {
        self.all.lock().get(servant)?.kept.clone()
    }

    /// Returns the goal monitor of a servant; `None` if the servant has no actions.
    pub(crate) fn goals(&self, servant: &str) -> Option<Arc<GoalMonitor>> {
        self.all.lock().get(servant)?.goals.clone()
    }

    /// Refuses requests for recordings of this servant that follow too closely.
    pub(crate) fn check_take(&self, servant: &str) -> Result<(), Error> {
        let mut all = self.all.lock();
        let observed = all.get_mut(servant).filter(|one| one.kept.is_some());
        let Some(observed) = observed else {
            return Err(Error::NoBlackBox(servant.to_owned()));
        };
        match remaining(observed.taken, TAKEN) {
            Some(left) => Err(Error::RecordedLately {
                servant: servant.to_owned(),
                again: left.as_secs() + 1,
            }),
            None => {
                observed.taken = Some(Instant::now());
                Ok(())
            }
        }
    }

    /// Returns true if an automatic recording of this servant may be written; the next one may be a minute later.
    fn is_due(&self, handle: &Handle) -> bool {
        // Without a black box there is nothing to write.
        let is_heard = self.black_box(&handle.id).is_some();
        let whose = if handle.robot.starts_with('~') {
            format!("service {}", handle.service())
        } else {
            handle.id.clone()
        };
        is_heard && claim_interval(&mut self.written.lock(), whose)
    }
}

/// Returns the time left until something may be done again, if any.
fn remaining(last: Option<Instant>, pause: Duration) -> Option<Duration> {
    let left = pause.checked_sub(last?.elapsed())?;
    (!left.is_zero()).then_some(left)
}

/// Returns true if the last recording is long enough ago, and marks a new one.
fn claim_interval(written: &mut HashMap<String, Instant>, whose: String) -> bool {
    written.retain(|_, last| remaining(Some(*last), PAUSE).is_some());
    let is_due = !written.contains_key(&whose);
    if is_due {
        written.insert(whose, Instant::now());
    }
    is_due
}

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
        let observed = ServantObservers {
            _joining: Some(AbortOnDropHandle::new(joining)),
            ..ServantObservers::default()
        };
        all.insert(id, observed);
    }
}

/// Starts observing a servant once its ROS is available.
async fn start_observing(app: Arc<App>, handle: Arc<Handle>, reach: Arc<dyn Reach>) {
    let joins = || start_observers(&app, &handle, &*reach);
    let Some((kept, goals)) = app
        .ending
        .run_until_cancelled(retry_until_ready(joins))
        .await
    else {
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
async fn retry_until_ready<T, Joins: Future<Output = Option<T>>>(
    mut joins: impl FnMut() -> Joins,
) -> T {
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
async fn start_observers(
    app: &App,
    handle: &Handle,
    reach: &dyn Reach,
) -> Option<StartedObservers> {
    let mut kept = None;
    if !app.options.black_box.span.is_zero() {
        let options = app.options.black_box.clone();
        let options = BlackBoxSettings {
            span: options.span,
            bytes: options.memory,
            budget: app.choreographer.memory().servant(&handle.id),
            wanted: Arc::new(move |topic| options.matches_topic(topic)),
        };
        kept = Some(Arc::new(BlackBox::start(
            observed_servant(reach).await?,
            options,
        )));
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
    Some(ObservedServant {
        bus: Arc::clone(&looked.bus),
        registry: Arc::clone(&looked.registry),
        held: Box::new(looked),
    })
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
    let why = format!(
        "a request took {:.0} ms, but its robot accepts at most {accepts:.0} ms",
        answered.total
    );
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

    #[tokio::test(start_paused = true)]
    async fn files_that_nobody_asked_for_are_a_minute_apart() {
        let mut written = HashMap::new();
        let mut is_due = |whose: &str| claim_interval(&mut written, whose.to_owned());
        assert!(is_due("s1") && is_due("s2") && !is_due("s1"));
        tokio::time::advance(PAUSE / 2).await;
        assert!(!is_due("s1") && is_due("s3"));
        tokio::time::advance(PAUSE / 2).await;
        assert!(is_due("s1") && !is_due("s3"));
        // Expired entries are removed.
        assert_eq!(written.len(), 2);
    }

    #[tokio::test(start_paused = true)]
    async fn whoever_asks_for_files_again_and_again_waits() {
        assert_eq!(remaining(None, TAKEN), None);
        let now = Some(Instant::now());
        assert_eq!(remaining(now, TAKEN), Some(TAKEN));
        tokio::time::advance(TAKEN).await;
        assert_eq!(remaining(now, TAKEN), None);
        let observers = Observers::default();
        let refused = observers.check_take("s1").expect_err("nothing is kept");
        assert!(matches!(refused, Error::NoBlackBox(_)), "{refused}");
    }
}
