use std::time::Duration;

use ros::bus::{SerializedMessage, WireType};
use ros::schema::Registry;
use rosbridge::Format;

use super::*;
use crate::sample::TopicTypes;

fn outbox(options: BridgeOptions) -> (Outbox, Arc<Metrics>) {
    let metrics = Arc::new(Metrics::default());
    (Outbox::new(&options, metrics.clone(), &Budget::without_limit()), metrics)
}

fn sample(size: usize) -> Arc<TopicSample> {
    let wire_type = Arc::new(WireType::with_name("a/B"));
    let message = SerializedMessage { bytes: vec![0; size].into(), wire_type, publisher: "/p".into(), latching: false };
    let types = Arc::new(TopicTypes::new(Arc::new(Registry::new())));
    let options = BridgeOptions::default();
    Arc::new(TopicSample::new(message, false, types, &options).unwrap())
}

fn control(size: usize) -> ControlMessage {
    let frame = EncodedFrame { format: Format::Json, bytes: vec![b'x'; size].into() };
    ControlMessage { frame, fragment_size: None, answer: false }
}

fn wishes() -> SubscriptionOptions {
    SubscriptionOptions {
        throttle_rate: Duration::ZERO,
        queue_length: 0,
        fragment_size: None,
        compression: Compression::None,
    }
}

/// Takes everything: `c` for control messages, otherwise the topic and size.
fn drain(outbox: &Outbox, now: Instant) -> Vec<String> {
    let mut out = Vec::new();
    while let Some(next) = outbox.next(now) {
        out.push(match next {
            Outgoing::Control(_) => "c".to_owned(),
            Outgoing::Sample { topic, sample, .. } => format!("{topic}{}", sample.bytes.len()),
        });
    }
    out
}

#[test]
fn control_goes_first_and_topics_take_turns() {
    let (outbox, _) = outbox(BridgeOptions::default());
    let (a, b) = (outbox.add_topic("/a".into(), wishes()), outbox.add_topic("/b".into(), wishes()));
    for size in 1..=3 {
        outbox.push_sample(a, sample(size), false);
    }
    outbox.push_sample(b, sample(9), false);
    outbox.push_control(control(1));
    assert_eq!(drain(&outbox, Instant::now()), ["c", "/a1", "/b9", "/a2", "/a3"]);
    outbox.push_sample(a, sample(1), false);
    outbox.remove_topic(a);
    outbox.push_sample(a, sample(1), false);
    assert!(drain(&outbox, Instant::now()).is_empty());
}

#[test]
fn a_topic_in_fragments_waits_and_others_do_not() {
    let (outbox, _) = outbox(BridgeOptions::default());
    let (a, b) = (outbox.add_topic("/a".into(), wishes()), outbox.add_topic("/b".into(), wishes()));
    outbox.push_sample(a, sample(1), false);
    outbox.push_sample(a, sample(2), false);
    let now = Instant::now();
    assert!(matches!(outbox.next(now), Some(Outgoing::Sample { key, .. }) if key == a));
    outbox.hold_topic(0, a);
    outbox.push_sample(b, sample(3), false);
    outbox.push_sample(a, sample(4), false);
    assert_eq!(drain(&outbox, now), ["/b3"]);
    outbox.release_topic(0, a);
    assert_eq!(drain(&outbox, Instant::now()), ["/a2", "/a4"]);
}

#[test]
fn a_topic_whose_fragments_went_down_with_a_socket_goes_on_over_the_next() {
    let (outbox, _) = outbox(BridgeOptions::default());
    let key = outbox.add_topic("/a".into(), wishes());
    let old = outbox.attach();
    for size in 1..=3 {
        outbox.push_sample(key, sample(size), false);
    }
    let now = Instant::now();
    assert!(outbox.next(now).is_some());
    outbox.hold_topic(old, key);
    let new = outbox.attach();
    assert!(matches!(outbox.next(now), Some(Outgoing::Sample { sample, .. }) if sample.bytes.len() == 2));
    // The old socket, which has not noticed yet, changes nothing.
    outbox.hold_topic(old, key);
    outbox.hold_topic(new, key);
    outbox.release_topic(old, key);
    assert!(outbox.next(now).is_none());
    outbox.release_topic(new, key);
    assert_eq!(drain(&outbox, now), ["/a3"]);
}

#[test]
fn one_client_holds_bounded_memory_whatever_it_subscribes_to() {
    let (outbox, metrics) = outbox(BridgeOptions { session_bytes: 1000, ..BridgeOptions::default() });
    let topics: Vec<_> = (0..10).map(|number| outbox.add_topic(format!("/{number}").into(), wishes())).collect();
    for _ in 0..100 {
        for key in &topics {
            outbox.push_sample(*key, sample(90), false);
            assert!(outbox.queues.lock().topics.load().bytes <= 1000);
        }
    }
    assert!(metrics.dropped.get() >= 985);
    // A message larger than all limits gets through as the only one of its topic.
    outbox.push_sample(topics[0], sample(3000), false);
    let sent = drain(&outbox, Instant::now());
    assert!(sent.contains(&"/03000".to_owned()), "{sent:?}");
    // But not if it alone is far too large and others are queued.
    outbox.push_sample(topics[1], sample(10), false);
    outbox.push_sample(topics[0], sample(3000), false);
    outbox.push_sample(topics[2], sample(3000), false);
    assert!(outbox.queues.lock().topics.load().bytes <= 4000);
}

#[test]
fn ten_large_pictures_fit_into_one_clients_memory() {
    let (outbox, metrics) = outbox(BridgeOptions::default());
    let wishes = SubscriptionOptions { queue_length: 10, ..wishes() };
    let key = outbox.add_topic("/pictures".into(), wishes);
    for number in 0..10 {
        outbox.push_sample(key, sample(1920 * 1080 * 3 + number), false);
    }
    assert_eq!(metrics.dropped.get(), 0);
    assert_eq!(drain(&outbox, Instant::now()).len(), 10);
}

#[test]
fn unread_messages_leave_room_for_what_their_client_sends() {
    let budget = Budget::new("client x", 4 << 20);
    let open = |_| Outbox::new(&BridgeOptions::default(), Arc::default(), &budget);
    let readers: Vec<Outbox> = (0..4).map(open).collect();
    let keys: Vec<TopicKey> = readers.iter().map(|reader| reader.add_topic("/a".into(), wishes())).collect();
    for _ in 0..50 {
        for (reader, key) in readers.iter().zip(&keys) {
            reader.push_sample(*key, sample(60_000), false);
        }
    }
    assert!(budget.used_bytes() > 3 << 20, "{budget:?}");
    assert!(budget.take(400_000).is_ok(), "{budget:?}");
    for reader in &readers {
        assert!(!drain(reader, Instant::now()).is_empty(), "the newest message is kept");
    }
}

#[test]
fn who_reads_no_answers_is_told_goodbye() {
    let (outbox, _) = outbox(BridgeOptions { control_messages: 2, ..BridgeOptions::default() });
    outbox.push_control(control(1));
    outbox.push_control(control(1));
    assert_eq!(outbox.close_reason(), None);
    outbox.push_control(control(1));
    assert_eq!(
        outbox.close_reason(),
        Some(CloseReason { code: 1008, reason: "2 answers wait and none is read".to_owned() })
    );
}

#[test]
fn throttled_topics_come_when_they_are_due() {
    let (outbox, metrics) = outbox(BridgeOptions::default());
    let rate = Duration::from_secs(60);
    let key = outbox.add_topic("/a".into(), SubscriptionOptions { throttle_rate: rate, queue_length: 5, ..wishes() });
    outbox.push_sample(key, sample(1), false);
    outbox.push_sample(key, sample(2), false);
    let now = Instant::now();
    assert_eq!(drain(&outbox, now), ["/a1"]);
    assert_eq!(outbox.next_due(), Some(now + rate));
    assert_eq!(drain(&outbox, now + rate), ["/a2"]);
    assert_eq!(metrics.throttled.get(), 0);
    outbox.change_topic(key, wishes());
    outbox.push_sample(key, sample(3), false);
    assert_eq!(drain(&outbox, now), ["/a3"]);
}

#[test]
fn the_newer_socket_takes_the_older_ones_place() {
    let (outbox, _) = outbox(BridgeOptions::default());
    let waker = Waker::noop();
    let old = outbox.attach();
    assert!(outbox.register(old, waker));
    let new = outbox.attach();
    assert!(!outbox.register(old, waker));
    assert!(outbox.register(new, waker) && outbox.is_attached(new) && !outbox.is_attached(old));
}
