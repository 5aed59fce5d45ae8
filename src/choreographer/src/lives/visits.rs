//! What is done once in a while for many servants, each at its own pace: one that does not answer keeps no other waiting.

use std::collections::HashMap;
use std::future::Future;

use tokio::task::{Id, JoinSet};

/// Servants that are visited beside each other; more wait for the next look.
const AT_ONCE: usize = 64;

/// Visits to servants that are under way, at most one to each. Dropping it ends them.
pub(super) struct Visits<T> {
    tasks: JoinSet<T>,
    /// To the servants of these ids.
    servants: HashMap<Id, String>,
}

impl<T> Default for Visits<T> {
    fn default() -> Self {
        Self {
            tasks: JoinSet::new(),
            servants: HashMap::new(),
        }
    }
}

impl<T: Send + 'static> Visits<T> {
    /// Whether this servant can be visited now: it is not being visited, and there are not too many visits.
    pub(super) fn can_begin(&self, servant: &str) -> bool {
        self.servants.len() < AT_ONCE && self.servants.values().all(|id| id != servant)
    }

    /// Begins a visit, if it [can begin](Self::can_begin).
    pub(super) fn begin(&mut self, servant: &str, visit: impl Future<Output = T> + Send + 'static) {
        if self.can_begin(servant) {
            let task = self.tasks.spawn(visit).id();
            self.servants.insert(task, servant.to_owned());
        }
    }

    /// What the visits gave that are over, each with the servant's id. One that has panicked gives nothing.
    pub(super) fn take_over(&mut self) -> Vec<(String, T)> {
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
        assert_eq!(visits.take_over(), [("a".to_owned(), 2)]);
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
        assert_eq!(visits.take_over().len(), AT_ONCE);
        assert!(visits.can_begin("the next"));
    }
}
