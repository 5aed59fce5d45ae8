//! The revision's own nodes, which run in a servant until the first stub of its robot comes.
//!
//! ```text
//!  Running ──first stub──▶ Ending ──all have ended──▶ Ended
//!     └──stubs from the beginning: there are none──────▲
//! ```
//! Every stub's node waits until they have ended, not only the first one: it may have the name of one of them.

use std::future::Future;
use std::time::Duration;

use futures_util::future::join_all;
use servant::engine::Servant;
use servant::spec::NodeSpec;
use tokio::sync::Mutex;
use tokio::time::timeout;

/// Signals to a node that is to end, and how long it may take after each, as roslaunch has it but for the length.
const STOP: [(i32, Duration); 3] = [
    (libc::SIGINT, Duration::from_secs(5)),
    (libc::SIGTERM, Duration::from_secs(2)),
    (libc::SIGKILL, Duration::from_secs(5)),
];

/// How far they are.
#[derive(Debug, Default, Clone, Copy, PartialEq)]
enum Stage {
    #[default]
    Running,
    Ending,
    Ended,
}

/// Whether they run.
#[derive(Debug, Default)]
pub(super) struct Planned(Mutex<Stage>);

impl Planned {
    /// Returns when none runs any more. `take_over` is asked once whether there are any to be ended. Whoever calls may
    /// go away meanwhile: the next one goes on.
    pub(super) async fn end<F>(&self, take_over: impl FnOnce() -> bool, ending: impl FnOnce() -> F)
    where
        F: Future<Output = ()>,
    {
        let mut stage = self.0.lock().await;
        if *stage == Stage::Running {
            *stage = if take_over() {
                Stage::Ending
            } else {
                Stage::Ended
            };
        }
        if *stage == Stage::Ending {
            ending().await;
            *stage = Stage::Ended;
        }
    }
}

/// Ends nodes for good, all at once; returns when none runs, or the last signal was in vain.
pub(super) async fn end_all(container: &dyn Servant, nodes: &[NodeSpec]) {
    join_all(nodes.iter().map(|node| end(container, &node.name))).await;
}

async fn end(container: &dyn Servant, node: &str) {
    for (signal, patience) in STOP {
        // One that does not run is not started again either.
        if container.end_node(node, signal).await.is_err() {
            return;
        }
        if timeout(patience, container.wait_node(node)).await.is_ok() {
            return;
        }
    }
    tracing::warn!(
        servant = container.id(),
        node,
        "a node of the revision does not end"
    );
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::sync::atomic::{AtomicUsize, Ordering};

    use tokio::sync::Semaphore;

    use super::*;

    #[tokio::test]
    async fn the_second_stub_waits_for_what_the_first_one_ends_even_if_that_one_goes_away() {
        let planned = Arc::new(Planned::default());
        let (asked, begun, over) = (
            Arc::new(AtomicUsize::new(0)),
            Arc::new(Semaphore::new(0)),
            Arc::new(Semaphore::new(0)),
        );
        let stub = || {
            let (planned, asked) = (Arc::clone(&planned), Arc::clone(&asked));
            let (begun, over) = (Arc::clone(&begun), Arc::clone(&over));
            tokio::spawn(async move {
                let take_over = || asked.fetch_add(1, Ordering::Relaxed) == 0;
                let ending = || async {
                    begun.add_permits(1);
                    over.acquire().await.unwrap().forget();
                };
                planned.end(take_over, ending).await;
            })
        };
        let (first, _) = (stub(), begun.acquire().await.unwrap().forget());
        let second = stub();
        tokio::task::yield_now().await;
        assert!(!second.is_finished(), "they have not ended");
        // The first stub's connection is lost.
        first.abort();
        begun.acquire().await.unwrap().forget();
        assert!(!second.is_finished(), "they still have not");
        over.add_permits(1);
        second.await.unwrap();
        stub().await.unwrap();
        assert_eq!(asked.load(Ordering::Relaxed), 1);
    }

    #[tokio::test]
    async fn where_stubs_were_first_there_is_nothing_to_end() {
        let planned = Planned::default();
        for _ in 0..2 {
            planned
                .end(|| false, || async { panic!("none was started") })
                .await;
        }
    }
}
