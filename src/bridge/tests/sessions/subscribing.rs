//! Topics from nodes to clients.

use std::time::Duration;

use bridge::{BridgeOptions, SessionOptions};
use ros::bus::RosVersion;
use ros::codec::{self, FillOptions};
use rosbridge::{Op, ProtocolFrame};
use serde_json::json;

use super::support::{World, patient, wait_connected};

#[tokio::test]
async fn a_node_publishes_and_the_client_hears_it_in_every_encoding() {
    let world = World::new().await;
    let publisher = world.node_publishes("/place", "x_msgs/Place", false).await;
    let mut value = json!({
        "header": {"stamp": world.time(2, 3), "frame_id": "map"},
        "x": 1.5, "near": [1.0, 2.5], "tags": [{"name": "döör", "number": 7}],
    });
    if world.version() == RosVersion::One {
        value["header"]["seq"] = 1.into();
    }
    let bytes = world.message("x_msgs/Place", value.clone());
    for compression in ["none", "png", "preview", "cbor", "cbor-raw"] {
        let mut client = world.client().await;
        client.send(json!({"op": "subscribe", "topic": "/place", "compression": compression})).await;
        client.sync().await;
        wait_connected(publisher.as_ref(), 1).await;
        publisher.publish(bytes.clone());
        match compression {
            "none" => assert_eq!(client.json().await, json!({"op": "publish", "topic": "/place", "msg": value})),
            "png" => {
                let packed = client.json().await;
                assert_eq!(packed["op"], "png");
                let text = rosbridge::decode_png(packed["data"].as_str().unwrap(), 10_000).unwrap();
                // Browsers interpret each byte as a character.
                assert!(text.is_ascii(), "{text}");
                let unpacked: serde_json::Value = serde_json::from_str(&text).unwrap();
                assert_eq!(unpacked, json!({"op": "publish", "topic": "/place", "msg": value}));
            }
            _ => {
                let frame = client.binary().await;
                let Op::Publish(publish) = Op::parse(ProtocolFrame::Binary(&frame)).unwrap() else {
                    panic!("{frame:?}")
                };
                assert_eq!(publish.topic, "/place");
                if compression == "cbor-raw" {
                    assert_eq!(&*publish.msg.raw().unwrap().bytes, &*bytes);
                } else {
                    let message_type = world.registry.message("x_msgs/Place").unwrap();
                    let mut back = Vec::new();
                    codec::from_cbor(&message_type, publish.msg.bytes, &mut back, &FillOptions::default()).unwrap();
                    assert_eq!(back, bytes);
                }
            }
        }
        client.send(json!({"op": "unsubscribe", "topic": "/place"})).await;
        client.sync().await;
        client.abort().await;
        let mut subscribers = publisher.matched_subscribers();
        super::support::with_timeout(subscribers.wait_for(|now| now.connected_count() == 0)).await.unwrap();
    }
}

#[tokio::test]
async fn long_messages_come_in_fragments_where_asked_for() {
    let world = World::new().await;
    let publisher = world.node_publishes("/text", "std_msgs/String", false).await;
    let mut client = world.client().await;
    client.send(json!({"op": "subscribe", "topic": "/text", "fragment_size": 50})).await;
    client.sync().await;
    wait_connected(publisher.as_ref(), 1).await;
    let long = "äöü ".repeat(100);
    publisher.publish(world.message("std_msgs/String", json!({"data": long})));
    let mut text = String::new();
    loop {
        let fragment = client.json().await;
        assert_eq!(fragment["op"], "fragment");
        text.push_str(fragment["data"].as_str().unwrap());
        if fragment["num"].as_u64().unwrap() + 1 == fragment["total"].as_u64().unwrap() {
            break;
        }
    }
    let whole: serde_json::Value = serde_json::from_str(&text).unwrap();
    assert_eq!(whole["msg"]["data"], *long);
}

#[tokio::test]
async fn each_latching_publisher_is_replayed_to_a_newcomer() {
    let world = World::new().await;
    let other = world.another_node("/other").await;
    let one = world.node_publishes("/latched", "std_msgs/String", true).await;
    let two = world.publishes(&*other, "/latched", "std_msgs/String", true).await;
    one.publish(world.message("std_msgs/String", json!({"data": "one"})));
    two.publish(world.message("std_msgs/String", json!({"data": "two"})));
    let subscribe = json!({"op": "subscribe", "topic": "/latched", "queue_length": 1, "throttle_rate": 60000});
    let mut clients = [world.client().await, world.client().await];
    for client in &mut clients {
        client.send(subscribe.clone()).await;
        let mut heard = [client.json().await, client.json().await].map(|message| message["msg"]["data"].to_string());
        heard.sort();
        assert_eq!(heard, ["\"one\"", "\"two\""]);
    }
    // Another subscription with another id receives them, too.
    clients[0].send(json!({"op": "subscribe", "id": "again", "topic": "/latched"})).await;
    clients[0].json().await;
    clients[0].json().await;
    clients[0].sync().await;
}

#[tokio::test]
async fn subscribers_share_an_encoding() {
    let world = World::new().await;
    let publisher = world.node_publishes("/text", "std_msgs/String", false).await;
    let mut clients = Vec::new();
    for compression in ["none", "none", "none", "cbor", "cbor"] {
        let mut client = world.client().await;
        client.send(json!({"op": "subscribe", "topic": "/text", "compression": compression})).await;
        client.sync().await;
        clients.push(client);
    }
    wait_connected(publisher.as_ref(), 1).await;
    publisher.publish(world.message("std_msgs/String", json!({"data": "x"})));
    for client in &mut clients {
        client.next().await;
    }
    assert_eq!(world.bridge.metrics().encoded.get(), 2);
    assert_eq!(world.bridge.metrics().received.get(), 1);
}

#[tokio::test]
async fn subscriptions_are_ended_one_by_one_or_all_at_once() {
    let world = World::new().await;
    let publisher = world.node_publishes("/text", "std_msgs/String", false).await;
    let mut client = world.client().await;
    client.send(json!({"op": "subscribe", "id": "a", "topic": "/text"})).await;
    client.send(json!({"op": "subscribe", "id": "b", "topic": "/text", "compression": "cbor"})).await;
    client.sync().await;
    wait_connected(publisher.as_ref(), 1).await;
    let message = world.message("std_msgs/String", json!({"data": "x"}));
    publisher.publish(message.clone());
    client.binary().await;
    client.send(json!({"op": "unsubscribe", "id": "b", "topic": "/text"})).await;
    client.sync().await;
    publisher.publish(message.clone());
    client.json().await;
    client.send(json!({"op": "unsubscribe", "topic": "/text"})).await;
    client.sync().await;
    let mut subscribers = publisher.matched_subscribers();
    super::support::with_timeout(subscribers.wait_for(|now| now.connected_count() == 0)).await.unwrap();
    client.sync().await;
}

#[tokio::test]
async fn what_cannot_be_subscribed_to_is_refused_with_the_next_step() {
    let world = World::new().await;
    let _publisher = world.node_publishes("/text", "std_msgs/String", false).await;
    let mut client = world.client().await;
    client.send(json!({"op": "subscribe", "topic": "/nothing"})).await;
    assert_eq!(
        client.refusal().await,
        "subscribe: topic /nothing does not exist; give its \"type\" to wait for it; /rosapi/topics lists existing \
            topics"
    );
    client.send(json!({"op": "subscribe", "topic": "/nothing", "type": "x_msgs/Lost"})).await;
    assert_eq!(
        client.refusal().await,
        format!(
            "subscribe: topic /nothing: no definition of {} is known here; the deployer of this service can add it: \
                cloudroidctl push … of a workspace that also has x_msgs",
            world.message_name("x_msgs/Lost")
        )
    );
    client.send(json!({"op": "subscribe", "topic": "/text", "type": "std_msgs/Int32"})).await;
    assert_eq!(
        client.refusal().await,
        format!(
            "subscribe: topic /text has type {}, not {}; use the type that it has",
            world.message_name("std_msgs/String"),
            world.message_name("std_msgs/Int32")
        )
    );
    client.send(json!({"op": "subscribe", "topic": "/no spaces"})).await;
    assert!(client.refusal().await.starts_with("subscribe: \"/no spaces\" is not a ROS name"));
    client.sync().await;
}

#[tokio::test]
async fn a_node_that_sends_rubbish_is_named_and_harms_nobody() {
    let world = World::new().await;
    let publisher = world.node_publishes("/text", "std_msgs/String", false).await;
    let mut client = world.client().await;
    client.send(json!({"op": "subscribe", "topic": "/text"})).await;
    client.sync().await;
    wait_connected(publisher.as_ref(), 1).await;
    for _ in 0..100 {
        publisher.publish(world.serialize(&[0xff, 0xff, 0xff, 0xff, b'x']));
    }
    let text = client.refusal().await;
    let of = world.message_name("std_msgs/String");
    let expected = format!("subscribe: topic /text: field data of {of}: ");
    assert!(text.starts_with(&expected), "{text}");
    assert!(text.ends_with("(from /node)"), "{text}");
    publisher.publish(world.message("std_msgs/String", json!({"data": "well"})));
    assert_eq!(client.json().await["msg"]["data"], "well");
}

#[tokio::test]
async fn a_later_publisher_of_another_type_is_named_and_left_out() {
    let world = World::new().await;
    let mut client = world.client().await;
    client.send(json!({"op": "subscribe", "id": "s", "topic": "/late", "type": "std_msgs/String"})).await;
    client.sync().await;
    let other = world.another_node("/other").await;
    let wrong = world.publishes(&*other, "/late", "std_msgs/Int32", false).await;
    // In ROS 2 endpoints of different types do not even match.
    if world.version() == RosVersion::One {
        wait_connected(wrong.as_ref(), 1).await;
    }
    for _ in 0..100 {
        wrong.publish(world.message("std_msgs/Int32", json!({"data": 7})));
    }
    let status = client.json().await;
    let theirs = world.wire_type("std_msgs/Int32");
    let expected = world.by_version(
        "subscribe: topic /late: /other publishes std_msgs/Int32 there, not std_msgs/String; \
            its messages are dropped"
            .to_owned(),
        format!(
            "subscribe: topic /late: no messages pass between /other and this client: its type is {theirs} there and \
                std_msgs/msg/String * here"
        ),
    );
    assert_eq!(status, json!({"op": "status", "id": "s", "level": "error", "msg": expected}));
    // The right one is received, and the wrong one is not reported again and again.
    let right = world.node_publishes("/late", "std_msgs/String", false).await;
    wait_connected(right.as_ref(), 1).await;
    right.publish(world.message("std_msgs/String", json!({"data": "well"})));
    assert_eq!(client.json().await["msg"]["data"], "well");
    // The same client cannot request both.
    client.send(json!({"op": "subscribe", "id": "t", "topic": "/late", "type": "std_msgs/Int32"})).await;
    assert!(client.refusal().await.contains("/late"));
    client.sync().await;
}

#[tokio::test]
async fn clients_hear_each_other_and_themselves_but_links_do_not() {
    let world = World::new().await;
    let mut speaker = world.client().await;
    let mut hearer = world.client().await;
    let link = SessionOptions { hears_clients: false, ..SessionOptions::default() };
    let mut link = world.client_with(link).await;
    let subscribe = json!({"op": "subscribe", "topic": "chatter", "type": "std_msgs/String"});
    for client in [&mut speaker, &mut hearer, &mut link] {
        client.send(subscribe.clone()).await;
        client.sync().await;
    }
    speaker.send(json!({"op": "advertise", "topic": "/chatter", "type": "std_msgs/String"})).await;
    speaker.send(json!({"op": "publish", "topic": "/chatter", "msg": {"data": "hi"}})).await;
    for client in [&mut speaker, &mut hearer] {
        assert_eq!(client.json().await, json!({"op": "publish", "topic": "chatter", "msg": {"data": "hi"}}));
    }
    link.sync().await;
}

#[tokio::test]
async fn the_end_of_a_burst_comes_by_itself() {
    // Nothing else wakes the session: no pings, no frames of the client.
    let quiet = BridgeOptions { ping_interval: Duration::ZERO, idle_timeout: Duration::ZERO, ..patient() };
    let world = World::with_options(quiet).await;
    let publisher = world.node_publishes("/number", "std_msgs/Int32", false).await;
    for _ in 0..10 {
        let mut client = world.client().await;
        client.send(json!({"op": "subscribe", "topic": "/number", "throttle_rate": 20, "queue_length": 2})).await;
        client.sync().await;
        wait_connected(publisher.as_ref(), 1).await;
        for number in 1..=10 {
            publisher.publish(world.message("std_msgs/Int32", json!({"data": number})));
        }
        while client.json().await["msg"] != json!({"data": 10}) {}
    }
}
