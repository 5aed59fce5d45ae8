//! Periodic work on many servants in parallel: one that does not answer delays no other.

use std::collections::HashMap;
use std::future::Future;

use tokio::task::{Id, JoinSet};

/// Maximum number of concurrent visits; more servants wait for the next round.
const AT_ONCE: usize = 64;

/// Visits to servants in progress, at most one per servant. Aborted on drop.
pub(super) struct Visits<T> {
    tasks: JoinSet<T>,
    /// Ids of the visited servants by task.
    servants: HashMap<Id, String>,
}

impl<T> Default for Visits<T> {
    fn default() -> Self {
        Self { tasks: JoinSet::new(), servants: HashMap::new() }
    }
}

impl<T: Send + 'static> Visits<T> {
    /// Returns true if this servant can be visited now: it is not being visited, and there are not too many visits.
    pub(super) fn can_begin(&self, servant: &str) -> bool {
        self.servants.len() < AT_ONCE && self.servants.values().all(|id| id != servant)
    }

    /// Starts a visit, if it [can begin](Self::can_begin).
    pub(super) fn begin(&mut self, servant: &str, visit: impl Future<Output = T> + Send + 'static) {
        if self.can_begin(servant) {
            let task = self.tasks.spawn(visit).id();
            self.servants.insert(task, servant.to_owned());
        }
    }

    /// Returns the results of the finished visits, each with the servant's id. A panicked visit has no result.
    pub(super) fn take_finished(&mut self) -> Vec<(String, T)> {
        let mut over = Vec::new();
        while let Some(ended) = self.tasks.try_join_next_with_id() {
            let (task, outcome) = match ended {
                Ok((task, outcome)) => (task, Some(outcome)),
                Err(error) => (error.id(), None),
            };
            let servant = self.servants.remove(&task);
            over.extend(servant.zip(outcome));
        }
        over
    }
}

#[cfg(test)]
mod tests {
    use std::future::pending;

    use super::*;

    async fn pass() {
        for _ in 0..16 {
            tokio::task::yield_now().await;
        }
    }

    #[tokio::test]
    async fn each_servant_is_visited_once_at_a_time_and_none_waits_for_another() {
        let mut visits = Visits::default();
        visits.begin("stuck", pending());
        visits.begin("stuck", async { 1 });
        visits.begin("a", async { 2 });
        visits.begin("panics", async { panic!("it is to be seen in the log") });
        assert!(!visits.can_begin("stuck") && !visits.can_begin("a") && visits.can_begin("b"));
        pass().await;
        assert_eq!(visits.take_finished(), [("a".to_owned(), 2)]);
        assert!(!visits.can_begin("stuck") && visits.can_begin("a") && visits.can_begin("panics"));
    }

    #[tokio::test]
    async fn there_are_only_so_many_at_once() {
        let mut visits = Visits::default();
        for number in 0..2 * AT_ONCE {
            visits.begin(&number.to_string(), async {});
        }
        assert_eq!(visits.tasks.len(), AT_ONCE);
        pass().await;
        assert_eq!(visits.take_finished().len(), AT_ONCE);
        assert!(visits.can_begin("the next"));
    }
}
