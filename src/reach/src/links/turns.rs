//! Serializes the operations that start, end or resume a node's link, so that each sees the result of the previous one.
//! Operations of different nodes run in parallel, because a node may take seconds to start and to end.

use std::collections::HashMap;
use std::sync::Arc;

use parking_lot::Mutex;
use tokio::sync::OwnedMutexGuard;

/// The turns of all nodes.
#[derive(Debug, Default)]
pub(super) struct NodeTurns {
    nodes: Mutex<HashMap<String, Arc<tokio::sync::Mutex<()>>>>,
}

impl NodeTurns {
    /// Waits for the turn of this node, which ends when the returned guard is dropped.
    pub(super) async fn acquire(&self, node: &str) -> OwnedMutexGuard<()> {
        let turn = {
            let mut nodes = self.nodes.lock();
            // Robots choose names, so those without waiters are forgotten.
            nodes.retain(|_, turn| Arc::strong_count(turn) > 1);
            Arc::clone(nodes.entry(node.to_owned()).or_default())
        };
        turn.lock_owned().await
    }
}

#[cfg(test)]
mod tests {
    use std::future::Future;
    use std::pin::pin;
    use std::task::{Context, Poll, Waker};

    use super::*;

    /// Returns the output of a future if it is ready immediately.
    fn poll_once<F: Future>(future: F) -> Option<F::Output> {
        match pin!(future).poll(&mut Context::from_waker(Waker::noop())) {
            Poll::Ready(output) => Some(output),
            Poll::Pending => None,
        }
    }

    #[test]
    fn one_node_waits_for_itself_and_for_no_other() {
        let turns = NodeTurns::default();
        let first = poll_once(turns.acquire("/slow")).expect("nobody is before it");
        assert!(poll_once(turns.acquire("/slow")).is_none());
        assert!(poll_once(turns.acquire("/other")).is_some());
        drop(first);
        assert!(poll_once(turns.acquire("/slow")).is_some());
        let _last = poll_once(turns.acquire("/last"));
        assert_eq!(turns.nodes.lock().len(), 1, "others are forgotten");
    }
}
