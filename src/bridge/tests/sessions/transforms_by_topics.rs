//! The action of tf2_web_republisher by its topics, as used by clients of roslibjs for ROS 1.

use serde_json::json;

use super::support::{World, wait_connected, with_timeout};
use super::transforms::{tf_publisher, transform_args, until_heard, x_of};

#[tokio::test]
async fn a_goal_by_topics_carries_transforms_until_it_is_cancelled() {
    let world = World::new().await;
    let publisher = tf_publisher(&world).await;
    let mut client = world.client().await;
    let name = "tf2_web_republisher/TFSubscriptionAction";
    for (part, end) in [("goal", "Goal"), ("cancel", "")] {
        let type_name = if part == "cancel" { "actionlib_msgs/GoalID".to_owned() } else { format!("{name}{end}") };
        client
            .send(json!({"op": "advertise", "topic": format!("/tf2_web_republisher/{part}"),
            "type": type_name}))
            .await;
    }
    for (part, end) in [("feedback", "Feedback"), ("result", "Result")] {
        let type_name = format!("{name}{end}");
        client
            .send(json!({"op": "subscribe", "topic": format!("/tf2_web_republisher/{part}"),
            "type": type_name}))
            .await;
    }
    let id = json!({"stamp": {"secs": 0, "nsecs": 0}, "id": "goal_1"});
    client
        .send(json!({"op": "publish", "topic": "/tf2_web_republisher/goal", "msg": {"goal_id": id,
        "goal": transform_args("turtle")}}))
        .await;
    let heard = until_heard(&world, publisher.as_ref(), &mut client).await;
    assert_eq!(heard["msg"]["status"]["goal_id"]["id"], "goal_1");
    assert_eq!(x_of(&world, &heard["msg"]["feedback"]["transforms"]), 1.0);
    client.send(json!({"op": "publish", "topic": "/tf2_web_republisher/cancel", "msg": {"id": "goal_1"}})).await;
    let result = client.json().await;
    assert_eq!(
        (&result["topic"], &result["msg"]["status"]["status"]),
        (&json!("/tf2_web_republisher/result"), &json!(2))
    );
    // Nobody needs /tf any more.
    with_timeout(publisher.matched_subscribers().wait_for(|now| now.connected_count() == 0)).await.unwrap();
}

#[tokio::test]
async fn goals_by_topics_of_a_client_that_is_gone_are_given_up() {
    let world = World::new().await;
    let publisher = tf_publisher(&world).await;
    let mut client = world.client().await;
    let name = "tf2_web_republisher/TFSubscriptionActionGoal";
    client.send(json!({"op": "advertise", "topic": "/tf2_web_republisher/goal", "type": name})).await;
    client
        .send(json!({"op": "publish", "topic": "/tf2_web_republisher/goal",
        "msg": {"goal": transform_args("turtle")}}))
        .await;
    client.sync().await;
    wait_connected(publisher.as_ref(), 1).await;
    client.abort().await;
    with_timeout(publisher.matched_subscribers().wait_for(|now| now.connected_count() == 0)).await.unwrap();
}
