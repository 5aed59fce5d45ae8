use std::time::Duration;

use ros::bus::{Bus, Graph, QosProfile, WireType};
use ros::net::HostSockets;
use ros::ros1::Ros1Bus;
use ros::ros1::master::{Master, MasterOptions};
use ros::schema::Registry;
use tokio::net::TcpListener;
use tokio::time::timeout;

use super::*;
use crate::BridgeOptions;

/// Bounds the duration of a failing test.
const PATIENCE: Duration = Duration::from_secs(120);

/// Events that must not occur.
struct Fails;

impl PublisherEvents for Fails {
    fn on_failed(&self, reason: &str) {
        panic!("{reason}")
    }

    fn on_refused(&self, reason: &str) {
        panic!("{reason}")
    }
}

async fn wait_for_graph(bus: &dyn Bus, condition: impl Fn(&Graph) -> bool) {
    let mut graph = bus.graph();
    let seen = graph.wait_for(|graph| condition(graph));
    timeout(PATIENCE, seen).await.expect("in time").unwrap();
}

/// Returns the connected subscribers, as soon as the topic is advertised.
async fn wait_advertised(topic_publisher: &TopicPublisher) -> watch::Receiver<MatchedPeers> {
    let advertised = async {
        loop {
            if let State::Warming { publisher: Some(publisher), .. } = &*topic_publisher.state.lock() {
                return publisher.match_events();
            }
            tokio::task::yield_now().await;
        }
    };
    timeout(PATIENCE, advertised).await.expect("in time")
}

fn is_live(topic_publisher: &TopicPublisher) -> bool {
    matches!(*topic_publisher.state.lock(), State::Live { .. })
}

async fn subscribe(node: &Ros1Bus, md5: &str) -> ros::bus::Subscription {
    let wire_type = WireType::new("std_msgs/Int32", md5, "");
    node.subscribe("/number", wire_type, QosProfile::keep_last(100)).await.unwrap()
}

#[tokio::test]
async fn a_subscriber_that_never_matches_is_waited_for_once() {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    let master = Master::new(MasterOptions { uri: format!("http://{address}/"), ..MasterOptions::default() });
    tokio::spawn(async move { master.serve(listener, Arc::new(HostSockets)).await });
    let node = |name| Ros1Bus::connect(Arc::new(HostSockets), address, name);
    let bus = node("/bridge").await.unwrap();
    let (odd, fitting) = (node("/odd").await.unwrap(), node("/fitting").await.unwrap());
    let registry = Registry::new();
    registry.insert("std_msgs/msg/Int32", "int32 data\n").unwrap();
    let message_type = registry.message("std_msgs/Int32").unwrap();
    let options = BridgeOptions {
        // The test itself decides when it is over.
        warm_up: PATIENCE * 10,
        ..BridgeOptions::default()
    };
    let shared = BridgeShared::new(bus.clone(), Arc::new(registry), options);

    let _never = subscribe(&odd, "0123456789abcdef0123456789abcdef").await;
    wait_for_graph(&*bus, |graph| graph.topics.get("/number").is_some_and(|nodes| nodes.subscribers == ["/odd"])).await;
    let offer = PublisherOffer { qos: QosProfile::keep_last(10), latch: false };
    let topic_publisher = TopicPublisher::open(&shared, "/number", message_type.clone(), offer, Arc::new(Fails));
    let subscribers = wait_advertised(&topic_publisher).await;
    assert!(!is_live(&topic_publisher), "it waits");
    let over = Instant::now();
    let later = Instant::now() + PATIENCE * 10;
    let still = WaitDeadlines { some: over, none: later };
    let waiting = go_live_once_connected(topic_publisher.clone(), subscribers.clone(), still);
    let waited = timeout(Duration::from_millis(100), waiting).await;
    assert!(waited.is_err() && !is_live(&topic_publisher), "nobody else waits for it");
    let both = WaitDeadlines { some: over, none: over };
    go_live_once_connected(topic_publisher.clone(), subscribers, both).await;
    assert!(is_live(&topic_publisher), "it has waited long enough");

    // The graph changes, and messages are still sent at once.
    for number in 0..3 {
        let name = format!("/other{number}");
        let _other =
            odd.advertise(&name, (*topic_publisher.wire_type).clone(), QosProfile::keep_last(1)).await.unwrap();
        wait_for_graph(&*bus, |graph| graph.topics.contains_key(&name)).await;
        topic_publisher.publish(vec![0; 4].into());
        assert!(is_live(&topic_publisher), "message {number} waits");
    }

    // A later subscriber is waited for, and misses no message.
    let mut heard = subscribe(&fitting, message_type.md5()).await;
    wait_for_graph(&*bus, |graph| graph.topics["/number"].subscribers.len() == 2).await;
    topic_publisher.publish(vec![7; 4].into());
    let first = timeout(PATIENCE, heard.messages.recv()).await;
    assert_eq!(&*first.expect("in time").unwrap().bytes, [7; 4]);
}
