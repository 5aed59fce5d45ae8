//! Actions both ways, over actionlib's topics.

use bridge::{BridgeOptions, SessionOptions};
use serde_json::{Value, json};

use crate::support::{Client, World};

const COUNT: &str = "x_msgs/Count";

async fn serve(client: &mut Client) {
    client
        .send(json!({"op": "set_level", "level": "info"}))
        .await;
    client
        .send(json!({"op": "advertise_action", "action": "/count", "type": COUNT}))
        .await;
    assert_eq!(
        client.json().await["msg"],
        "advertise_action: advertised /count"
    );
    client
        .send(json!({"op": "set_level", "level": "error"}))
        .await;
}

fn goal(id: &str, args: Value) -> Value {
    json!({"op": "send_action_goal", "id": id, "action": "/count", "action_type": COUNT, "args": args, "feedback": true})
}

/// A client that is an action server and one that uses it, each behind a bridge of its own or both behind one.
async fn pairs(world: &World) -> Vec<(Client, Client)> {
    let other = world.another_bridge().await;
    vec![
        (
            world.client().await,
            Client::connect(&other, SessionOptions::default()).await,
        ),
        (world.client().await, world.client().await),
    ]
}

#[tokio::test]
async fn a_goal_goes_with_feedback_to_its_result() {
    let world = World::new().await;
    for (mut server, mut user) in pairs(&world).await {
        serve(&mut server).await;
        user.send(goal("g", json!({"to": 3}))).await;
        let asked = server.json().await;
        assert_eq!(asked["op"], "send_action_goal");
        assert_eq!(
            (&asked["action"], &asked["args"], &asked["feedback"]),
            (&json!("/count"), &json!({"to": 3}), &json!(true))
        );
        let id = &asked["id"];
        server
            .send(
                json!({"op": "action_feedback", "id": id, "action": "/count", "values": {"at": 2}}),
            )
            .await;
        assert_eq!(
            user.json().await,
            json!({"op": "action_feedback", "id": "g", "action": "/count", "values": {"at": 2}})
        );
        let result = json!({"op": "action_result", "id": id, "action": "/count", "values": {"all": [1, 2, 3]}, "status": 4, "result": true});
        server.send(result.clone()).await;
        assert_eq!(
            user.json().await,
            json!({"op": "action_result", "id": "g", "action": "/count", "values": {"all": [1, 2, 3]}, "status": 4, "result": true})
        );
        server.send(result).await;
        assert!(server.refusal().await.contains("has no goal with id"));

        // By position, and it fails.
        user.send(goal("h", json!([5]))).await;
        let asked = server.json().await;
        assert_eq!(asked["args"], json!({"to": 5}));
        server.send(json!({"op": "action_result", "id": asked["id"], "action": "/count", "result": false})).await;
        let answer = user.json().await;
        assert_eq!(
            (&answer["id"], &answer["status"], &answer["result"]),
            (&json!("h"), &json!(6), &json!(true))
        );

        // It is cancelled.
        user.send(goal("i", json!({"to": 9}))).await;
        let asked = server.json().await;
        user.send(goal("i", json!({"to": 9}))).await;
        assert_eq!(
            user.refusal().await,
            "send_action_goal: a goal with id i is under way already"
        );
        user.send(json!({"op": "cancel_action_goal", "id": "i", "action": "/count"}))
            .await;
        let cancel = server.json().await;
        assert_eq!(
            cancel,
            json!({"op": "cancel_action_goal", "id": asked["id"], "action": "/count"})
        );
        server.send(json!({"op": "action_result", "id": asked["id"], "action": "/count", "values": {}, "status": 5, "result": true})).await;
        assert_eq!(user.json().await["status"], 5);

        // The server goes in the middle.
        user.send(goal("j", json!({"to": 9}))).await;
        server.json().await;
        server
            .send(json!({"op": "unadvertise_action", "action": "/count"}))
            .await;
        let answer = user.json().await;
        assert_eq!(
            (&answer["id"], &answer["status"]),
            (&json!("j"), &json!(6)),
            "{answer}"
        );
    }
}

#[tokio::test]
async fn goals_that_cannot_be_sent_are_answered_with_the_reason() {
    let options = BridgeOptions {
        action_timeout: std::time::Duration::from_millis(50),
        ..BridgeOptions::default()
    };
    let world = World::with(options).await;
    let mut user = world.client().await;
    user.send(goal("g", json!({"to": 3}))).await;
    let answer = user.json().await;
    assert_eq!(
        (&answer["id"], &answer["result"], &answer["status"]),
        (&json!("g"), &json!(false), &json!(0))
    );
    assert_eq!(
        answer["values"],
        "action server /count did not connect within 50ms"
    );
    user.send(goal("g", json!({"from": 3}))).await;
    let answer = user.json().await;
    assert_eq!(
        answer["values"],
        "field from of x_msgs/CountGoal: there is no such field"
    );
    user.send(json!({"op": "send_action_goal", "action": "/count", "action_type": "x_msgs/Lost"}))
        .await;
    assert!(
        user.json().await["values"]
            .as_str()
            .unwrap()
            .starts_with("action /count: no definition of x_msgs/Lost")
    );
    user.send(json!({"op": "cancel_action_goal", "id": "g", "action": "/count"}))
        .await;
    assert_eq!(
        user.refusal().await,
        "cancel_action_goal: no goal with id g is under way"
    );
    user.send(json!({"op": "action_feedback", "id": "g", "action": "/count", "values": {}}))
        .await;
    assert!(
        user.refusal()
            .await
            .contains("/count is not advertised by this client")
    );
}

#[tokio::test]
async fn the_topics_of_an_action_can_be_used_directly_too() {
    let world = World::new().await;
    let (mut server, mut user) = (world.client().await, world.client().await);
    serve(&mut server).await;
    user.send(
        json!({"op": "subscribe", "topic": "/count/result", "type": "x_msgs/CountActionResult"}),
    )
    .await;
    user.send(json!({"op": "advertise", "topic": "/count/goal", "type": "x_msgs/CountActionGoal"}))
        .await;
    let id = json!({"stamp": {"secs": 1, "nsecs": 0}, "id": "mine"});
    user.send(
        json!({"op": "publish", "topic": "/count/goal", "msg": {"goal_id": id, "goal": {"to": 1}}}),
    )
    .await;
    let asked = server.json().await;
    assert_eq!(asked["args"], json!({"to": 1}));
    server.send(json!({"op": "action_result", "id": asked["id"], "action": "/count", "values": {"all": [1]}, "result": true})).await;
    let result = user.json().await;
    assert_eq!(
        result["msg"]["status"],
        json!({"goal_id": id, "status": 3, "text": ""})
    );
    assert_eq!(result["msg"]["result"], json!({"all": [1]}));
    user.send(json!({"op": "call_service", "service": "/rosapi/action_servers"}))
        .await;
    assert_eq!(user.json().await["op"], "service_response");
}
