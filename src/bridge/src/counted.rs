//! A publisher on the bus, with a count of what its subscribers were too slow for.

use std::sync::Arc;

use bytes::Bytes;
use ros::bus::{Matched, Publisher};
use tokio::sync::watch;

use crate::Metrics;

/// Counts what is dropped for each message: room is made for it when it is published.
pub(crate) struct Counted {
    publisher: Box<dyn Publisher>,
    topic: String,
    metrics: Arc<Metrics>,
}

impl Counted {
    pub(crate) fn new(publisher: Box<dyn Publisher>, topic: &str, metrics: Arc<Metrics>) -> Self {
        Self {
            publisher,
            topic: topic.to_owned(),
            metrics,
        }
    }

    pub(crate) fn publish(&self, bytes: Bytes) {
        // The count may be one of all publishers of the topic, and then what others dropped is theirs.
        let before = self.publisher.dropped();
        self.publisher.publish(bytes);
        let new = self.publisher.dropped().saturating_sub(before);
        self.metrics.node_dropped.add(new);
        self.metrics.drops.add(&self.topic, new);
    }

    pub(crate) fn matched(&self) -> watch::Receiver<Matched> {
        self.publisher.matched()
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicU64, Ordering};

    use super::*;

    /// Its subscriber has room for three messages, and reads none.
    struct Stuck(Arc<AtomicU64>);

    impl Publisher for Stuck {
        fn publish(&self, _: Bytes) {
            self.0.fetch_add(1, Ordering::Relaxed);
        }

        fn matched(&self) -> watch::Receiver<Matched> {
            watch::Sender::default().subscribe()
        }

        fn dropped(&self) -> u64 {
            self.0.load(Ordering::Relaxed).saturating_sub(3)
        }
    }

    #[test]
    fn what_a_node_is_too_slow_for_is_counted_once_and_told_by_topic() {
        let metrics = Arc::new(Metrics::default());
        // Others have dropped two of the topic before.
        let sent = Arc::new(AtomicU64::new(5));
        let publisher = Counted::new(Box::new(Stuck(sent)), "/pictures", metrics.clone());
        for _ in 0..4 {
            publisher.publish(Bytes::new());
        }
        assert_eq!(metrics.node_dropped.get(), 4);
        assert_eq!(metrics.drops.all()["/pictures"], 4);
    }
}
