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

use crate::app::App;
use crate::{goals, recordings};

/// Between two looks at which servants there are.
const LOOK: Duration = Duration::from_secs(1);
/// Between two files of one servant that nobody has asked for.
const PAUSE: Duration = Duration::from_secs(60);

/// What is kept of each servant for when something goes wrong.
#[derive(Debug, Clone)]
pub struct BlackBoxOptions {
    /// So much; none: no boxes.
    pub span: Duration,
    /// Bytes of each servant's messages.
    pub memory: usize,
    /// Topics by name, or by what stands before a last `*`.
    pub topics: Vec<String>,
    /// Files at most; beyond, the oldest are removed.
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
    /// One file is written at a time: what is removed for it is decided by what there is.
    pub(crate) writing: tokio::sync::Mutex<()>,
}

#[derive(Default)]
struct Observed {
    kept: Option<Arc<BlackBox>>,
    goals: Option<Arc<Goals>>,
    /// When its last file was written that nobody had asked for.
    written: Option<Instant>,
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

    /// Whether a file of this servant's may be written unasked; the next one is so a minute later.
    fn is_due(&self, servant: &str) -> bool {
        let mut all = self.all.lock();
        let Some(observed) = all.get_mut(servant) else {
            return false;
        };
        let last = observed.written;
        let due = last.is_none_or(|written| written.elapsed() >= PAUSE);
        if due {
            observed.written = Some(Instant::now());
        }
        due
    }
}

/// Keeps them until the daemon ends; first, files go that nobody knows of.
pub async fn keep(app: Arc<App>) {
    recordings::sweep(&app).await;
    let mut answered = app.choreographer.answered();
    let mut looks = tokio::time::interval(LOOK);
    looks.set_missed_tick_behavior(MissedTickBehavior::Skip);
    loop {
        tokio::select! {
            _ = looks.tick() => look(&app).await,
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
async fn look(app: &Arc<App>) {
    let servants = app.choreographer.servants();
    let all = &app.observers.all;
    all.lock().retain(|id, observed| {
        if let Some(kept) = &observed.kept {
            kept.forget();
        }
        servants.iter().any(|handle| handle.id == *id)
    });
    for handle in servants {
        if all.lock().contains_key(&handle.id) {
            continue;
        }
        let Some(reach) = handle.reach() else {
            continue;
        };
        if let Some(observed) = observed(app, &handle, &*reach).await {
            all.lock().insert(handle.id.clone(), observed);
        }
    }
}

/// None where the servant is about to end.
async fn observed(app: &Arc<App>, handle: &Handle, reach: &dyn Reach) -> Option<Observed> {
    let mut observed = Observed::default();
    if !app.options.black_box.span.is_zero() {
        let options = app.options.black_box.clone();
        let options = BoxOptions {
            span: options.span,
            bytes: options.memory,
            budget: app.choreographer.memory().servant(&handle.id),
            wanted: Arc::new(move |topic| options.wants(topic)),
        };
        observed.kept = Some(Arc::new(BlackBox::of(seen(reach).await?, options)));
    }
    if !handle.revision.interface.actions.is_empty() {
        let goals = Arc::new(Goals::of(seen(reach).await?));
        goals::tell(app, handle, &goals);
        observed.goals = Some(goals);
    }
    Some(observed)
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
    if !app.observers.is_due(&answered.servant) {
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
