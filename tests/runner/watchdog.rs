//! Reports stories that take long, and ends a run that hangs, because nothing else would tell which story never ends.

use std::collections::BTreeMap;
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::{Duration, Instant};

use support::patience;

/// Time after which a story is reported, and the interval of further reports.
const REPORT_INTERVAL: Duration = Duration::from_secs(300);
/// Maximum factor by which a slow machine extends the time limit of a story: a complete check has an hour and a half.
const SLOWEST: f64 = 2.0;
/// Interval between two checks.
const PERIOD: Duration = Duration::from_secs(10);
/// A thread that watches the running stories until drop.
pub(super) struct Watchdog {
    state: Arc<WatchdogState>,
}

#[derive(Default)]
struct WatchdogState {
    under_way: Mutex<RunningStories>,
    ended: Condvar,
}

#[derive(Default)]
struct RunningStories {
    stories: BTreeMap<&'static str, WatchedStory>,
    is_over: bool,
}

struct WatchedStory {
    since: Instant,
    /// Number of reports so far.
    named: u32,
}

impl Watchdog {
    /// Starts to watch for stories that take longer than `limit` on an unloaded machine.
    pub(super) fn start(limit: Duration) -> Watchdog {
        let state = Arc::new(WatchdogState::default());
        let watching = state.clone();
        std::thread::spawn(move || watching.watch(limit));
        Watchdog { state }
    }

    /// Records that a story has started.
    pub(super) fn begin(&self, story: &'static str) {
        let watched = WatchedStory { since: Instant::now(), named: 0 };
        self.state.lock().stories.insert(story, watched);
    }

    /// Records that a story has ended.
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

impl WatchdogState {
    fn lock(&self) -> std::sync::MutexGuard<'_, RunningStories> {
        self.under_way.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn watch(&self, limit: Duration) {
        let mut under_way = self.lock();
        while !under_way.is_over {
            let too_long = limit.mul_f64(patience::busiest().clamp(1.0, SLOWEST));
            if let Some(story) = under_way.report_long_stories(Instant::now(), too_long) {
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

impl RunningStories {
    /// Reports stories that take long; returns a story that takes too long.
    fn report_long_stories(&mut self, now: Instant, too_long: Duration) -> Option<&'static str> {
        for (story, watched) in &mut self.stories {
            let time = now.duration_since(watched.since);
            if time > too_long {
                return Some(story);
            }
            if time > REPORT_INTERVAL * (watched.named + 1) {
                watched.named += 1;
                println!("still being told after {} s: {story}", time.as_secs());
            }
        }
        None
    }
}
