//! Tells the bus of a servant when one of its processes has ended: the engine that waits for it knows that first.

use std::sync::Arc;

use ros::bus::Bus;
use servant::engine::NodeEvent;
use tokio::sync::broadcast::Receiver;
use tokio::sync::broadcast::error::RecvError;
use tokio::task::AbortHandle;

/// Tells it until it is dropped.
pub(crate) struct Endings {
    task: AbortHandle,
}

impl Drop for Endings {
    fn drop(&mut self) {
        self.task.abort();
    }
}

impl Endings {
    pub(crate) fn follow(events: Receiver<NodeEvent>, bus: Arc<dyn Bus>) -> Endings {
        let told = follow(events, move || bus.process_ended());
        Endings {
            task: tokio::spawn(told).abort_handle(),
        }
    }
}

async fn follow(mut events: Receiver<NodeEvent>, ended: impl Fn()) {
    loop {
        match events.recv().await {
            // What was missed may have been one.
            Ok(NodeEvent::Exited { .. }) | Err(RecvError::Lagged(_)) => ended(),
            Ok(_) => {}
            Err(RecvError::Closed) => return,
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicUsize, Ordering};

    use tokio::sync::broadcast;

    use super::*;

    fn exited() -> NodeEvent {
        NodeEvent::Exited {
            node: "/a".into(),
            code: None,
            signal: Some(9),
            out_of_memory: false,
        }
    }

    /// How often it was told of the end of a process.
    async fn told(events: &[NodeEvent]) -> usize {
        let (sender, receiver) = broadcast::channel(4);
        for event in events {
            sender.send(event.clone()).expect("somebody listens");
        }
        drop(sender);
        let count = AtomicUsize::new(0);
        follow(receiver, || {
            count.fetch_add(1, Ordering::Relaxed);
        })
        .await;
        count.into_inner()
    }

    #[tokio::test]
    async fn each_end_of_a_process_is_told_and_nothing_else() {
        let started = NodeEvent::Started { node: "/a".into() };
        assert_eq!(
            told(&[started.clone(), exited(), started, exited()]).await,
            2
        );
    }

    #[tokio::test]
    async fn ends_that_were_missed_are_told() {
        let started = || NodeEvent::Started { node: "/a".into() };
        let events = [exited(), started(), started(), started(), started()];
        assert_eq!(told(&events).await, 1);
    }
}
