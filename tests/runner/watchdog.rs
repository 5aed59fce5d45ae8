//! Names stories that take long, and ends a run that hangs: by its name a story that never ends can be found, and nothing else would say it.

use std::collections::BTreeMap;
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::{Duration, Instant};

use support::patience;

/// After this time a story is named, and again each time that it has passed once more.
const LONG: Duration = Duration::from_secs(300);
/// On a machine that is slower than this, a story that takes as many times as long has no end all the same: a whole check has an hour and a half.
const SLOWEST: f64 = 2.0;
/// Time between two looks.
const PERIOD: Duration = Duration::from_secs(10);
/// The stories that are being told, watched by a thread of its own until it is dropped.
pub(super) struct Watchdog {
    state: Arc<State>,
}

#[derive(Default)]
struct State {
    under_way: Mutex<UnderWay>,
    ended: Condvar,
}

#[derive(Default)]
struct UnderWay {
    stories: BTreeMap<&'static str, Watched>,
    is_over: bool,
}

struct Watched {
    since: Instant,
    /// How often it was named.
    named: u32,
}

impl Watchdog {
    /// Begins to watch for stories that take longer than `limit` on a machine that is as fast as it can be.
    pub(super) fn start(limit: Duration) -> Watchdog {
        let state = Arc::new(State::default());
        let watching = state.clone();
        std::thread::spawn(move || watching.watch(limit));
        Watchdog { state }
    }

    /// Tells that a story begins.
    pub(super) fn begin(&self, story: &'static str) {
        let watched = Watched {
            since: Instant::now(),
            named: 0,
        };
        self.state.lock().stories.insert(story, watched);
    }

    /// Tells that a story has ended.
    pub(super) fn end(&self, story: &'static str) {
        self.state.lock().stories.remove(story);
    }
}

impl Drop for Watchdog {
    fn drop(&mut self) {
        self.state.lock().is_over = true;
        self.state.ended.notify_all();
    }
}

impl State {
    fn lock(&self) -> std::sync::MutexGuard<'_, UnderWay> {
        self.under_way
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
    }

    fn watch(&self, limit: Duration) {
        let mut under_way = self.lock();
        while !under_way.is_over {
            let too_long = limit.mul_f64(patience::busiest().clamp(1.0, SLOWEST));
            if let Some(story) = under_way.name_long_ones(Instant::now(), too_long) {
                println!(
                    "== failed: {story} has no end: it is being told for more than {} s, and the run ends here",
                    too_long.as_secs()
                );
                std::process::exit(1);
            }
            let waited = self.ended.wait_timeout(under_way, limit.min(PERIOD));
            under_way = waited.unwrap_or_else(PoisonError::into_inner).0;
        }
    }
}

impl UnderWay {
    /// Prints the names of those that take long; returns one that takes too long.
    fn name_long_ones(&mut self, now: Instant, too_long: Duration) -> Option<&'static str> {
        for (story, watched) in &mut self.stories {
            let time = now.duration_since(watched.since);
            if time > too_long {
                return Some(story);
            }
            if time > LONG * (watched.named + 1) {
                watched.named += 1;
                println!("still being told after {} s: {story}", time.as_secs());
            }
        }
        None
    }
}
