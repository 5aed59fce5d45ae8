use ros::bus::{Bus, MatchedPeers, QosProfile, QosReliability, SerializedMessage, Subscription, WireType};
use ros::bus::{RosVersion, wait_for_connected};
use ros::schema::MessageType;
use serde_json::json as value;
use tokio::sync::watch;
use tokio::time::timeout;

use super::lab::{LONG, Lab, json, string, string_message, string_type, wait_graph};

const NODE: &str = "/cloudroid_bridge";

async fn next(subscription: &mut Subscription) -> SerializedMessage {
    let message = timeout(LONG, subscription.messages.recv()).await;
    message.expect("a message should come").expect("the bus is open")
}

/// Ignores padding.
fn text(message: &SerializedMessage) -> String {
    let json = json(&string(), &message.bytes);
    let text = json.strip_prefix(r#"{"data":""#).expect("a string");
    text.trim_end_matches(r#""}"#).to_owned()
}

async fn wait_connected(matched: watch::Receiver<MatchedPeers>) {
    let reached = timeout(LONG, wait_for_connected(matched, 1)).await;
    reached.expect("somebody should be connected");
}

async fn wait_until(
    mut matched: watch::Receiver<MatchedPeers>,
    wanted: impl Fn(&MatchedPeers) -> bool,
) -> MatchedPeers {
    let found = timeout(LONG, matched.wait_for(|matched| wanted(matched))).await;
    found.expect("in time").expect("the bus is open").clone()
}

#[tokio::test]
async fn messages_go_there_and_back() {
    let lab = Lab::new();
    let mut peer = lab.peer().await;
    let bus = lab.join(NODE).await;
    let qos = QosProfile::keep_last(100);
    let mut pong = bus.subscribe("/pong", string_type(), qos).await.unwrap();
    let ping = bus.advertise("/ping", string_type(), qos).await.unwrap();
    wait_connected(ping.matched_subscribers()).await;
    wait_connected(pong.matched.clone()).await;
    // The node's own endpoints keep 10.
    let numbers: Vec<String> = (0..50).map(|number: u8| number.to_string()).collect();
    for some in numbers.chunks(10) {
        for number in some {
            ping.publish(string_message(number));
        }
        for number in some {
            let message = next(&mut pong).await;
            assert_eq!(text(&message), *number);
            assert_eq!(message.publisher.node(), "/lab/peer");
            assert_eq!(
                (&message.wire_type.name, &message.wire_type.digest),
                (&string_type().name, &string_type().digest)
            );
        }
    }
    // Its tools show the owner and the type of our endpoints.
    let digest = string_type().digest.to_string();
    let shown = value!([[NODE, "std_msgs/msg/String", digest]]);
    assert_eq!(value!(peer.obey("publishers_of /ping").await), shown);
    wait_graph(&bus, |graph| {
        let ends = graph.topics.get("/ping").map(|it| (&it.publishers[..], &it.subscribers[..]));
        ends == Some((&[NODE.to_owned()], &["/lab/peer".to_owned()]))
    })
    .await;
}

#[tokio::test]
async fn what_was_published_before_is_heard_by_both_sides() {
    let lab = Lab::new();
    let mut peer = lab.peer().await;
    let bus = lab.join(NODE).await;
    let latched = QosProfile::keep_last(1).latching(true);
    let mut map = bus.subscribe("/map", string_type(), latched).await.unwrap();
    let message = next(&mut map).await;
    assert_eq!((&*text(&message), message.latching), ("kept", true));
    let late = bus.advertise("/late", string_type(), latched).await.unwrap();
    late.publish(string_message("from the bus"));
    assert_eq!(peer.wait_for("late").await, [value!("from the bus")]);
}

#[tokio::test]
async fn a_wish_for_more_hears_a_best_effort_publisher() {
    let lab = Lab::new();
    let _peer = lab.peer().await;
    let bus = lab.join(NODE).await;
    let wish = QosProfile::keep_last(5).latching(true);
    let mut scan = bus.subscribe("/scan", WireType::any(), wish).await.unwrap();
    let message = next(&mut scan).await;
    assert_eq!((&*text(&message), message.latching), ("seen", false));
    assert_eq!(message.wire_type.name, "std_msgs/msg/String");
    assert_eq!(scan.matched.borrow().refused, []);
}

#[tokio::test]
async fn a_subscriber_that_asks_for_more_and_one_of_another_type_are_said() {
    let lab = Lab::new();
    let _peer = lab.peer().await;
    let bus = lab.join(NODE).await;
    let less = QosProfile { reliability: QosReliability::BestEffort, ..QosProfile::keep_last(1) };
    let strict = bus.advertise("/strict", string_type(), less).await.unwrap();
    let told = wait_until(strict.matched_subscribers(), |matched| {
        let mut refused = matched.refused.iter();
        refused.any(|refusal| refusal.peer.node() == "/lab/peer")
    });
    let told = told.await;
    assert_eq!(told.peers, []);
    assert_eq!(
        told.refused[0].why,
        "reliability: the publisher offers best_effort, the subscriber asks for reliable \
         (publisher: best_effort, volatile; subscriber: reliable, volatile)"
    );
    let other = MessageType::parse_full_text(RosVersion::Two, "std_msgs/msg/String", "string text");
    let of = WireType::from_message(&other.unwrap());
    let pong = bus.subscribe("/pong", of, QosProfile::keep_last(1)).await.unwrap();
    let told = wait_until(pong.matched.clone(), |matched| !matched.refused.is_empty()).await;
    assert!(told.refused[0].why.starts_with("its type is std_msgs/msg/String RIHS01_"));
}

#[tokio::test]
async fn a_node_that_is_killed_is_noticed() {
    let lab = Lab::new();
    let mut peer = lab.peer().await;
    let bus = lab.join(NODE).await;
    let pong = bus.subscribe("/pong", string_type(), QosProfile::keep_last(1)).await.unwrap();
    wait_connected(pong.matched.clone()).await;
    wait_graph(&bus, |graph| graph.nodes.contains_key("/lab/peer")).await;
    let begun = std::time::Instant::now();
    peer.kill();
    wait_until(pong.matched.clone(), |matched| matched.peers.is_empty()).await;
    wait_graph(&bus, |graph| !graph.nodes.contains_key("/lab/peer")).await;
    // Its own lease is 20 s; its ports are checked five times a second.
    assert!(begun.elapsed() < std::time::Duration::from_secs(2), "{:?}", begun.elapsed());
}
