//! Headers as clients made for ROS 1 write them, sent to ROS 2.

use ros::bus::Subscription;
use serde_json::{Value, json};

use super::support::{Client, World, with_timeout};

/// Returns a header of ROS 1.
fn header() -> Value {
    json!({"seq": 7, "stamp": {"secs": 5, "nsecs": 6}, "frame_id": "map"})
}

/// Returns the notice about what an operation carries.
fn notice(op: &str, about: &str) -> String {
    format!("{op}: {about}: \"seq\" of a std_msgs/msg/Header was dropped, ROS 2 has no such field; this is said once")
}

/// Asserts that the next message is this warning.
async fn assert_warned(client: &mut Client, text: &str) {
    let status = client.json().await;
    assert_eq!((&status["op"], &status["level"], &status["msg"]), (&"status".into(), &"warning".into(), &text.into()));
}

/// Asserts that the next message on `/place` has the header.
async fn assert_arrived(world: &World, heard: &mut Subscription) {
    let message = with_timeout(heard.messages.recv()).await.unwrap();
    let header = &world.json("x_msgs/Place", &message.bytes)["header"];
    assert_eq!(header, &json!({"stamp": {"sec": 5, "nanosec": 6}, "frame_id": "map"}));
}

#[tokio::test]
async fn a_published_seq_is_dropped_with_one_notice_per_topic_and_connection() {
    let world = World::new().await;
    let mut heard = world.node_subscribes("/place", "x_msgs/Place").await;
    let publish = json!({"op": "publish", "id": "p", "topic": "/place", "type": "x_msgs/Place",
        "msg": {"header": header(), "x": 1, "near": [], "tags": []}});
    let mut client = world.client().await;
    // Nothing is said to a client that wants errors alone.
    client.send(publish.clone()).await;
    assert_arrived(&world, &mut heard).await;
    client.sync().await;
    client.send(json!({"op": "set_level", "level": "warning"})).await;
    client.send(publish.clone()).await;
    assert_warned(&mut client, &notice("publish", "topic /place")).await;
    let mut bytes = Vec::new();
    ciborium::into_writer(&publish, &mut bytes).unwrap();
    client.send_binary(bytes).await;
    client.send(publish.clone()).await;
    for _ in 0..3 {
        assert_arrived(&world, &mut heard).await;
    }
    client.sync().await;
    // Of another topic it is said as well, and to another client.
    let mut elsewhere = publish.clone();
    elsewhere["topic"] = "/elsewhere".into();
    client.send(elsewhere).await;
    assert_warned(&mut client, &notice("publish", "topic /elsewhere")).await;
    let mut other = world.client().await;
    other.send(json!({"op": "set_level", "level": "warning"})).await;
    other.send(publish.clone()).await;
    assert_warned(&mut other, &notice("publish", "topic /place")).await;
    // A seq that is none is refused, as in ROS 1.
    let mut wrong = publish;
    wrong["msg"]["header"]["seq"] = "7".into();
    client.send(wrong).await;
    assert_eq!(
        client.refusal().await,
        "publish: topic /place: field header.seq of x_msgs/msg/Place: takes uint32, got a string"
    );
}

#[tokio::test]
async fn a_seq_in_a_call_a_goal_and_their_answers_is_dropped() {
    let world = World::new().await;
    for (key, text) in [
        ("x_msgs/srv/Find", "Place[] from\n---\nPlace at\n"),
        ("x_msgs/action/Go", "std_msgs/Header to\n---\nstd_msgs/Header at\n---\nstd_msgs/Header near\n"),
    ] {
        world.registry.insert(key, text).unwrap();
    }
    let (mut server, mut user) = (world.client().await, world.client().await);
    server.send(json!({"op": "advertise_service", "service": "/find", "type": "x_msgs/Find"})).await;
    server.send(json!({"op": "advertise_action", "action": "/go", "type": "x_msgs/Go"})).await;
    world.wait_for_graph(|graph| graph.services.contains_key("/find") && graph.actions.contains_key("/go")).await;
    let plain = json!({"stamp": {"sec": 5, "nanosec": 6}, "frame_id": "map"});
    for client in [&mut server, &mut user] {
        client.send(json!({"op": "set_level", "level": "warning"})).await;
    }
    for round in 0..2 {
        let first = round == 0;
        let args = json!({"from": [{"header": header()}, {"header": header()}]});
        user.send(json!({"op": "call_service", "id": "c", "service": "/find", "args": args})).await;
        if first {
            assert_warned(&mut user, &notice("call_service", "service /find")).await;
        }
        let asked = server.json().await;
        assert_eq!(asked["args"]["from"][1]["header"], plain, "{asked}");
        let values = json!({"at": {"header": header()}});
        server
            .send(json!({"op": "service_response", "id": asked["id"], "service": "/find", "values": values,
                "result": true}))
            .await;
        if first {
            assert_warned(&mut server, &notice("service_response", "service /find")).await;
        }
        assert_eq!(user.json().await["values"]["at"]["header"], plain);

        user.send(json!({"op": "send_action_goal", "id": "g", "action": "/go", "action_type": "x_msgs/Go",
            "args": {"to": header()}, "feedback": true}))
            .await;
        if first {
            assert_warned(&mut user, &notice("send_action_goal", "action /go")).await;
        }
        let asked = server.json().await;
        assert_eq!(asked["args"]["to"], plain, "{asked}");
        let id = &asked["id"];
        server.send(json!({"op": "action_feedback", "id": id, "action": "/go", "values": {"near": header()}})).await;
        if first {
            assert_warned(&mut server, &notice("action_feedback", "action /go")).await;
        }
        assert_eq!(user.json().await["values"]["near"], plain);
        server
            .send(json!({"op": "action_result", "id": id, "action": "/go", "values": {"at": header()}, "status": 4,
                "result": true}))
            .await;
        assert_eq!(user.json().await["values"]["at"], plain);
    }
    server.sync().await;
    user.sync().await;
}

#[tokio::test]
async fn the_names_about_which_a_client_was_told_are_limited() {
    let options = bridge::BridgeOptions { max_advertisements: 2, ..super::support::patient() };
    let world = World::with_options(options).await;
    let mut client = world.client().await;
    client.send(json!({"op": "set_level", "level": "warning"})).await;
    let msg = json!({"header": header(), "x": 1, "near": [], "tags": []});
    for topic in ["/a", "/b", "/c", "/a"] {
        client.send(json!({"op": "advertise", "topic": topic, "type": "x_msgs/Place"})).await;
        client.send(json!({"op": "publish", "topic": topic, "msg": msg})).await;
        assert_warned(&mut client, &notice("publish", &format!("topic {topic}"))).await;
        client.send(json!({"op": "unadvertise", "topic": topic})).await;
    }
    client.sync().await;
}
