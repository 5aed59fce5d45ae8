//! A publisher on the bus that counts the messages its subscribers were too slow for.

use std::sync::Arc;

use bytes::Bytes;
use ros::bus::{MatchedPeers, Publisher};
use tokio::sync::watch;

use crate::Metrics;

/// Counts the messages dropped by each publication: they make room for it when it is published.
pub(crate) struct CountingPublisher {
    publisher: Box<dyn Publisher>,
    topic: String,
    metrics: Arc<Metrics>,
}

impl CountingPublisher {
    pub(crate) fn new(publisher: Box<dyn Publisher>, topic: &str, metrics: Arc<Metrics>) -> Self {
        Self { publisher, topic: topic.to_owned(), metrics }
    }

    pub(crate) fn publish(&self, bytes: Bytes) {
        // The counter may cover all publishers of the topic; drops caused by others are theirs.
        let before = self.publisher.dropped_count();
        self.publisher.publish(bytes);
        let new = self.publisher.dropped_count().saturating_sub(before);
        self.metrics.node_dropped.add(new);
        self.metrics.drops.add(&self.topic, new);
    }

    pub(crate) fn match_events(&self) -> watch::Receiver<MatchedPeers> {
        self.publisher.matched_subscribers()
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicU64, Ordering};

    use super::*;

    /// A publisher whose subscriber has room for three messages and reads none.
    struct Stuck(Arc<AtomicU64>);

    impl Publisher for Stuck {
        fn publish(&self, _: Bytes) {
            self.0.fetch_add(1, Ordering::Relaxed);
        }

        fn matched_subscribers(&self) -> watch::Receiver<MatchedPeers> {
            watch::Sender::default().subscribe()
        }

        fn dropped_count(&self) -> u64 {
            self.0.load(Ordering::Relaxed).saturating_sub(3)
        }
    }

    #[test]
    fn what_a_node_is_too_slow_for_is_counted_once_and_told_by_topic() {
        let metrics = Arc::new(Metrics::default());
        // Two messages of the topic were dropped by others before.
        let sent = Arc::new(AtomicU64::new(5));
        let publisher = CountingPublisher::new(Box::new(Stuck(sent)), "/pictures", metrics.clone());
        for _ in 0..4 {
            publisher.publish(Bytes::new());
        }
        assert_eq!(metrics.node_dropped.get(), 4);
        assert_eq!(metrics.drops.all()["/pictures"], 4);
    }
}
