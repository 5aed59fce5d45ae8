//! The revision's own nodes, which run in a servant until the first stub of its robot connects.
//!
//! ```text
//!  Running ──first stub──▶ Ending ──all have ended──▶ Ended
//!     └──stubs from the beginning, no own nodes────────▲
//! ```
//! Every stub's node waits until they have ended, not only the first one, because it may have the name of one of them.

use std::future::Future;
use std::time::Duration;

use futures_util::future::join_all;
use servant::engine::ServantHandle;
use servant::spec::NodeSpec;
use tokio::sync::Mutex;
use tokio::time::timeout;

/// Signals for stopping a node and the time after each; like roslaunch except for the times.
const STOP: [(i32, Duration); 3] = [
    (libc::SIGINT, Duration::from_secs(5)),
    (libc::SIGTERM, Duration::from_secs(2)),
    (libc::SIGKILL, Duration::from_secs(5)),
];

/// State of the nodes.
#[derive(Debug, Default, Clone, Copy, PartialEq)]
enum OwnNodesStage {
    #[default]
    Running,
    Ending,
    Ended,
}

/// The state of the revision's own nodes.
#[derive(Debug, Default)]
pub(super) struct OwnNodes(Mutex<OwnNodesStage>);

impl OwnNodes {
    /// Waits until none is running. `take_over` is awaited by the first caller to determine whether there are any to
    /// end. The future may be dropped meanwhile: the next caller continues.
    pub(super) async fn end_once<F>(&self, take_over: impl Future<Output = bool>, ending: impl FnOnce() -> F)
    where
        F: Future<Output = ()>,
    {
        let mut stage = self.0.lock().await;
        if *stage == OwnNodesStage::Running {
            *stage = if take_over.await { OwnNodesStage::Ending } else { OwnNodesStage::Ended };
        }
        if *stage == OwnNodesStage::Ending {
            ending().await;
            *stage = OwnNodesStage::Ended;
        }
    }
}

/// Ends nodes permanently and concurrently; returns when none is running, or the last signal had no effect.
pub(super) async fn end_all(container: &dyn ServantHandle, nodes: &[NodeSpec]) {
    join_all(nodes.iter().map(|node| end_node(container, &node.name))).await;
}

async fn end_node(container: &dyn ServantHandle, node: &str) {
    for (signal, patience) in STOP {
        // A node that is not running is not restarted either.
        if container.end_node(node, signal).await.is_err() {
            return;
        }
        if timeout(patience, container.wait_node(node)).await.is_ok() {
            return;
        }
    }
    tracing::warn!(servant = container.id(), node, "a node of the revision does not end");
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::sync::atomic::{AtomicUsize, Ordering};

    use tokio::sync::Semaphore;

    use super::*;

    #[tokio::test]
    async fn the_second_stub_waits_for_what_the_first_one_ends_even_if_that_one_goes_away() {
        let planned = Arc::new(OwnNodes::default());
        let (asked, begun, over) =
            (Arc::new(AtomicUsize::new(0)), Arc::new(Semaphore::new(0)), Arc::new(Semaphore::new(0)));
        let stub = || {
            let (planned, asked) = (Arc::clone(&planned), Arc::clone(&asked));
            let (begun, over) = (Arc::clone(&begun), Arc::clone(&over));
            tokio::spawn(async move {
                let take_over = async { asked.fetch_add(1, Ordering::Relaxed) == 0 };
                let ending = || async {
                    begun.add_permits(1);
                    over.acquire().await.unwrap().forget();
                };
                planned.end_once(take_over, ending).await;
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
        let planned = OwnNodes::default();
        for _ in 0..2 {
            planned.end_once(async { false }, || async { panic!("none was started") }).await;
        }
    }
}
