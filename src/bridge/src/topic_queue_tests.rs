use ros::bus::{SerializedMessage, WireType};
use ros::schema::Registry;

use super::*;
use crate::BridgeOptions;
use crate::sample::TopicTypes;

fn sample(publisher: &str, latching: bool, size: usize) -> Arc<TopicSample> {
    let wire_type = Arc::new(WireType::with_name("a/B"));
    let message = SerializedMessage { bytes: vec![0; size].into(), wire_type, publisher: publisher.into(), latching };
    let types = Arc::new(TopicTypes::new(Arc::new(Registry::new())));
    let options = BridgeOptions::default();
    Arc::new(TopicSample::new(message, false, types, &options).unwrap())
}

fn wishes(throttle: u64, length: usize) -> SubscriptionOptions {
    SubscriptionOptions {
        throttle_rate: Duration::from_millis(throttle),
        queue_length: length,
        fragment_size: None,
        compression: Compression::None,
    }
}

fn queue(throttle: u64, length: usize) -> TopicQueue {
    TopicQueue::new("/x".into(), wishes(throttle, length), RingBounds { messages: 5, bytes: 1000 }, Arc::default())
}

fn sizes(queue: &TopicQueue) -> Vec<usize> {
    queue.samples.iter().map(|waiting| waiting.sample.bytes.len()).collect()
}

#[test]
fn the_newest_win_within_messages_and_bytes() {
    let now = Instant::now();
    let mut messages = queue(0, 0);
    for size in 1..=7 {
        let _ = messages.push(sample("/p", false, size), false, now);
    }
    assert_eq!(sizes(&messages), [3, 4, 5, 6, 7]);
    assert_eq!(messages.drops.all()["/x"], 2, "told by topic");
    assert_eq!(messages.load().bytes, 25);
    let mut bytes = queue(0, 0);
    for size in [400, 401] {
        let _ = bytes.push(sample("/p", false, size), false, now);
    }
    let lost = bytes.push(sample("/p", false, 402), false, now).unwrap();
    assert_eq!((lost.messages, lost.bytes, sizes(&bytes)), (1, 400, vec![401, 402]));
    let mut asked = queue(0, 2);
    for size in 1..=4 {
        let _ = asked.push(sample("/p", false, size), false, now);
    }
    assert_eq!(sizes(&asked), [3, 4]);
}

/// However large images are, one that is read while the previous one waits must not cause that to be dropped.
#[test]
fn a_topic_of_large_messages_keeps_as_many_as_its_client_asked_for() {
    let now = Instant::now();
    let kept = |asked| {
        let mut queue =
            TopicQueue::new("/x".into(), wishes(0, asked), RingBounds { messages: 1000, bytes: 1000 }, Arc::default());
        for size in 6001..=6020 {
            let _ = queue.push(sample("/p", false, size), false, now);
        }
        sizes(&queue)
    };
    assert_eq!(kept(1), [6020]);
    assert_eq!(kept(5), [6016, 6017, 6018, 6019, 6020]);
    // A client that did not ask is no further behind than that.
    assert_eq!(kept(0), [6019, 6020]);
    // As many as ROS's own queues have, and no more.
    assert_eq!(kept(1000).len(), 10);
}

#[test]
fn without_a_queue_a_throttle_leaves_messages_out() {
    let (now, ms) = (Instant::now(), Duration::from_millis(1));
    let mut queue = queue(100, 0);
    let mut is_throttled = |size, replay, at| queue.push(sample("/p", false, size), replay, at).is_none();
    assert!(!is_throttled(1, false, now));
    assert!(is_throttled(2, false, now + 99 * ms));
    assert!(!is_throttled(3, true, now + 99 * ms));
    assert!(!is_throttled(4, false, now + 100 * ms));
    assert_eq!(sizes(&queue), [3, 1, 4]);
    assert_eq!(queue.due(now), Some(now));
}

#[test]
fn with_a_queue_a_throttle_spreads_messages() {
    let (now, ms) = (Instant::now(), Duration::from_millis(1));
    let mut queue = queue(100, 2);
    for size in 1..=3 {
        let _ = queue.push(sample("/p", false, size), false, now);
    }
    assert_eq!(queue.due(now), Some(now));
    assert_eq!(queue.pop(now).unwrap().bytes.len(), 2);
    assert_eq!(queue.due(now + ms), Some(now + 100 * ms));
    assert_eq!(queue.pop(now + 100 * ms).unwrap().bytes.len(), 3);
    assert_eq!(queue.due(now), None);
}

#[test]
fn the_first_of_each_latching_publisher_is_neither_held_back_nor_dropped() {
    let now = Instant::now();
    let mut queue = queue(60_000, 1);
    let mut dropped = |publisher, size| {
        let lost = queue.push(sample(publisher, true, size), false, now);
        lost.map(|lost| lost.messages)
    };
    for publisher in ["/a", "/b", "/c"] {
        assert_eq!(dropped(publisher, 1), Some(0));
    }
    assert_eq!(dropped("/b", 2), Some(0));
    assert_eq!(dropped("/b", 3), Some(2));
    assert_eq!(sizes(&queue), [1, 1, 3], "of a publisher of whom a newer one is there the older give way");
    for _ in 0..3 {
        assert_eq!(queue.due(now), Some(now));
        queue.pop(now);
    }
    let _ = queue.push(sample("/b", true, 4), false, now);
    assert_eq!(queue.due(now), Some(now + Duration::from_secs(60)));
}

#[test]
fn several_subscriptions_of_a_topic_merge() {
    let one = SubscriptionOptions { fragment_size: Some(500), ..wishes(100, 0) };
    let two = SubscriptionOptions { compression: Compression::CborRaw, ..wishes(50, 3) };
    let merged = SubscriptionOptions::merge([one, two].iter()).unwrap();
    let expected = SubscriptionOptions { fragment_size: Some(500), compression: Compression::CborRaw, ..wishes(50, 3) };
    assert_eq!(merged, expected);
    assert_eq!(SubscriptionOptions::merge([].iter()), None);
}
