use ros_bus::net::HostSockets;
use ros_bus::{BusError, Publisher, QosDurability, QosProfile, QosReliability};
use rtps::{Config, DataReader, DataWriter, EndpointQos, Participant, ReceivedSample, Sink, TopicDescription};

use super::*;
use crate::bus::Ros2Bus;
use crate::place::BusSockets;
use crate::{entities, names, type_hash};

const DEPTH: usize = 10;

fn best_effort() -> QosProfile {
    QosProfile { reliability: QosReliability::BestEffort, ..QosProfile::keep_last(DEPTH) }
}

fn latching() -> QosProfile {
    QosProfile::keep_last(DEPTH).latching(true)
}

/// A participant without nodes, for what a bus never does.
async fn stranger(number: u16) -> Participant {
    let config = Config::new(domain(number), "stranger");
    let joined = Participant::join(Arc::new(BusSockets(Arc::new(HostSockets))), config).await;
    joined.expect("a domain can be joined")
}

struct Nowhere;

impl Sink for Nowhere {
    fn on_sample(&self, _: ReceivedSample) {}
}

fn read(participant: &Participant, topic: TopicDescription, qos: EndpointQos) -> DataReader {
    participant.reader(topic, qos, Arc::new(Nowhere))
}

#[tokio::test]
async fn messages_pass_and_nobody_hears_himself() {
    let (one, two) = (join(40, "/one").await, join(40, "/two").await);
    let qos = QosProfile::keep_last(DEPTH);
    let mut own = one.subscribe("/chatter", string(), qos).await.unwrap();
    let mut other = two.subscribe("/chatter", string(), qos).await.unwrap();
    let mut same = two.subscribe("/chatter", WireType::any(), qos).await.unwrap();
    let publisher = one.advertise("/chatter", string(), qos).await.unwrap();
    let back = two.advertise("/chatter", string(), qos).await.unwrap();
    expect_connected(publisher.matched_subscribers(), 2).await;
    expect_connected(back.matched_subscribers(), 1).await;
    expect_connected(other.matched.clone(), 1).await;
    expect_connected(own.matched.clone(), 1).await;
    for number in 0..3 {
        publisher.publish(numbered_message(number));
    }
    for subscription in [&mut other, &mut same] {
        let first = next(subscription).await;
        assert_eq!(first.bytes, numbered_message(0));
        assert_eq!(*first.wire_type, WireType { definition: String::new(), ..string() });
        assert_eq!((first.publisher.node(), first.latching), ("/one", false));
        assert_eq!(numbers(subscription, 2).await, [1, 2]);
    }
    back.publish(numbered_message(9));
    assert_eq!(next(&mut own).await.publisher.node(), "/two");
    assert!(own.messages.is_empty());
}

#[tokio::test]
async fn whoever_leaves_is_no_longer_matched() {
    let (one, two) = (join(41, "/one").await, join(41, "/two").await);
    let qos = QosProfile::keep_last(DEPTH);
    let subscription = two.subscribe("/chatter", string(), qos).await.unwrap();
    let publisher = one.advertise("/chatter", string(), qos).await.unwrap();
    expect_connected(subscription.matched.clone(), 1).await;
    expect_connected(publisher.matched_subscribers(), 1).await;
    let matched = publisher.matched_subscribers();
    drop(subscription);
    wait_for_matched(matched, |matched| matched.peers.is_empty()).await;

    let again = two.subscribe("/chatter", string(), qos).await.unwrap();
    expect_connected(again.matched.clone(), 1).await;
    one.close().await;
    wait_for_matched(again.matched.clone(), |matched| matched.peers.is_empty()).await;
    assert!(matches!(one.subscribe("/chatter", string(), qos).await, Err(BusError::Closed)));
}

#[tokio::test]
async fn what_was_published_last_is_heard_by_those_who_come_later() {
    let (one, two) = (join(42, "/one").await, join(42, "/two").await);
    let publisher = one.advertise("/map", string(), latching()).await.unwrap();
    publisher.publish(numbered_message(1));
    publisher.publish(numbered_message(2));
    let wish = QosProfile { depth: 1, ..latching() };
    let mut first = two.subscribe("/map", string(), wish).await.unwrap();
    let message = loop {
        let message = next(&mut first).await;
        if message.bytes == numbered_message(2) {
            break message;
        }
    };
    assert!(message.latching);
    let mut second = two.subscribe("/map", string(), wish).await.unwrap();
    assert_eq!(numbers(&mut second, 1).await, [2]);
    // A subscription that does not request it is not given it.
    let mut volatile = two.subscribe("/map", string(), QosProfile::keep_last(1)).await.unwrap();
    expect_connected(volatile.matched.clone(), 1).await;
    expect_connected(publisher.matched_subscribers(), 2).await;
    publisher.publish(numbered_message(3));
    assert_eq!(numbers(&mut volatile, 1).await, [3]);

    // It is dropped with its publisher.
    drop(publisher);
    wait_for_matched(second.matched.clone(), |matched| matched.peers.is_empty()).await;
    let third = two.subscribe("/map", string(), wish).await.unwrap();
    assert!(third.messages.is_empty());
}

#[tokio::test]
async fn those_who_come_later_hear_as_many_as_the_publisher_keeps() {
    let (one, two) = (join(56, "/one").await, join(56, "/two").await);
    let qos = QosProfile { depth: 3, ..latching() };
    let publisher = one.advertise("/plan", string(), qos).await.unwrap();
    (1..=5).for_each(|number| publisher.publish(numbered_message(number)));
    let mut first = two.subscribe("/plan", string(), latching()).await.unwrap();
    assert_eq!(numbers(&mut first, 3).await, [3, 4, 5]);
    let kept = |matched: &ros_bus::MatchedPeers| {
        let offer = matched.peers.first().and_then(|peer| peer.offer.as_ref());
        offer.is_some_and(|offer| offer.kept == Some(3))
    };
    wait_for_matched(first.matched.clone(), kept).await;
    publisher.publish(numbered_message(6));
    assert_eq!(numbers(&mut first, 1).await, [6]);
    // It shares the reader of the first.
    let mut second = two.subscribe("/plan", string(), latching()).await.unwrap();
    assert_eq!(numbers(&mut second, 3).await, [4, 5, 6]);
    // A publisher may give fewer than it keeps for slow subscribers.
    publisher.set_kept(1);
    let three = join(56, "/three").await;
    let mut third = three.subscribe("/plan", string(), latching()).await.unwrap();
    assert_eq!(numbers(&mut third, 1).await, [6]);
}

#[tokio::test]
async fn a_wish_hears_whoever_offers_less_and_nobody_twice() {
    let (one, two) = (join(43, "/one").await, join(43, "/two").await);
    let mut subscription = two.subscribe("/scan", string(), latching()).await.unwrap();
    let offers = [
        latching(),
        QosProfile::keep_last(DEPTH),
        best_effort(),
        QosProfile { durability: QosDurability::TransientLocal, ..best_effort() },
    ];
    let mut publishers: Vec<Box<dyn Publisher>> = Vec::new();
    for qos in offers {
        publishers.push(one.advertise("/scan", string(), qos).await.unwrap());
    }
    expect_connected(subscription.matched.clone(), publishers.len()).await;
    let told = subscription.matched.borrow().clone();
    let latches: Vec<bool> = told.peers.iter().filter_map(|peer| Some(peer.offer.as_ref()?.latching)).collect();
    assert_eq!(latches.iter().filter(|latching| **latching).count(), 2);
    assert_eq!(told.refused, []);
    for publisher in &publishers {
        // Several readers of this subscription receive it; each message counts once.
        wait_for_matched(publisher.matched_subscribers(), |matched| matched.connected_count() > 0).await;
    }
    let mut sent = Vec::new();
    for (number, publisher) in (0..).zip(&publishers) {
        publisher.publish(numbered_message(number));
        publisher.publish(numbered_message(number + 10));
        sent.extend([number, number + 10]);
    }
    let mut heard = numbers(&mut subscription, sent.len()).await;
    heard.sort_unstable();
    sent.sort_unstable();
    assert_eq!(heard, sent);
    // Duplicates would have arrived by now.
    publishers[0].publish(numbered_message(99));
    assert_eq!(numbers(&mut subscription, 1).await, [99]);
    assert!(subscription.messages.is_empty());
}

/// A node logs a warning for each reader that requests more than it offers.
#[tokio::test]
async fn whoever_offers_less_than_is_wished_is_not_told_that_it_does() {
    let (one, two) = (join(61, "/one").await, join(61, "/two").await);
    let qos = QosProfile::keep_last(DEPTH);
    let less = one.advertise("/scan", string(), qos).await.unwrap();
    until_known(&two, "/scan").await;
    let mut subscription = two.subscribe("/scan", string(), latching()).await.unwrap();
    expect_connected(subscription.matched.clone(), 1).await;
    expect_connected(less.matched_subscribers(), 1).await;
    less.publish(numbered_message(1));
    assert_eq!(numbers(&mut subscription, 1).await, [1]);
    assert_eq!(less.matched_subscribers().borrow().refused, []);
    // A publisher that offers it later is matched with the preferred quality.
    let three = join(61, "/three").await;
    let latched = three.advertise("/scan", string(), latching()).await.unwrap();
    latched.publish(numbered_message(2));
    assert_eq!(numbers(&mut subscription, 1).await, [2]);
}

/// Waits until another node is known to publish a topic.
async fn until_known(bus: &Ros2Bus, topic: &str) {
    let mut graph = bus.graph();
    let known = graph.wait_for(|graph| graph.topics.contains_key(topic));
    timeout(LONG, known).await.expect("in time").expect("the bus is open");
}

#[tokio::test]
async fn a_reader_that_asks_for_more_is_said_with_both_profiles() {
    let bus = join(44, "/one").await;
    let publisher = bus.advertise("/scan", string(), best_effort()).await.unwrap();
    let stranger = stranger(44).await;
    let topic = names::topic("/scan", &string()).unwrap();
    let asked = EndpointQos { deadline: Some(Duration::from_millis(500)), ..EndpointQos::default() };
    let _reader = read(&stranger, topic, asked);
    let matched = wait_for_matched(publisher.matched_subscribers(), |matched| !matched.refused.is_empty()).await;
    assert_eq!(matched.peers, []);
    assert_eq!(matched.refused[0].peer.node(), stranger.guid().to_string());
    assert_eq!(
        matched.refused[0].why,
        "reliability: the publisher offers best_effort, the subscriber asks for reliable; \
         deadline: the publisher offers infinite, the subscriber asks for 0.5 s \
         (publisher: best_effort, volatile; subscriber: reliable, volatile, deadline 0.5 s)"
    );
}

#[tokio::test]
async fn ends_of_other_types_are_said_and_not_heard() {
    let (one, two) = (join(45, "/one").await, join(45, "/two").await);
    let qos = QosProfile::keep_last(DEPTH);
    let other = WireType::from_message(&message_type("std_msgs/msg/String", "string text"));
    let number = WireType::from_message(&message_type("std_msgs/msg/UInt8", "uint8 data"));
    let mut subscription = two.subscribe("/chatter", string(), qos).await.unwrap();
    let wrong = one.advertise("/chatter", other.clone(), qos).await.unwrap();
    let told = wait_for_matched(subscription.matched.clone(), |matched| !matched.refused.is_empty()).await;
    assert_eq!(told.peers, []);
    let (theirs, ours) = (other.digest, string().digest);
    assert_eq!(
        told.refused[0].why,
        format!("its type is std_msgs/msg/String {theirs} there and std_msgs/msg/String {ours} here")
    );
    let told = wait_for_matched(wrong.matched_subscribers(), |matched| !matched.refused.is_empty()).await;
    assert_eq!((told.peers.len(), told.refused.len()), (0, 1));
    wrong.publish(numbered_message(1));
    assert!(matches!(one.advertise("/chatter", number.clone(), qos).await, Err(BusError::TypeMismatch { .. })));
    drop(wrong);

    // With another name, it is not even matched.
    let named = one.advertise("/chatter", number, qos).await.unwrap();
    let is_named = |matched: &MatchedPeers| {
        let mut refused = matched.refused.iter();
        refused.any(|refusal| refusal.why.contains("UInt8"))
    };
    wait_for_matched(subscription.matched.clone(), is_named).await;
    wait_for_matched(named.matched_subscribers(), |matched| !matched.refused.is_empty()).await;
    drop(named);
    let right = one.advertise("/chatter", string(), qos).await.unwrap();
    expect_connected(right.matched_subscribers(), 1).await;
    expect_connected(subscription.matched.clone(), 1).await;
    right.publish(numbered_message(2));
    assert_eq!(numbers(&mut subscription, 1).await, [2]);
}

#[tokio::test]
async fn the_type_of_a_topic_is_what_its_ends_say() {
    let (one, two) = (join(46, "/one").await, join(46, "/two").await);
    let qos = QosProfile::keep_last(DEPTH);
    assert!(matches!(two.topic_type("/none").await, Err(BusError::NoTopic(_))));
    let _wanted = one.subscribe("/wanted", string(), qos).await.unwrap();
    let _offered = one.advertise("/offered", string(), qos).await.unwrap();
    let mut graph = two.graph();
    let both = graph.wait_for(|graph| graph.topics.contains_key("/wanted") && graph.topics.contains_key("/offered"));
    timeout(LONG, both).await.expect("in time").expect("the bus is open");
    for topic in ["/wanted", "/offered"] {
        let found = two.topic_type(topic).await.unwrap();
        assert_eq!((found.name, found.digest), (string().name, string().digest));
    }
    // An unspecified type means that of the others.
    let publisher = two.advertise("/wanted", WireType::any(), qos).await.unwrap();
    expect_connected(publisher.matched_subscribers(), 1).await;
    assert!(two.advertise("/none", WireType::any(), qos).await.is_err());
}

#[tokio::test]
async fn an_end_without_a_hash_is_known_by_the_name_of_its_type() {
    let bus = join(47, "/one").await;
    let publisher = bus.advertise("/chatter", string(), QosProfile::keep_last(DEPTH)).await.unwrap();
    let stranger = stranger(47).await;
    let topic = TopicDescription { user_data: Bytes::new(), ..names::topic("/chatter", &string()).unwrap() };
    assert!(type_hash::message_hash(&topic.user_data).is_any());
    let _reader = read(&stranger, topic, EndpointQos::default());
    expect_connected(publisher.matched_subscribers(), 1).await;
}

/// A ROS participant without nodes yet, with a writer of `/chatter`.
async fn newcomer(number: u16) -> (Participant, DataWriter) {
    let config = Config { user_data: Bytes::from_static(b"enclave=/;"), ..Config::new(domain(number), "newcomer") };
    let joined = Participant::join(Arc::new(BusSockets(Arc::new(HostSockets))), config).await;
    let participant = joined.expect("a domain can be joined");
    let topic = names::topic("/chatter", &string()).unwrap();
    let writer = participant.writer(topic, EndpointQos::default());
    (participant, writer)
}

/// Announces a node with this writer.
fn introduce(participant: &Participant, name: &str, writer: &DataWriter) -> DataWriter {
    let teller = participant.writer(entities::topic(), entities::qos());
    let node = entities::DiscoveredNode { name: name.into(), readers: Vec::new(), writers: vec![writer.guid()] };
    let told = entities::encode(participant.guid(), &[node], Default::default());
    teller.write(told);
    teller
}

/// Waits until the writer's reader has matched.
async fn wait_until_known(writer: &DataWriter) {
    let mut ends = writer.watch_matches();
    let known = ends.wait_for(|ends| !ends.confirmed.is_empty());
    let known = timeout(LONG, known).await;
    known.expect("in time").expect("it is open");
}

#[tokio::test]
async fn messages_wait_for_the_name_of_their_node() {
    let bus = join(48, "/one").await;
    let qos = QosProfile::keep_last(DEPTH);
    let mut subscription = bus.subscribe("/chatter", string(), qos).await.unwrap();
    let (participant, writer) = newcomer(48).await;
    wait_until_known(&writer).await;
    writer.write(numbered_message(1));
    writer.write(numbered_message(2));
    let _teller = introduce(&participant, "/late", &writer);
    let first = next(&mut subscription).await;
    assert_eq!((first.bytes, first.publisher.node()), (numbered_message(1), "/late"));
    writer.write(numbered_message(3));
    assert_eq!(numbers(&mut subscription, 2).await, [2, 3]);
    let told = wait_for_matched(subscription.matched.clone(), |matched| matched.has_node("/late"));
    assert_eq!(told.await.peers[0].id, first.publisher);
}

#[tokio::test]
async fn a_node_that_never_tells_its_name_is_known_by_its_participant() {
    let bus = join(52, "/one").await;
    let qos = QosProfile::keep_last(DEPTH);
    let mut subscription = bus.subscribe("/chatter", string(), qos).await.unwrap();
    let (participant, writer) = newcomer(52).await;
    wait_until_known(&writer).await;
    assert_eq!(subscription.matched.borrow().peers, []);
    writer.write(numbered_message(1));
    let first = next(&mut subscription).await;
    let guid = participant.guid().to_string();
    assert_eq!((first.bytes, first.publisher.node()), (numbered_message(1), &*guid));
    let before = wait_for_matched(subscription.matched.clone(), |matched| matched.has_node(&guid));
    let before = before.await;
    // Its id stays the same if it announces its node after all.
    let _teller = introduce(&participant, "/late", &writer);
    let after = wait_for_matched(subscription.matched.clone(), |matched| matched.has_node("/late"));
    assert_eq!(before.peers[0].id, after.await.peers[0].id);
}

/// Messages are opaque bytes to the bus: the queue of a slow receiver keeps the newest.
#[tokio::test]
async fn a_slow_receiver_loses_what_is_oldest_and_it_is_counted() {
    let (one, two) = (join(49, "/one").await, join(49, "/two").await);
    let mut slow = two.subscribe("/fast", string(), QosProfile::keep_last(2)).await.unwrap();
    let mut quick = two.subscribe("/fast", string(), QosProfile::keep_last(50)).await.unwrap();
    let publisher = one.advertise("/fast", string(), QosProfile::keep_last(50)).await.unwrap();
    expect_connected(publisher.matched_subscribers(), 1).await;
    expect_connected(quick.matched.clone(), 1).await;
    for number in 0..20 {
        publisher.publish(numbered_message(number));
    }
    assert_eq!(numbers(&mut quick, 20).await, (0..20).collect::<Vec<u8>>());
    assert_eq!(numbers(&mut slow, 2).await, [18, 19]);
    assert_eq!(slow.dropped.get(), 18);
}

#[tokio::test]
async fn what_was_published_before_the_end_arrives() {
    let two = join(60, "/two").await;
    let qos = QosProfile::keep_last(100);
    let mut subscription = two.subscribe("/chatter", string(), qos).await.unwrap();
    for (number, closed) in [(1, true), (2, false)] {
        let one = join(60, "/one").await;
        let publisher = one.advertise("/chatter", string(), qos).await.unwrap();
        expect_connected(publisher.matched_subscribers(), 1).await;
        // More than fits into the buffers in between.
        let mut long = numbered_message(number).to_vec();
        long.resize(500_000, 0);
        for _ in 0..40 {
            publisher.publish(long.clone().into());
        }
        if closed {
            one.close().await
        } else {
            drop(publisher)
        }
        assert_eq!(numbers(&mut subscription, 40).await, [number; 40]);
    }
}
