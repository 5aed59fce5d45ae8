//! Quality of service requested by clients, and its effect where endpoints must match.

use ros::bus::{Bus, QosProfile};
use serde_json::json;

use super::support::{World, wait_connected, with_timeout};

#[tokio::test]
async fn a_subscriber_that_asks_for_more_is_named_once_with_what_both_say() {
    let world = World::new().await;
    let node = world.system.join_demanding("/mapper");
    let qos = QosProfile::keep_last(10).latching(true);
    let of = world.wire_type("std_msgs/Int32");
    let mut heard = node.subscribe("/map", of, qos).await.unwrap();
    let mut client = world.client().await;
    let publish = json!({"op": "publish", "topic": "/map", "msg": {"data": 7}});
    client.send(json!({"op": "advertise", "id": "a", "topic": "/map", "type": "std_msgs/msg/Int32"})).await;
    for _ in 0..3 {
        client.send(publish.clone()).await;
    }
    assert_eq!(
        client.json().await,
        json!({"op": "status", "id": "a", "level": "error", "msg":
            "advertise: topic /map: no messages pass between /mapper and this client: durability: the publisher offers \
                volatile, the subscriber asks for transient_local (publisher: reliable, volatile; subscriber: \
                reliable, transient_local)"})
    );
    client.sync().await;
    // Nor is it waited for.
    client.send(publish.clone()).await;
    client.sync().await;
    assert!(heard.messages.is_empty());
    // It receives messages if offered what it requests.
    client
        .send(json!({"op": "advertise", "id": "a", "topic": "/map", "type": "std_msgs/msg/Int32",
            "qos": {"durability": "transient_local"}}))
        .await;
    client.send(publish).await;
    let message = with_timeout(heard.messages.recv()).await.unwrap();
    assert_eq!(message.bytes, world.serialize(&[7, 0, 0, 0]));
    client.sync().await;
}

#[tokio::test]
async fn who_wants_nothing_old_is_given_nothing_old() {
    let world = World::new().await;
    let publisher = world.node_publishes("/map", "std_msgs/Int32", true).await;
    let message = |data: i32| world.message("std_msgs/Int32", json!({"data": data}));
    publisher.publish(message(1));
    let (mut eager, mut late) = (world.client().await, world.client().await);
    let volatile = json!({"op": "subscribe", "id": "new", "topic": "/map", "qos": {"durability": "volatile"}});
    eager.send(volatile.clone()).await;
    eager.sync().await;
    // A client that requests nothing gets everything, whatever others request for the same topic.
    late.send(json!({"op": "subscribe", "topic": "/map"})).await;
    assert_eq!(late.json().await["msg"], json!({"data": 1}));
    wait_connected(publisher.as_ref(), 2).await;
    publisher.publish(message(2));
    for client in [&mut eager, &mut late] {
        assert_eq!(client.json().await["msg"], json!({"data": 2}));
    }
    // Nor does another client with that request get what was published meanwhile.
    let mut another = world.client().await;
    another.send(volatile).await;
    another.sync().await;
    // A client's subscriptions get what satisfies all of them.
    eager.send(json!({"op": "subscribe", "id": "old", "topic": "/map"})).await;
    assert_eq!(eager.json().await["msg"], json!({"data": 2}));
    publisher.publish(message(3));
    for client in [&mut eager, &mut another, &mut late] {
        assert_eq!(client.json().await["msg"], json!({"data": 3}));
        client.sync().await;
    }
    // And no more than that: a request ends with its subscription.
    eager.send(json!({"op": "unsubscribe", "id": "old", "topic": "/map"})).await;
    eager.sync().await;
    publisher.publish(message(4));
    assert_eq!(eager.json().await["msg"], json!({"data": 4}));
    eager.sync().await;
}

#[tokio::test]
async fn what_a_subscription_cannot_ask_for_is_told_as_a_warning() {
    let world = World::new().await;
    let mut client = world.client().await;
    client.send(json!({"op": "set_level", "level": "warning"})).await;
    let qos = json!({"deadline": 0.1, "liveliness": "manual_by_topic", "depth": 5});
    client.send(json!({"op": "subscribe", "id": "s", "topic": "/x", "type": "std_msgs/String", "qos": qos})).await;
    assert_eq!(
        client.json().await,
        json!({"op": "status", "id": "s", "level": "warning", "msg":
            "subscribe: \"qos.deadline\", \"qos.liveliness\" ignored: subscriptions here accept whatever publishers \
                offer there"})
    );
    client.send(json!({"op": "advertise", "topic": "/y", "type": "std_msgs/String", "qos": qos})).await;
    client.sync().await;
}

#[tokio::test]
async fn clients_that_expect_different_types_of_one_topic_each_hear_theirs() {
    let world = World::new().await;
    let (mut text, mut number) = (world.client().await, world.client().await);
    let subscribe = |type_name| json!({"op": "subscribe", "topic": "/late", "type": type_name});
    text.send(subscribe("std_msgs/String")).await;
    text.sync().await;
    // The publisher determines the type of the topic.
    let publisher = world.node_publishes("/late", "std_msgs/Int32", false).await;
    let told = text.refusal().await;
    assert!(told.contains("std_msgs/msg/Int32"), "{told}");
    number.send(subscribe("std_msgs/Int32")).await;
    number.sync().await;
    wait_connected(publisher.as_ref(), 1).await;
    publisher.publish(world.message("std_msgs/Int32", json!({"data": 7})));
    assert_eq!(number.json().await["msg"], json!({"data": 7}));
    text.sync().await;
}
