//! Topics from clients to nodes.

use rosbridge::{Compression, Format, Op, Publish};
use serde_json::{Value, json};

use super::support::{World, with_timeout};

#[tokio::test]
async fn what_is_published_right_behind_advertise_arrives() {
    let world = World::new().await;
    let mut heard = world.node_subscribes("/text", "std_msgs/String").await;
    let mut client = world.client().await;
    client.send(json!({"op": "advertise", "topic": "/text", "type": "std_msgs/String"})).await;
    for number in 0..20 {
        client.send(json!({"op": "publish", "topic": "/text", "msg": {"data": format!("{number}")}})).await;
    }
    client.send(json!({"op": "unadvertise", "topic": "/text"})).await;
    client.abort().await;
    for number in 0..20 {
        let message = with_timeout(heard.messages.recv()).await.unwrap();
        assert_eq!(world.json("std_msgs/String", &message.bytes), json!({"data": format!("{number}")}));
    }
}

#[tokio::test]
async fn missing_fields_are_filled_and_missing_stamps_are_now() {
    let world = World::new().await;
    let mut heard = world.node_subscribes("/place", "x_msgs/Place").await;
    let mut client = world.client().await;
    client.send(json!({"op": "advertise", "topic": "/place", "type": "x_msgs/msg/Place"})).await;
    client.send(json!({"op": "publish", "topic": "/place", "msg": {"x": 2}})).await;
    let message = with_timeout(heard.messages.recv()).await.unwrap();
    let value = world.json("x_msgs/Place", &message.bytes);
    assert_eq!((&value["x"], &value["near"], &value["tags"]), (&json!(2.0), &json!([]), &json!([])));
    assert!(world.seconds(&value["header"]["stamp"]) > 1_500_000_000);
    // Clients that want to know are told.
    client.send(json!({"op": "set_level", "level": "warning"})).await;
    client.send(json!({"op": "publish", "id": "p", "topic": "/place", "msg": {"x": 2, "near": []}})).await;
    // The header is the server's responsibility, according to the protocol.
    assert_eq!(
        client.json().await,
        json!({"op": "status", "id": "p", "level": "warning",
            "msg": "publish: topic /place: using defaults for \"tags\""})
    );
}

#[tokio::test]
async fn without_advertise_the_type_is_the_topics() {
    let world = World::new().await;
    let mut heard = world.node_subscribes("/text", "std_msgs/String").await;
    world.wait_for_graph(|graph| graph.topics.contains_key("/text")).await;
    let mut client = world.client().await;
    client.sync().await;
    client.send(json!({"op": "publish", "topic": "/text", "msg": {"data": "x"}})).await;
    let message = with_timeout(heard.messages.recv()).await.unwrap();
    assert_eq!(message.bytes, world.message("std_msgs/String", json!({"data": "x"})));
    client.send(json!({"op": "publish", "topic": "/nothing", "msg": {}})).await;
    assert_eq!(client.refusal().await, "publish: topic /nothing does not exist; advertise it with its type first");
}

#[tokio::test]
async fn ros_bytes_pass_through_untouched_and_are_checked() {
    let world = World::new().await;
    let mut heard = world.node_subscribes("/bytes", "std_msgs/UInt8MultiArray").await;
    let mut client = world.client().await;
    let md5 = world.wire_type("std_msgs/UInt8MultiArray").digest.to_string();
    client.send(json!({"op": "advertise", "topic": "/bytes", "type": "std_msgs/UInt8MultiArray", "md5sum": md5})).await;
    let message = world.message("std_msgs/UInt8MultiArray", json!({"data": vec![5; 100_000]}));
    let frame = |bytes: &[u8]| {
        let mut msg = Vec::new();
        let mut writer = rosbridge::Writer::new(&mut msg, Format::Cbor);
        writer.bytes("bytes", bytes);
        writer.end();
        let op = Op::from(Publish {
            id: Some("p1".into()),
            topic: "/bytes".into(),
            msg: rosbridge::Payload::cbor(&msg),
            compression: Compression::CborRaw,
            latch: false,
            type_name: None,
            qos: None,
        });
        let mut out = Vec::new();
        op.print(&mut out, Format::Cbor);
        out
    };
    client.send_binary(frame(&message)).await;
    assert_eq!(with_timeout(heard.messages.recv()).await.unwrap().bytes, message);
    client.send_binary(frame(&message[..1000])).await;
    let status = client.binary().await;
    let Op::Status(status) = Op::parse(rosbridge::ProtocolFrame::Binary(&status)).unwrap() else {
        panic!("{status:?}")
    };
    assert_eq!(status.id, Some("p1".into()));
    let expected = format!("publish: topic /bytes: field data of {}: ", world.message_name("std_msgs/UInt8MultiArray"));
    assert!(status.msg.starts_with(&expected), "{}", status.msg);
    client.send(json!({"op": "advertise", "topic": "/other", "type": "std_msgs/String", "md5sum": md5})).await;
    let ours = world.wire_type("std_msgs/String").digest;
    let expected = format!("has {} {ours} here and {md5} there", world.digest_word());
    assert!(client.refusal().await.contains(&expected));
}

#[tokio::test]
async fn a_client_latches_for_nodes_and_clients_that_come_later() {
    for words in [
        json!({"latch": true}),
        json!({"qos": {"durability": "transient_local"}}),
        json!({"qos": {"durability": 1, "depth": 1, "reliability": 1, "history": 1}}),
    ] {
        assert_latches(words).await;
    }
}

/// Asserts that a client that advertises with these fields latches.
async fn assert_latches(words: Value) {
    let world = World::new().await;
    let mut client = world.client().await;
    let mut advertise = json!({"op": "advertise", "topic": "/map", "type": "std_msgs/Int32"});
    for (key, value) in words.as_object().unwrap() {
        advertise[key] = value.clone();
    }
    client.send(advertise).await;
    client.send(json!({"op": "publish", "topic": "/map", "msg": {"data": 42}})).await;
    client.sync().await;
    let mut late = world.client().await;
    late.send(json!({"op": "subscribe", "topic": "/map"})).await;
    assert_eq!(late.json().await["msg"], json!({"data": 42}));
    let mut heard = world.node_subscribes("/map", "std_msgs/Int32").await;
    assert_eq!(with_timeout(heard.messages.recv()).await.unwrap().bytes, world.serialize(&[42, 0, 0, 0]));
    client.send(json!({"op": "unadvertise", "topic": "/map"})).await;
    client.sync().await;
    let mut later = world.client().await;
    later.send(json!({"op": "subscribe", "topic": "/map", "type": "std_msgs/Int32"})).await;
    later.sync().await;
}

#[tokio::test]
async fn what_does_not_fit_is_refused_by_field_and_the_connection_lives() {
    let world = World::new().await;
    let _heard = world.node_subscribes("/text", "std_msgs/String").await;
    world.wait_for_graph(|graph| graph.topics.contains_key("/text")).await;
    let mut client = world.client().await;
    client.sync().await;
    client.send(json!({"op": "advertise", "topic": "/place", "type": "x_msgs/Place"})).await;
    for (msg, field) in [
        (json!({"x": "far"}), "x"),
        (json!({"tags": [{"number": 300}]}), "tags[0].number"),
        (json!({"header": {"stamp": 5}}), "header.stamp"),
        (json!({"y": 1}), "y"),
    ] {
        client.send(json!({"op": "publish", "id": "p", "topic": "/place", "msg": msg})).await;
        let text = client.refusal().await;
        let of = world.message_name("x_msgs/Place");
        let expected = format!("publish: topic /place: field {field} of {of}: ");
        assert!(text.starts_with(&expected), "{text}");
    }
    client.send(json!({"op": "advertise", "topic": "/lost", "type": "x_msgs/Lost"})).await;
    assert_eq!(
        client.refusal().await,
        format!(
            "advertise: topic /lost: no definition of {} is known here; the deployer of this service can add it: \
                cloudroidctl push … of a workspace that also has x_msgs",
            world.message_name("x_msgs/Lost")
        )
    );
    client.send(json!({"op": "advertise", "topic": "/text", "type": "std_msgs/Int32"})).await;
    assert_eq!(
        client.refusal().await,
        format!(
            "advertise: topic /text has type {}, not {}; use the type that it has",
            world.message_name("std_msgs/String"),
            world.message_name("std_msgs/Int32")
        )
    );
    client.send_text(r#"{"op":"publish","topic":"/place","msg":{"x":1}"#).await;
    assert_eq!(client.refusal().await, "invalid JSON at byte 46: a comma or the object's end is expected");
    client.send_text(r#"{"op":"publish","topic":"/place","msg":{"x":01}}"#).await;
    assert!(client.refusal().await.starts_with("publish: topic /place: "));
    client.sync().await;
}

#[tokio::test]
async fn a_message_that_is_left_out_is_one_of_defaults() {
    let world = World::new().await;
    let mut heard = world.node_subscribes("/place", "x_msgs/Place").await;
    let mut client = world.client().await;
    client.send(json!({"op": "advertise", "topic": "/place", "type": "x_msgs/Place"})).await;
    client.send(json!({"op": "publish", "topic": "/place"})).await;
    let message = with_timeout(heard.messages.recv()).await.unwrap();
    let value = world.json("x_msgs/Place", &message.bytes);
    assert_eq!((&value["x"], &value["tags"]), (&json!(0.0), &json!([])));
    assert!(world.seconds(&value["header"]["stamp"]) > 1_500_000_000);
    client.sync().await;
}

#[tokio::test]
async fn stamps_may_be_written_as_in_either_ros() {
    let world = World::new().await;
    let mut heard = world.node_subscribes("/place", "x_msgs/Place").await;
    let mut client = world.client().await;
    client.send(json!({"op": "advertise", "topic": "/place", "type": "x_msgs/Place"})).await;
    for stamp in [json!({"sec": 5, "nanosec": 6}), json!({"nanosec": 6, "sec": 5}), json!({"secs": 5, "nsecs": 6})] {
        let header = json!({"stamp": stamp});
        client.send(json!({"op": "publish", "topic": "/place", "msg": {"header": header}})).await;
        let message = with_timeout(heard.messages.recv()).await.unwrap();
        let value = world.json("x_msgs/Place", &message.bytes);
        assert_eq!(value["header"]["stamp"], world.time(5, 6));
    }
    client.sync().await;
}

#[tokio::test]
async fn a_topic_stays_until_its_last_advertisement_is_taken_back() {
    let world = World::new().await;
    let mut heard = world.node_subscribes("/text", "std_msgs/String").await;
    let mut client = world.client().await;
    client.send(json!({"op": "set_level", "level": "warning"})).await;
    for id in ["one", "two", "two"] {
        client.send(json!({"op": "advertise", "id": id, "topic": "/text", "type": "std_msgs/String"})).await;
    }
    let unadvertise = |id| json!({"op": "unadvertise", "id": id, "topic": "/text"});
    client.send(unadvertise("other")).await;
    assert_eq!(client.json().await["msg"], "unadvertise: there is no advertisement with this id of /text");
    client.send(unadvertise("one")).await;
    client.send(json!({"op": "publish", "topic": "/text", "msg": {"data": "x"}})).await;
    with_timeout(heard.messages.recv()).await.unwrap();
    client.sync().await;
    world.wait_for_graph(|graph| !graph.topics["/text"].publishers.is_empty()).await;
    client.send(unadvertise("two")).await;
    world.wait_for_graph(|graph| graph.topics["/text"].publishers.is_empty()).await;
    client.send(unadvertise("two")).await;
    assert_eq!(client.json().await["msg"], "unadvertise: this client does not advertise /text");

    // Without an id, all of them are meant.
    for id in ["one", "two"] {
        client.send(json!({"op": "advertise", "id": id, "topic": "/text", "type": "std_msgs/String"})).await;
    }
    world.wait_for_graph(|graph| !graph.topics["/text"].publishers.is_empty()).await;
    client.send(json!({"op": "unadvertise", "topic": "/text"})).await;
    world.wait_for_graph(|graph| graph.topics["/text"].publishers.is_empty()).await;

    // A message advertises its topic, under its own id.
    let message = json!({"op": "publish", "id": "one", "topic": "/text", "msg": {"data": "x"}});
    client.send(message).await;
    with_timeout(heard.messages.recv()).await.unwrap();
    client.send(unadvertise("one")).await;
    world.wait_for_graph(|graph| graph.topics["/text"].publishers.is_empty()).await;
    client.sync().await;
}

#[tokio::test]
async fn why_nothing_can_be_published_is_said_once() {
    let world = World::new().await;
    let mut client = world.client().await;
    client.send(json!({"op": "advertise", "topic": "/plan", "type": "nav_msgs/Path"})).await;
    let hint = world.by_version("--with ros-nav-msgs", "of a workspace that also has nav_msgs");
    assert_eq!(
        client.refusal().await,
        format!(
            "advertise: topic /plan: no definition of {} is known here; the deployer of this service can add it: \
                cloudroidctl push … {hint}",
            world.message_name("nav_msgs/Path")
        )
    );
    let typed = json!({"op": "publish", "topic": "/route", "type": "nav_msgs/Path", "msg": {}});
    let untyped = json!({"op": "publish", "topic": "/plan", "msg": {}});
    for _ in 0..10 {
        client.send(untyped.clone()).await;
        client.send(typed.clone()).await;
    }
    // The error of the topic that was advertised has been reported; the other one is reported now.
    assert!(client.refusal().await.contains(hint));
    client.sync().await;
    // A client that asks again is told again.
    client.send(json!({"op": "unadvertise", "topic": "/route"})).await;
    client.send(typed).await;
    client.refusal().await;
}
