//! Definitions that are sent with messages, as by publishers of ROS 1.

use serde_json::json;

use super::support::World;

#[tokio::test]
async fn a_publisher_with_another_definition_is_read_by_its_own() {
    let world = World::new().await;
    // The same name as one of ours, from a newer version of its package.
    let definition = "string name\nuint8 number\nbool new\n".to_owned();
    let newer = ros::schema::MessageType::from_full_text("x_msgs/Tag", &definition).unwrap();
    let wire_type = |definition: String| ros::bus::WireType::new("x_msgs/Tag", newer.md5(), definition);
    let bytes = bytes::Bytes::from_static(b"\x01\0\0\0x\x07\x01");
    let told = ros::bus::Bus::advertise(
        &*world.node,
        "/told",
        wire_type(definition),
        ros::bus::QosProfile::keep_last(1).latching(true),
    )
    .await
    .unwrap();
    told.publish(bytes.clone());
    let mute = ros::bus::Bus::advertise(
        &*world.node,
        "/mute",
        wire_type(String::new()),
        ros::bus::QosProfile::keep_last(1).latching(true),
    )
    .await
    .unwrap();
    mute.publish(bytes);
    world.wait_for_graph(|graph| graph.topics.contains_key("/told") && graph.topics.contains_key("/mute")).await;
    let mut client = world.client().await;
    for topic in ["/told", "/mute"] {
        client.send(json!({"op": "subscribe", "topic": topic, "type": "x_msgs/Tag"})).await;
        let heard = client.json().await;
        if topic == "/told" {
            let value = json!({"name": "x", "number": 7, "new": true});
            assert_eq!(heard["msg"], value, "{heard}");
        } else {
            let expected = format!("subscribe: topic /mute: its type x_msgs/Tag has MD5 {}, ours has ", newer.md5());
            let text = heard["msg"].as_str().unwrap();
            assert!(text.starts_with(&expected), "{heard}");
        }
    }
    client.sync().await;
}

#[tokio::test]
async fn types_that_only_the_publisher_knows_are_learnt_from_it() {
    let world = World::new().await;
    let definition = "int32 a\nstring b\n".to_owned();
    let message_type = ros::schema::MessageType::from_full_text("y_msgs/New", &definition).unwrap();
    let wire_type = ros::bus::WireType::new("y_msgs/New", message_type.md5(), definition);
    let publisher =
        ros::bus::Bus::advertise(&*world.node, "/new", wire_type, ros::bus::QosProfile::keep_last(1).latching(true))
            .await
            .unwrap();
    publisher.publish(vec![1, 0, 0, 0, 1, 0, 0, 0, b'x'].into());
    world.wait_for_graph(|graph| graph.topics.contains_key("/new")).await;
    let mut client = world.client().await;
    client.send(json!({"op": "subscribe", "topic": "/new"})).await;
    assert_eq!(client.json().await["msg"], json!({"a": 1, "b": "x"}));
}
