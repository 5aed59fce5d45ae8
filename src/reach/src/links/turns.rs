//! Serialises the operations that begin, end or take up a node's link, so that each finds the result of the one before.
//! Operations of different nodes run in parallel: a node may take seconds to start, and to end.

use std::collections::HashMap;
use std::sync::Arc;

use parking_lot::Mutex;
use tokio::sync::OwnedMutexGuard;

/// The turns of all nodes.
#[derive(Debug, Default)]
pub(super) struct Turns {
    nodes: Mutex<HashMap<String, Arc<tokio::sync::Mutex<()>>>>,
}

impl Turns {
    /// Waits for the turn of this node; it is over when what is returned is dropped.
    pub(super) async fn of(&self, node: &str) -> OwnedMutexGuard<()> {
        let turn = {
            let mut nodes = self.nodes.lock();
            // Robots choose names: those that nobody waits for are forgotten.
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

    /// The output of a future, if it is ready at once.
    fn now<F: Future>(future: F) -> Option<F::Output> {
        match pin!(future).poll(&mut Context::from_waker(Waker::noop())) {
            Poll::Ready(output) => Some(output),
            Poll::Pending => None,
        }
    }

    #[test]
    fn one_node_waits_for_itself_and_for_no_other() {
        let turns = Turns::default();
        let first = now(turns.of("/slow")).expect("nobody is before it");
        assert!(now(turns.of("/slow")).is_none());
        assert!(now(turns.of("/other")).is_some());
        drop(first);
        assert!(now(turns.of("/slow")).is_some());
        let _last = now(turns.of("/last"));
        assert_eq!(turns.nodes.lock().len(), 1, "others are forgotten");
    }
}
