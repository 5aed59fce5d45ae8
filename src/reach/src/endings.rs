//! Notifies the bus of a servant when one of its processes has exited; the engine, which waits for the process, knows
//! first.

use std::sync::Arc;

use ros::bus::Bus;
use servant::engine::NodeEvent;
use tokio::sync::broadcast::Receiver;
use tokio::sync::broadcast::error::RecvError;
use tokio::task::AbortHandle;

/// Notifies the bus until it is dropped.
pub(crate) struct ExitNotifier {
    task: AbortHandle,
}

impl Drop for ExitNotifier {
    fn drop(&mut self) {
        self.task.abort();
    }
}

impl ExitNotifier {
    pub(crate) fn start(events: Receiver<NodeEvent>, bus: Arc<dyn Bus>) -> ExitNotifier {
        let told = forward_exits(events, move || bus.on_process_exit());
        ExitNotifier { task: tokio::spawn(told).abort_handle() }
    }
}

async fn forward_exits(mut events: Receiver<NodeEvent>, ended: impl Fn()) {
    loop {
        match events.recv().await {
            // A missed event may have been an exit.
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

    fn exit_event() -> NodeEvent {
        NodeEvent::Exited { node: "/a".into(), code: None, signal: Some(9), out_of_memory: false }
    }

    /// Returns the number of notifications for these events.
    async fn count_notifications(events: &[NodeEvent]) -> usize {
        let (sender, receiver) = broadcast::channel(4);
        for event in events {
            sender.send(event.clone()).expect("somebody listens");
        }
        drop(sender);
        let count = AtomicUsize::new(0);
        forward_exits(receiver, || {
            count.fetch_add(1, Ordering::Relaxed);
        })
        .await;
        count.into_inner()
    }

    #[tokio::test]
    async fn each_end_of_a_process_is_told_and_nothing_else() {
        let started = NodeEvent::Started { node: "/a".into() };
        assert_eq!(count_notifications(&[started.clone(), exit_event(), started, exit_event()]).await, 2);
    }

    #[tokio::test]
    async fn ends_that_were_missed_are_told() {
        let started = || NodeEvent::Started { node: "/a".into() };
        let events = [exit_event(), started(), started(), started(), started()];
        assert_eq!(count_notifications(&events).await, 1);
    }
}
