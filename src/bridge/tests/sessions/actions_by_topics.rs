//! Actions of ROS 1 by their topics, as used by clients of roslibjs.

use serde_json::{Value, json};

use super::actions::serve;
use super::support::World;

#[tokio::test]
async fn the_topics_of_an_action_can_be_used_directly_too() {
    let world = World::new().await;
    let (mut server, mut user) = (world.client().await, world.client().await);
    serve(&mut server).await;
    user.send(json!({"op": "subscribe", "topic": "/count/result", "type": "x_msgs/CountActionResult"})).await;
    user.send(json!({"op": "advertise", "topic": "/count/goal", "type": "x_msgs/CountActionGoal"})).await;
    let id = json!({"stamp": {"secs": 1, "nsecs": 0}, "id": "mine"});
    user.send(json!({"op": "publish", "topic": "/count/goal", "msg": {"goal_id": id, "goal": {"to": 1}}})).await;
    let asked = server.json().await;
    assert_eq!(asked["args"], json!({"to": 1}));
    server
        .send(json!({"op": "action_result", "id": asked["id"], "action": "/count", "values": {"all": [1]},
        "result": true}))
        .await;
    let result = user.json().await;
    assert_eq!(result["msg"]["status"], json!({"goal_id": id, "status": 3, "text": ""}));
    assert_eq!(result["msg"]["result"], json!({"all": [1]}));
    user.send(json!({"op": "call_service", "service": "/rosapi/action_servers"})).await;
    assert_eq!(user.json().await["op"], "service_response");
}

#[tokio::test]
async fn a_cancel_that_is_faster_than_its_goal_is_kept() {
    let world = World::new().await;
    let (mut server, mut user) = (world.client().await, world.client().await);
    serve(&mut server).await;
    user.send(json!({"op": "subscribe", "topic": "/count/result", "type": "x_msgs/CountActionResult"})).await;
    for (topic, type_name) in [("/count/cancel", "actionlib_msgs/GoalID"), ("/count/goal", "x_msgs/CountActionGoal")] {
        user.send(json!({"op": "advertise", "topic": topic, "type": type_name})).await;
    }
    let id = |id: &str, secs: u32| json!({"stamp": {"secs": secs, "nsecs": 0}, "id": id});
    let publish = |topic: &str, msg: Value| json!({"op": "publish", "topic": topic, "msg": msg});
    let sent = |id: Value| publish("/count/goal", json!({"goal_id": id, "goal": {"to": 1}}));
    // By the time up to which all are cancelled, and by id.
    user.send(publish("/count/cancel", id("", 5))).await;
    user.send(publish("/count/cancel", id("early", 0))).await;
    // The server has received both once it lists the second.
    user.send(json!({
        "op": "subscribe", "topic": "/count/status", "type": "actionlib_msgs/GoalStatusArray",
    }))
    .await;
    while !user.json().await["msg"]["status_list"]
        .as_array()
        .unwrap()
        .iter()
        .any(|state| state["goal_id"]["id"] == "early")
    {}
    user.send(json!({"op": "unsubscribe", "topic": "/count/status"})).await;
    for (name, secs) in [("early", 7), ("old", 5)] {
        user.send(sent(id(name, secs))).await;
        let mut result = user.json().await;
        while result["topic"] != "/count/result" {
            result = user.json().await;
        }
        assert_eq!(result["msg"]["status"]["goal_id"]["id"], name);
        // Recalled: it was never started.
        assert_eq!(result["msg"]["status"]["status"], 8, "{result}");
    }
    user.send(sent(id("new", 6))).await;
    assert_eq!(server.json().await["op"], "send_action_goal");
}
