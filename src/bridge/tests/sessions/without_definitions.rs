//! Types whose definitions are not sent with messages, as in ROS 2: only the servant's own exist.

use ros::bus::{Bus, Digest, QosProfile, WireType};
use rosbridge::{Op, ProtocolFrame};
use serde_json::json;

use super::support::World;

#[tokio::test]
async fn a_topic_whose_type_nobody_has_defined_is_refused_by_name_but_as_ros_bytes() {
    let world = World::new().await;
    let of = WireType { name: "y_msgs/msg/New".to_owned(), ..world.wire_type("std_msgs/Int32") };
    let qos = QosProfile::keep_last(1).latching(true);
    let publisher = Bus::advertise(&*world.node, "/new", of, qos).await.unwrap();
    let message = world.serialize(&[7, 0, 0, 0]);
    publisher.publish(message.clone());
    world.wait_for_graph(|graph| graph.topics.contains_key("/new")).await;
    let mut client = world.client().await;
    for type_name in [None, Some("y_msgs/New")] {
        client.send(json!({"op": "subscribe", "topic": "/new", "type": type_name})).await;
        assert_eq!(
            client.refusal().await,
            "subscribe: topic /new: no definition of y_msgs/msg/New is known here; the deployer of this service can \
                add it: cloudroidctl push … of a workspace that also has y_msgs"
        );
    }
    client.send(json!({"op": "subscribe", "topic": "/new", "compression": "cbor-raw"})).await;
    let frame = client.binary().await;
    let Op::Publish(heard) = Op::parse(ProtocolFrame::Binary(&frame)).unwrap() else { panic!("{frame:?}") };
    // As they were on the wire, including the header of their serialization.
    assert_eq!(*heard.msg.raw().unwrap().bytes, message);
}

#[tokio::test]
async fn a_publisher_of_another_type_hash_is_named() {
    let world = World::new().await;
    let ours = world.wire_type("x_msgs/Tag");
    let theirs = Digest::from(format!("RIHS01_{}", "0f".repeat(32)));
    let of = WireType { digest: theirs.clone(), ..ours.clone() };
    let qos = QosProfile::keep_last(1).latching(true);
    let publisher = Bus::advertise(&*world.node, "/tag", of, qos).await.unwrap();
    publisher.publish(world.message("x_msgs/Tag", json!({"name": "x"})));
    world.wait_for_graph(|graph| graph.topics.contains_key("/tag")).await;
    let mut client = world.client().await;
    client.send(json!({"op": "subscribe", "topic": "/tag"})).await;
    assert_eq!(
        client.refusal().await,
        format!("subscribe: topic /tag: its type x_msgs/msg/Tag has type hash {theirs}, ours has {}", ours.digest)
    );
    client.sync().await;
}

#[tokio::test]
async fn who_uses_an_action_by_topics_is_told_the_operation() {
    let world = World::new().await;
    let mut client = world.client().await;
    client.send(json!({"op": "advertise", "topic": "/count/goal", "type": "x_msgs/CountActionGoal"})).await;
    assert_eq!(
        client.refusal().await,
        "advertise: topic /count/goal: no definition of x_msgs/msg/CountActionGoal is known here: ROS 1 actions \
            consist of topics with such messages, but this servant uses ROS 2; use send_action_goal and \
            advertise_action"
    );
    client.sync().await;
}
