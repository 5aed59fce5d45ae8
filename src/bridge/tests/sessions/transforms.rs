//! The interface of tf2_web_republisher, as used by the TF clients of roslibjs and roslibpy.

use ros::bus::Publisher;
use serde_json::{Value, json};

use super::support::{Client, World, wait_connected, with_timeout};

const TF: &str = "geometry_msgs/TransformStamped[] transforms\n";

pub(super) async fn tf_publisher(world: &World) -> Box<dyn Publisher> {
    world.registry.insert("tf2_msgs/msg/TFMessage", TF).unwrap();
    world.node_publishes("/tf", "tf2_msgs/TFMessage", false).await
}

fn publish_transform(world: &World, publisher: &dyn Publisher, child: &str, x: f64) {
    let transform = json!({
        "header": {"frame_id": "world", "stamp": world.time(1_000_000, 5)},
        "child_frame_id": child,
        "transform": {"translation": {"x": x}, "rotation": {"w": 1.0}},
    });
    publisher.publish(world.message("tf2_msgs/TFMessage", json!({"transforms": [transform]})));
}

pub(super) fn transform_args(frame: &str) -> Value {
    json!({
        "source_frames": [frame], "target_frame": "/world",
        "angular_thres": 0.1, "trans_thres": 0.5, "rate": 100.0,
    })
}

/// Returns the package of the republisher's types.
fn package(world: &World) -> &'static str {
    world.by_version("tf2_web_republisher", "tf2_web_republisher_interfaces")
}

/// Returns a call of the service.
fn republish(world: &World, args: &Value) -> Value {
    let type_name = format!("{}/RepublishTFs", package(world));
    json!({"op": "call_service", "service": "/republish_tfs", "type": type_name, "args": args})
}

fn subscribe(world: &World, topic: &Value) -> Value {
    let type_name = format!("{}/TFArray", package(world));
    json!({"op": "subscribe", "topic": topic, "type": type_name})
}

pub(super) fn x_of(world: &World, transforms: &Value) -> f64 {
    assert_eq!(
        (&transforms[0]["header"]["frame_id"], &transforms[0]["child_frame_id"]),
        (&json!("world"), &json!("turtle"))
    );
    // The time of the transform, whenever it is sent.
    assert_eq!(transforms[0]["header"]["stamp"], world.time(1_000_000, 5));
    transforms[0]["transform"]["translation"]["x"].as_f64().unwrap()
}

/// Repeats a message whose arrival only shows by its effect.
pub(super) async fn until_heard(world: &World, publisher: &dyn Publisher, client: &mut Client) -> Value {
    wait_connected(publisher, 1).await;
    publish_transform(world, publisher, "turtle", 1.0);
    client.json().await
}

#[tokio::test]
async fn a_topic_made_for_the_caller_says_what_has_moved() {
    let world = World::new().await;
    let publisher = tf_publisher(&world).await;
    let mut client = world.client().await;
    let mut args = transform_args("turtle");
    args["timeout"] = world.time(2, 0);
    client.send(republish(&world, &args)).await;
    let answer = client.json().await;
    assert_eq!(answer["result"], true, "{answer}");
    let topic = answer["values"]["topic_name"].clone();
    client.send(subscribe(&world, &topic)).await;
    let heard = until_heard(&world, publisher.as_ref(), &mut client).await;
    assert_eq!((&heard["topic"], x_of(&world, &heard["msg"]["transforms"])), (&topic, 1.0));
    // Too little, then enough.
    publish_transform(&world, publisher.as_ref(), "turtle", 1.2);
    publish_transform(&world, publisher.as_ref(), "turtle", 3.0);
    let moved = client.json().await;
    assert_eq!(x_of(&world, &moved["msg"]["transforms"]), 3.0);
}

#[tokio::test]
async fn what_does_not_move_is_told_to_who_listens_late_and_to_who_listens_again() {
    let world = World::new().await;
    let publisher = tf_publisher(&world).await;
    let mut client = world.client().await;
    client.send(republish(&world, &transform_args("turtle"))).await;
    let topic = client.json().await["values"]["topic_name"].clone();
    wait_connected(publisher.as_ref(), 1).await;
    publish_transform(&world, publisher.as_ref(), "turtle", 1.0);
    // It has been sent when another client has received it.
    let mut other = world.client().await;
    other.send(subscribe(&world, &topic)).await;
    let told = other.json().await;
    assert_eq!(x_of(&world, &told["msg"]["transforms"]), 1.0);
    for _ in 0..2 {
        client.send(subscribe(&world, &topic)).await;
        let told = client.json().await;
        assert_eq!(x_of(&world, &told["msg"]["transforms"]), 1.0);
        client.send(json!({"op": "unsubscribe", "topic": topic})).await;
        client.sync().await;
    }
}

fn goal(world: &World) -> Value {
    let type_name = format!("{}/TFSubscription", package(world));
    json!({"op": "send_action_goal", "id": "g", "action": "/tf2_web_republisher", "action_type": type_name,
        "args": transform_args("turtle"), "feedback": true})
}

#[tokio::test]
async fn a_goal_carries_transforms_as_feedback_until_it_is_cancelled() {
    let world = World::new().await;
    let publisher = tf_publisher(&world).await;
    let mut client = world.client().await;
    client.send(goal(&world)).await;
    let heard = until_heard(&world, publisher.as_ref(), &mut client).await;
    assert_eq!((&heard["op"], &heard["id"]), (&json!("action_feedback"), &json!("g")));
    assert_eq!(x_of(&world, &heard["values"]["transforms"]), 1.0);
    publish_transform(&world, publisher.as_ref(), "turtle", 3.0);
    let heard = client.json().await;
    assert_eq!(x_of(&world, &heard["values"]["transforms"]), 3.0);
    client.send(json!({"op": "cancel_action_goal", "id": "g", "action": "/tf2_web_republisher"})).await;
    assert_eq!(
        client.json().await,
        json!({"op": "action_result", "id": "g", "action": "/tf2_web_republisher", "values": {}, "status": 5,
            "result": true})
    );
    // Nobody needs /tf any more.
    with_timeout(publisher.matched_subscribers().wait_for(|now| now.connected_count() == 0)).await.unwrap();
}

#[tokio::test]
async fn the_goals_of_a_client_that_is_gone_are_given_up() {
    let world = World::new().await;
    let publisher = tf_publisher(&world).await;
    let mut client = world.client().await;
    client.send(goal(&world)).await;
    wait_connected(publisher.as_ref(), 1).await;
    client.abort().await;
    with_timeout(publisher.matched_subscribers().wait_for(|now| now.connected_count() == 0)).await.unwrap();
}
