//! Counters of a bridge.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use parking_lot::Mutex;
use ros::ring::DropTally;

/// A counter that only increases.
#[derive(Debug, Default)]
pub struct Counter(AtomicU64);

impl Counter {
    /// Adds to the counter.
    pub fn add(&self, count: u64) {
        self.0.fetch_add(count, Ordering::Relaxed);
    }

    /// Returns the present value.
    pub fn get(&self) -> u64 {
        self.0.load(Ordering::Relaxed)
    }
}

/// Maximum number of topics counted by name; clients can invent any number of them.
const MOST_TOPICS: usize = 256;

/// Dropped messages, by topic.
#[derive(Debug, Default)]
pub struct Drops(Mutex<BTreeMap<String, u64>>);

impl Drops {
    /// Counts dropped messages of a topic.
    pub fn add(&self, topic: &str, count: u64) {
        if count == 0 {
            return;
        }
        let mut topics = self.0.lock();
        if let Some(known) = topics.get_mut(topic) {
            *known += count;
        } else if topics.len() < MOST_TOPICS {
            topics.insert(topic.to_owned(), count);
        }
    }

    /// Returns all counts so far, by topic.
    pub fn all(&self) -> BTreeMap<String, u64> {
        self.0.lock().clone()
    }
}

macro_rules! metrics {
    ($($(#[doc = $doc:literal])* $field:ident => $name:literal,)*) => {
        /// Counters of one bridge, over all its sessions.
        #[derive(Debug, Default)]
        pub struct Metrics {
            $($(#[doc = $doc])* pub $field: Counter,)*
            /// Topics of the dropped messages, in both directions.
            pub drops: Arc<Drops>,
        }

        /// Values of [`Metrics`] at one time.
        #[derive(Debug, Clone, Default, PartialEq, Eq)]
        pub struct MetricsSnapshot {
            $($(#[doc = $doc])* pub $field: u64,)*
            /// Numbers of dropped messages by topic, in both directions.
            pub drops: BTreeMap<String, u64>,
        }

        impl Metrics {
            /// Returns the present values.
            pub fn snapshot(&self) -> MetricsSnapshot {
                MetricsSnapshot { $($field: self.$field.get(),)* drops: self.drops.all() }
            }
        }

        impl MetricsSnapshot {
            /// Returns every counter with its Prometheus name and help text.
            pub fn all(&self) -> Vec<(&'static str, &'static str, u64)> {
                vec![$(($name, concat!($($doc,)*).trim_ascii(), self.$field),)*]
            }
        }
    };
}

metrics! {
    /// Connections accepted.
    sessions => "cloudroid_bridge_sessions_total",
    /// Connections that found an earlier session again.
    resumed => "cloudroid_bridge_sessions_resumed_total",
    /// WebSocket messages from clients.
    frames_in => "cloudroid_bridge_frames_in_total",
    /// Bytes of WebSocket messages from clients.
    bytes_in => "cloudroid_bridge_bytes_in_total",
    /// WebSocket messages to clients.
    frames_out => "cloudroid_bridge_frames_out_total",
    /// Bytes of WebSocket messages to clients.
    bytes_out => "cloudroid_bridge_bytes_out_total",
    /// Messages that clients published.
    published => "cloudroid_bridge_published_total",
    /// Messages that clients published while one of them listened to a topic of the nodes.
    asked => "cloudroid_bridge_asked_total",
    /// Messages from ROS taken up for clients.
    received => "cloudroid_bridge_received_total",
    /// Messages that were encoded; fewer than sent where subscribers share an encoding.
    encoded => "cloudroid_bridge_encoded_total",
    /// Messages dropped because a client read too slowly.
    dropped => "cloudroid_bridge_dropped_total",
    /// Bytes of messages dropped because a client read too slowly.
    dropped_bytes => "cloudroid_bridge_dropped_bytes_total",
    /// Messages left out because the client asked for a throttle_rate.
    throttled => "cloudroid_bridge_throttled_total",
    /// Messages dropped between ROS and the bridge.
    bus_dropped => "cloudroid_bridge_bus_dropped_total",
    /// Messages of clients dropped because a node read too slowly.
    node_dropped => "cloudroid_bridge_node_dropped_total",
    /// Service calls from clients.
    calls => "cloudroid_bridge_calls_total",
    /// Service calls from clients that failed.
    calls_failed => "cloudroid_bridge_calls_failed_total",
    /// Service calls from clients that a node answered by a failure.
    calls_denied => "cloudroid_bridge_calls_denied_total",
    /// Answers to service calls and goals of clients that were put into their queues.
    answers => "cloudroid_bridge_answers_total",
    /// Service calls that clients served.
    calls_served => "cloudroid_bridge_calls_served_total",
    /// Goals from clients.
    goals => "cloudroid_bridge_goals_total",
    /// Status messages at level error.
    errors => "cloudroid_bridge_errors_total",
}

impl Metrics {
    /// Counts messages that were dropped because a client read too slowly.
    pub(crate) fn record_lost(&self, lost: DropTally) {
        if lost.messages > 0 {
            self.dropped.add(lost.messages);
            self.dropped_bytes.add(lost.bytes);
        }
    }
}

impl MetricsSnapshot {
    /// Returns the number of messages dropped because a client or the bridge was slow.
    pub fn dropped_count(&self) -> u64 {
        self.dropped + self.bus_dropped
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn drops_are_counted_by_topic_and_topics_without_end_are_not() {
        let drops = Drops::default();
        drops.add("/a", 2);
        drops.add("/a", 3);
        drops.add("/b", 0);
        assert_eq!(drops.all(), BTreeMap::from([("/a".to_owned(), 5)]));
        for number in 0..1000 {
            drops.add(&format!("/{number}"), 1);
        }
        drops.add("/a", 1);
        let all = drops.all();
        assert_eq!((all.len(), all["/a"]), (MOST_TOPICS, 6));
    }

    #[test]
    fn every_counter_is_told_by_its_name_with_what_it_counts() {
        let metrics = Metrics::default();
        metrics.dropped.add(3);
        metrics.drops.add("/a", 2);
        let snapshot = metrics.snapshot();
        assert_eq!(snapshot.drops, BTreeMap::from([("/a".to_owned(), 2)]));
        let all = snapshot.all();
        let help = "Messages dropped because a client read too slowly.";
        assert!(all.contains(&("cloudroid_bridge_dropped_total", help, 3)));
        assert!(all.iter().all(|(name, ..)| name.ends_with("_total")));
    }
}
