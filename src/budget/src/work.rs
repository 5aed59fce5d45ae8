//! Processor time as part of a budget: tasks that work for somebody are charged to its budget, and wait once it has
//! used up its share.
//!
//! ```text
//!   a poll of a task ──charge──▶ paid_at = max(paid_at, now) + spent / cores ──▶ beyond burst / cores from now: wait
//! ```

use std::fmt;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Duration;

use parking_lot::Mutex;
use rustix::time::{ClockId, clock_gettime};
use tokio::time::{Instant, Sleep, sleep};

use crate::{Budget, BudgetNode};

/// Processor time that the tasks of one budget may take.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WorkLimit {
    /// Average number of cores; more than 0.
    pub cores: f64,
    /// Processor time that may be taken at once after a time of rest.
    pub burst: Duration,
}

/// Processor time that was charged to a budget.
pub(crate) struct WorkAccount {
    limit: WorkLimit,
    state: Mutex<WorkState>,
}

struct WorkState {
    total: Duration,
    /// Time at which all that was charged is paid off, at the rate of the limit.
    paid_at: Instant,
}

impl WorkAccount {
    pub(crate) fn new(limit: WorkLimit) -> Self {
        Self { limit, state: Mutex::new(WorkState { total: Duration::ZERO, paid_at: Instant::now() }) }
    }

    fn charge(&self, spent: Duration, now: Instant) {
        let mut state = self.state.lock();
        state.total += spent;
        state.paid_at = state.paid_at.max(now) + spent.div_f64(self.limit.cores);
    }

    /// Returns the time until more may be taken; `None` if that is now.
    fn pause(&self, now: Instant) -> Option<Duration> {
        let debt = self.state.lock().paid_at.saturating_duration_since(now);
        debt.checked_sub(self.limit.burst.div_f64(self.limit.cores)).filter(|pause| !pause.is_zero())
    }

    pub(crate) fn total(&self) -> Duration {
        self.state.lock().total
    }
}

/// A task whose processor time is charged to a budget; made by [`Budget::meter`].
pub struct MeteredTask<F> {
    task: Pin<Box<F>>,
    /// Budget that pays; `None` if none of those above has a limit of processor time.
    payer: Option<Arc<BudgetNode>>,
    pause: Option<Pin<Box<Sleep>>>,
}

impl<F> MeteredTask<F> {
    pub(crate) fn new(task: F, budget: &Budget) -> Self {
        Self { task: Box::pin(task), payer: budget.find_payer().cloned(), pause: None }
    }
}

impl<F: Future> Future for MeteredTask<F> {
    type Output = F::Output;

    fn poll(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<F::Output> {
        let this = &mut *self;
        let Some(account) = this.payer.as_ref().and_then(|payer| payer.work.as_ref()) else {
            return this.task.as_mut().poll(context);
        };
        // Other tasks of the budget may have taken more during the pause.
        while let Some(pause) = this.pause.take().or_else(|| Some(Box::pin(sleep(account.pause(Instant::now())?)))) {
            let pause = this.pause.insert(pause);
            if pause.as_mut().poll(context).is_pending() {
                return Poll::Pending;
            }
            this.pause = None;
        }
        let before = thread_time();
        let polled = this.task.as_mut().poll(context);
        account.charge(thread_time().saturating_sub(before), Instant::now());
        polled
    }
}

impl<F> fmt::Debug for MeteredTask<F> {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.debug_struct("MeteredTask").field("payer", &self.payer).finish_non_exhaustive()
    }
}

/// Returns the processor time of this thread.
fn thread_time() -> Duration {
    Duration::try_from(clock_gettime(ClockId::ThreadCPUTime)).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    const LIMIT: WorkLimit = WorkLimit { cores: 0.1, burst: Duration::from_secs(2) };

    #[test]
    fn what_is_spent_beyond_the_burst_is_paid_off_at_the_rate() {
        let account = WorkAccount::new(LIMIT);
        let begin = Instant::now();
        let after = |seconds| begin + Duration::from_secs(seconds);
        account.charge(Duration::from_secs(2), begin);
        assert_eq!(account.pause(begin), None);
        account.charge(Duration::from_secs(1), begin);
        assert_eq!(account.pause(begin), Some(Duration::from_secs(10)));
        assert_eq!(account.pause(after(4)), Some(Duration::from_secs(6)));
        assert_eq!(account.pause(after(10)), None);
        // A long rest leaves no more than the burst.
        account.charge(Duration::from_secs(3), after(10_000));
        assert_eq!(account.pause(after(10_000)), Some(Duration::from_secs(10)));
        assert_eq!(account.total(), Duration::from_secs(6));
    }

    /// Uses the processor for this long.
    fn spin(time: Duration) {
        let until = thread_time() + time;
        while thread_time() < until {
            std::hint::spin_loop();
        }
    }

    /// Uses the processor at each of some polls.
    async fn work(polls: usize, each: Duration) {
        for _ in 0..polls {
            spin(each);
            tokio::task::yield_now().await;
        }
    }

    #[tokio::test(start_paused = true)]
    async fn a_task_that_works_too_much_waits_and_so_do_others_of_its_budget_alone() {
        let daemon = Budget::new("the daemon", 100);
        let limit = WorkLimit { cores: 0.1, burst: Duration::from_millis(20) };
        let servant = |name: &str| daemon.child_with_work(name, 100, limit);
        let (greedy, other) = (servant("greedy"), servant("other"));
        let began = Instant::now();
        // What its parts do is charged to it.
        greedy.child("a part of it", 10).meter(work(10, Duration::from_millis(10))).await;
        let took = began.elapsed();
        assert!(took >= Duration::from_millis(700), "100 ms at a tenth of a core took {took:?}");
        assert!(greedy.work_time() >= Duration::from_millis(100), "{:?}", greedy.work_time());
        assert_eq!((other.work_time(), daemon.work_time()), (Duration::ZERO, Duration::ZERO));
        let began = Instant::now();
        other.meter(work(1, Duration::from_millis(1))).await;
        daemon.meter(work(10, Duration::from_millis(10))).await;
        // The clock stands still but for those who wait.
        assert_eq!(began.elapsed(), Duration::ZERO);
        greedy.meter(async { spin(Duration::from_millis(40)) }).await;
        let began = Instant::now();
        greedy.meter(async {}).await;
        assert!(began.elapsed() >= Duration::from_millis(200), "its debt was not paid yet");
    }
}
