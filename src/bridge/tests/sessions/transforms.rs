//! The interface of tf2_web_republisher, as roslibjs's and roslibpy's TF clients use it.

use ros::bus::Publisher;
use serde_json::{Value, json};

use super::support::{Client, World, connected};

const TF: &str = "geometry_msgs/TransformStamped[] transforms\n";

async fn tf_publisher(world: &World) -> Box<dyn Publisher> {
    world.registry.insert("tf2_msgs/msg/TFMessage", TF).unwrap();
    world
        .node_publishes("/tf", "tf2_msgs/TFMessage", false)
        .await
}

fn moved(world: &World, publisher: &dyn Publisher, child: &str, x: f64) {
    let transform = json!({
        "header": {"frame_id": "world", "stamp": {"secs": 1_000_000, "nsecs": 5}},
        "child_frame_id": child,
        "transform": {"translation": {"x": x}, "rotation": {"w": 1.0}},
    });
    publisher.publish(world.message("tf2_msgs/TFMessage", json!({"transforms": [transform]})));
}

fn wanted(frame: &str) -> Value {
    json!({
        "source_frames": [frame], "target_frame": "/world",
        "angular_thres": 0.1, "trans_thres": 0.5, "rate": 100.0,
    })
}

fn x_of(transforms: &Value) -> f64 {
    assert_eq!(
        (
            &transforms[0]["header"]["frame_id"],
            &transforms[0]["child_frame_id"]
        ),
        (&json!("world"), &json!("turtle"))
    );
    // It was there then, whenever it is told.
    assert_eq!(
        transforms[0]["header"]["stamp"],
        json!({"secs": 1_000_000, "nsecs": 5})
    );
    transforms[0]["transform"]["translation"]["x"]
        .as_f64()
        .unwrap()
}

/// Repeats what has no other sign of having arrived than its effect.
async fn until_heard(world: &World, publisher: &dyn Publisher, client: &mut Client) -> Value {
    connected(publisher, 1).await;
    moved(world, publisher, "turtle", 1.0);
    client.json().await
}

#[tokio::test]
async fn a_topic_made_for_the_caller_says_what_has_moved() {
    let world = World::new().await;
    let publisher = tf_publisher(&world).await;
    let mut client = world.client().await;
    let mut args = wanted("turtle");
    args["timeout"] = json!({"secs": 2, "nsecs": 0});
    client.send(json!({"op": "call_service", "service": "/republish_tfs", "type": "tf2_web_republisher/RepublishTFs", "args": args})).await;
    let answer = client.json().await;
    assert_eq!(answer["result"], true, "{answer}");
    let topic = answer["values"]["topic_name"].clone();
    client
        .send(json!({"op": "subscribe", "topic": topic, "type": "tf2_web_republisher/TFArray"}))
        .await;
    let heard = until_heard(&world, publisher.as_ref(), &mut client).await;
    assert_eq!(
        (&heard["topic"], x_of(&heard["msg"]["transforms"])),
        (&topic, 1.0)
    );
    // Too little, then enough.
    moved(&world, publisher.as_ref(), "turtle", 1.2);
    moved(&world, publisher.as_ref(), "turtle", 3.0);
    assert_eq!(x_of(&client.json().await["msg"]["transforms"]), 3.0);
}

#[tokio::test]
async fn what_does_not_move_is_told_to_who_listens_late_and_to_who_listens_again() {
    let world = World::new().await;
    let publisher = tf_publisher(&world).await;
    let mut client = world.client().await;
    client.send(json!({"op": "call_service", "service": "/republish_tfs", "type": "tf2_web_republisher/RepublishTFs", "args": wanted("turtle")})).await;
    let topic = client.json().await["values"]["topic_name"].clone();
    connected(publisher.as_ref(), 1).await;
    moved(&world, publisher.as_ref(), "turtle", 1.0);
    // It has been told when somebody else has heard it.
    let mut other = world.client().await;
    other
        .send(json!({"op": "subscribe", "topic": topic, "type": "tf2_web_republisher/TFArray"}))
        .await;
    assert_eq!(x_of(&other.json().await["msg"]["transforms"]), 1.0);
    for _ in 0..2 {
        client
            .send(json!({"op": "subscribe", "topic": topic, "type": "tf2_web_republisher/TFArray"}))
            .await;
        assert_eq!(x_of(&client.json().await["msg"]["transforms"]), 1.0);
        client
            .send(json!({"op": "unsubscribe", "topic": topic}))
            .await;
        client.settled().await;
    }
}

#[tokio::test]
async fn a_goal_carries_transforms_as_feedback_until_it_is_cancelled() {
    let world = World::new().await;
    let publisher = tf_publisher(&world).await;
    let mut client = world.client().await;
    let name = "tf2_web_republisher/TFSubscriptionAction";
    for (part, end) in [("goal", "Goal"), ("cancel", "")] {
        let type_name = if part == "cancel" {
            "actionlib_msgs/GoalID".to_owned()
        } else {
            format!("{name}{end}")
        };
        client.send(json!({"op": "advertise", "topic": format!("/tf2_web_republisher/{part}"), "type": type_name})).await;
    }
    for (part, end) in [("feedback", "Feedback"), ("result", "Result")] {
        let type_name = format!("{name}{end}");
        client.send(json!({"op": "subscribe", "topic": format!("/tf2_web_republisher/{part}"), "type": type_name})).await;
    }
    let id = json!({"stamp": {"secs": 0, "nsecs": 0}, "id": "goal_1"});
    client.send(json!({"op": "publish", "topic": "/tf2_web_republisher/goal", "msg": {"goal_id": id, "goal": wanted("turtle")}})).await;
    let heard = until_heard(&world, publisher.as_ref(), &mut client).await;
    assert_eq!(heard["msg"]["status"]["goal_id"]["id"], "goal_1");
    assert_eq!(x_of(&heard["msg"]["feedback"]["transforms"]), 1.0);
    client.send(json!({"op": "publish", "topic": "/tf2_web_republisher/cancel", "msg": {"id": "goal_1"}})).await;
    let result = client.json().await;
    assert_eq!(
        (&result["topic"], &result["msg"]["status"]["status"]),
        (&json!("/tf2_web_republisher/result"), &json!(2))
    );
    // Nobody needs /tf any more.
    super::support::patiently(publisher.matched().wait_for(|now| now.connected() == 0))
        .await
        .unwrap();
}

#[tokio::test]
async fn the_goals_of_a_client_that_is_gone_are_given_up() {
    let world = World::new().await;
    let publisher = tf_publisher(&world).await;
    let mut client = world.client().await;
    let name = "tf2_web_republisher/TFSubscriptionActionGoal";
    client
        .send(json!({"op": "advertise", "topic": "/tf2_web_republisher/goal", "type": name}))
        .await;
    client.send(json!({"op": "publish", "topic": "/tf2_web_republisher/goal", "msg": {"goal": wanted("turtle")}})).await;
    client.settled().await;
    connected(publisher.as_ref(), 1).await;
    client.lose().await;
    super::support::patiently(publisher.matched().wait_for(|now| now.connected() == 0))
        .await
        .unwrap();
}
