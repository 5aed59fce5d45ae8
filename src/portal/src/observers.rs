//! Who hears servants beside their robots for as long as they live: black boxes, the last seconds of what flows there, which are written into a
//! file ([`crate::recordings`]) when a robot was answered later than it accepts; and what becomes of goals ([`crate::goals`]).

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use choreographer::{Answered, Handle};
use observe::{BlackBox, BoxOptions, Goals, Seen};
use parking_lot::Mutex;
use reach::Reach;
use tokio::sync::broadcast::error::RecvError;
use tokio::time::{Instant, MissedTickBehavior};
use tokio_util::task::AbortOnDropHandle;

use crate::app::App;
use crate::errors::Error;
use crate::{goals, recordings};

/// Between two looks at which servants there are.
const LOOK: Duration = Duration::from_secs(1);
/// Between two files of one servant that nobody has asked for.
const PAUSE: Duration = Duration::from_secs(60);
/// Between two files of one servant that somebody asks for.
const TAKEN: Duration = Duration::from_secs(5);
/// So long it may take to join a servant's ROS; then it is tried again.
const JOINS: Duration = Duration::from_secs(60);
/// Between two tries.
const TRIES: Duration = Duration::from_secs(5);

/// What is kept of each servant for when something goes wrong.
#[derive(Debug, Clone)]
pub struct BlackBoxOptions {
    /// So much; none: no boxes.
    pub span: Duration,
    /// Bytes of each servant's messages, with what each takes beside its own.
    pub memory: usize,
    /// Topics by name, or by what stands before a last `*`.
    pub topics: Vec<String>,
    /// Files at most; beyond, the oldest are removed of the service that has most.
    pub files: usize,
    /// Bytes of all files at most.
    pub disk: u64,
}

impl BlackBoxOptions {
    fn wants(&self, topic: &str) -> bool {
        self.topics
            .iter()
            .any(|pattern| match pattern.strip_suffix('*') {
                Some(begins) => topic.starts_with(begins),
                None => topic == pattern,
            })
    }
}

/// Those of all servants.
#[derive(Default)]
pub struct Observers {
    all: Mutex<HashMap<String, Observed>>,
    /// When a file was written last that nobody had asked for, by servant; of robots without names by service, since each of their
    /// connections has a servant of its own.
    written: Mutex<HashMap<String, Instant>>,
    /// One file is written at a time: what is removed for it is decided by what there is.
    pub(crate) writing: tokio::sync::Mutex<()>,
}

#[derive(Default)]
struct Observed {
    kept: Option<Arc<BlackBox>>,
    goals: Option<Arc<Goals>>,
    /// When a file was asked for last.
    taken: Option<Instant>,
    /// Joins the servant's ROS; ends with the rest.
    _joining: Option<AbortOnDropHandle<()>>,
}

impl Observers {
    /// The black box of a servant.
    pub(crate) fn black_box(&self, servant: &str) -> Option<Arc<BlackBox>> {
        self.all.lock().get(servant)?.kept.clone()
    }

    /// Goals that a servant was sent; none where it has no actions.
    pub(crate) fn goals(&self, servant: &str) -> Option<Arc<Goals>> {
        self.all.lock().get(servant)?.goals.clone()
    }

    /// Refuses who asks for a file of this servant again and again.
    pub(crate) fn may_take(&self, servant: &str) -> Result<(), Error> {
        let mut all = self.all.lock();
        let observed = all.get_mut(servant).filter(|one| one.kept.is_some());
        let Some(observed) = observed else {
            return Err(Error::NoBlackBox(servant.to_owned()));
        };
        match left(observed.taken, TAKEN) {
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

    /// Whether a file of this servant's may be written unasked; the next one is so a minute later.
    fn is_due(&self, handle: &Handle) -> bool {
        // Of one that is not heard there is nothing to write.
        let is_heard = self.black_box(&handle.id).is_some();
        let whose = match handle.robot.starts_with('~') {
            true => format!("service {}", handle.service()),
            false => handle.id.clone(),
        };
        is_heard && due(&mut self.written.lock(), whose)
    }
}

/// How long it is until something may be done again.
fn left(last: Option<Instant>, pause: Duration) -> Option<Duration> {
    let left = pause.checked_sub(last?.elapsed())?;
    (!left.is_zero()).then_some(left)
}

/// Whether it is long enough ago that something was done of somebody; if so, it is done now.
fn due(written: &mut HashMap<String, Instant>, whose: String) -> bool {
    written.retain(|_, last| left(Some(*last), PAUSE).is_some());
    let is_due = !written.contains_key(&whose);
    if is_due {
        written.insert(whose, Instant::now());
    }
    is_due
}

/// Keeps them until the daemon ends; first, files go that nobody knows of.
pub async fn keep(app: Arc<App>) {
    recordings::sweep(&app).await;
    let mut answered = app.choreographer.answered();
    let mut looks = tokio::time::interval(LOOK);
    looks.set_missed_tick_behavior(MissedTickBehavior::Skip);
    loop {
        tokio::select! {
            _ = looks.tick() => look(&app),
            answered = answered.recv() => match answered {
                Ok(answered) => late(&app, &answered),
                // Of those that were not heard one may have been late; the next one will be heard.
                Err(RecvError::Lagged(_)) => {}
                Err(RecvError::Closed) => return,
            },
            () = app.ending.cancelled() => return,
        }
    }
}

/// Begins with servants that are new, and forgets those that have ended.
fn look(app: &Arc<App>) {
    let servants = app.choreographer.servants();
    let mut all = app.observers.all.lock();
    all.retain(|id, observed| {
        if let Some(kept) = &observed.kept {
            kept.forget();
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
        // One that joins slowly keeps nobody else waiting.
        let joining = tokio::spawn(join(Arc::clone(app), handle, reach));
        let observed = Observed {
            _joining: Some(AbortOnDropHandle::new(joining)),
            ..Observed::default()
        };
        all.insert(id, observed);
    }
}

/// Begins to hear a servant, once that can be.
async fn join(app: Arc<App>, handle: Arc<Handle>, reach: Arc<dyn Reach>) {
    let joins = || observed(&app, &handle, &*reach);
    let Some((kept, goals)) = app.ending.run_until_cancelled(joined(joins)).await else {
        return;
    };
    let mut all = app.observers.all.lock();
    let Some(observed) = all.get_mut(&handle.id) else {
        return;
    };
    if let Some(goals) = &goals {
        goals::tell(&app, &handle, goals);
    }
    (observed.kept, observed.goals) = (kept, goals);
}

/// What comes of joining, which is tried until it succeeds.
async fn joined<T, Joins: Future<Output = Option<T>>>(mut joins: impl FnMut() -> Joins) -> T {
    loop {
        if let Ok(Some(joined)) = tokio::time::timeout(JOINS, joins()).await {
            return joined;
        }
        tokio::time::sleep(TRIES).await;
    }
}

/// What hears a servant.
type Hearing = (Option<Arc<BlackBox>>, Option<Arc<Goals>>);

/// None where the servant is about to end.
async fn observed(app: &App, handle: &Handle, reach: &dyn Reach) -> Option<Hearing> {
    let mut kept = None;
    if !app.options.black_box.span.is_zero() {
        let options = app.options.black_box.clone();
        let options = BoxOptions {
            span: options.span,
            bytes: options.memory,
            budget: app.choreographer.memory().servant(&handle.id),
            wanted: Arc::new(move |topic| options.wants(topic)),
        };
        kept = Some(Arc::new(BlackBox::of(seen(reach).await?, options)));
    }
    let mut goals = None;
    if !handle.revision.interface.actions.is_empty() {
        goals = Some(Arc::new(Goals::of(seen(reach).await?)));
    }
    Some((kept, goals))
}

/// The ROS of a servant, to observe.
pub(crate) async fn seen(reach: &dyn Reach) -> Option<Seen> {
    let looked = reach.look_inside().await.ok()?;
    Some(Seen {
        bus: Arc::clone(&looked.bus),
        registry: Arc::clone(&looked.registry),
        held: Box::new(looked),
    })
}

/// Writes a file where the request took longer than its robot accepts.
fn late(app: &Arc<App>, answered: &Answered) {
    if app.options.black_box.span.is_zero() {
        return;
    }
    let Ok(handle) = app.choreographer.servant(&answered.servant) else {
        return;
    };
    let accepts = app.choreographer.accepts(&handle);
    let Some(accepts) = accepts.filter(|accepts| answered.total > *accepts) else {
        return;
    };
    if !app.observers.is_due(&handle) {
        return;
    }
    let why = format!(
        "a request took {:.0} ms, and its robot accepts {accepts:.0} ms",
        answered.total
    );
    let app = Arc::clone(app);
    app.sessions.clone().spawn(async move {
        if let Err(error) = recordings::write(&app, &handle, &why).await {
            let about = recordings::about(&handle);
            let journal = app.choreographer.journal();
            journal.warning(recordings::NOT_RECORDED, &error.in_a_line(), &about);
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
                    // It says no.
                    2 => None,
                    number => Some(number),
                }
            }
        };
        let began = Instant::now();
        assert_eq!(joined(joins).await, 3);
        assert_eq!(began.elapsed(), JOINS + TRIES * 2);
    }

    #[tokio::test(start_paused = true)]
    async fn files_that_nobody_asked_for_are_a_minute_apart() {
        let mut written = HashMap::new();
        let mut is_due = |whose: &str| due(&mut written, whose.to_owned());
        assert!(is_due("s1") && is_due("s2") && !is_due("s1"));
        tokio::time::advance(PAUSE / 2).await;
        assert!(!is_due("s1") && is_due("s3"));
        tokio::time::advance(PAUSE / 2).await;
        assert!(is_due("s1") && !is_due("s3"));
        // What is over is not kept.
        assert_eq!(written.len(), 2);
    }

    #[tokio::test(start_paused = true)]
    async fn whoever_asks_for_files_again_and_again_waits() {
        assert_eq!(left(None, TAKEN), None);
        let now = Some(Instant::now());
        assert_eq!(left(now, TAKEN), Some(TAKEN));
        tokio::time::advance(TAKEN).await;
        assert_eq!(left(now, TAKEN), None);
        let observers = Observers::default();
        let refused = observers.may_take("s1").expect_err("nothing is kept");
        assert!(matches!(refused, Error::NoBlackBox(_)), "{refused}");
    }
}
