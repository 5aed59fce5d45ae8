//! Actions in both directions.

use bridge::{BridgeOptions, SessionOptions};
use serde_json::{Value, json};

use super::support::{Client, World, patient};

const COUNT: &str = "x_msgs/Count";

pub(super) async fn serve(client: &mut Client) {
    client.send(json!({"op": "set_level", "level": "info"})).await;
    client.send(json!({"op": "advertise_action", "action": "/count", "type": COUNT})).await;
    assert_eq!(client.json().await["msg"], "advertise_action: advertised /count");
    client.send(json!({"op": "set_level", "level": "error"})).await;
}

fn goal(id: &str, args: Value) -> Value {
    json!({"op": "send_action_goal", "id": id, "action": "/count", "action_type": COUNT, "args": args,
        "feedback": true})
}

/// Pairs of a client that serves an action and one that uses it, behind one bridge or two.
async fn pairs(world: &World) -> Vec<(Client, Client)> {
    let other = world.another_bridge().await;
    vec![
        (world.client().await, Client::connect(&other, SessionOptions::default()).await),
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
            (&asked["action"], &asked["action_type"], &asked["args"], &asked["feedback"]),
            (&json!("/count"), &json!(COUNT), &json!({"to": 3}), &json!(true))
        );
        let id = &asked["id"];
        server.send(json!({"op": "action_feedback", "id": id, "action": "/count", "values": {"at": 2}})).await;
        assert_eq!(
            user.json().await,
            json!({"op": "action_feedback", "id": "g", "action": "/count", "values": {"at": 2}})
        );
        let result = json!({"op": "action_result", "id": id, "action": "/count", "values": {"all": [1, 2, 3]},
            "status": 4, "result": true});
        server.send(result.clone()).await;
        assert_eq!(
            user.json().await,
            json!({"op": "action_result", "id": "g", "action": "/count", "values": {"all": [1, 2, 3]}, "status": 4,
                "result": true})
        );
        server.send(result).await;
        assert!(server.refusal().await.contains("has no goal with id"));

        // By position, and it fails.
        user.send(goal("h", json!([5]))).await;
        let asked = server.json().await;
        assert_eq!(asked["args"], json!({"to": 5}));
        server.send(json!({"op": "action_result", "id": asked["id"], "action": "/count", "result": false})).await;
        let answer = user.json().await;
        assert_eq!((&answer["id"], &answer["status"], &answer["result"]), (&json!("h"), &json!(6), &json!(true)));
        assert_eq!(answer.get("text"), None, "{answer}");

        // A failure with its reason, or with a partial result.
        for (values, text, all) in [
            (json!("no more fingers"), json!("no more fingers"), json!([])),
            (json!({"all": [1]}), Value::Null, json!([1])),
        ] {
            user.send(goal("why", json!([5]))).await;
            let asked = server.json().await;
            server
                .send(json!({"op": "action_result", "id": asked["id"], "action": "/count", "values": values,
                "result": false}))
                .await;
            let answer = user.json().await;
            assert_eq!((&answer["id"], &answer["status"]), (&json!("why"), &json!(6)));
            assert_eq!((&answer["text"], &answer["values"]["all"]), (&text, &all));
        }

        // An answer that cannot be parsed.
        user.send(goal("lost", json!([5]))).await;
        let asked = server.json().await;
        server.send(json!({"op": "action_result", "id": asked["id"], "action": "/count", "values": {}})).await;
        assert!(server.refusal().await.contains("\"result\" is missing"));
        let answer = user.json().await;
        assert_eq!((&answer["id"], &answer["status"]), (&json!("lost"), &json!(6)));
        let text = answer["text"].as_str().unwrap();
        assert!(text.contains("\"result\" is missing"), "{text}");

        // The goal is cancelled.
        user.send(goal("i", json!({"to": 9}))).await;
        let asked = server.json().await;
        user.send(goal("i", json!({"to": 9}))).await;
        assert_eq!(user.refusal().await, "send_action_goal: a goal with id i is under way already");
        user.send(json!({"op": "cancel_action_goal", "id": "i", "action": "/count"})).await;
        let cancel = server.json().await;
        assert_eq!(cancel, json!({"op": "cancel_action_goal", "id": asked["id"], "action": "/count"}));
        server
            .send(json!({"op": "action_result", "id": asked["id"], "action": "/count", "values": {}, "status": 5,
            "result": true}))
            .await;
        assert_eq!(user.json().await["status"], 5);

        // The server leaves in the middle.
        user.send(goal("j", json!({"to": 9}))).await;
        server.json().await;
        server.send(json!({"op": "unadvertise_action", "action": "/count"})).await;
        let answer = user.json().await;
        assert_eq!((&answer["id"], &answer["status"]), (&json!("j"), &json!(6)), "{answer}");
    }
}

#[tokio::test]
async fn goals_that_cannot_be_sent_are_answered_with_the_reason() {
    let options = BridgeOptions { action_timeout: std::time::Duration::from_millis(50), ..patient() };
    let world = World::with_options(options).await;
    let mut user = world.client().await;
    user.send(goal("g", json!({"to": 3}))).await;
    let answer = user.json().await;
    assert_eq!((&answer["id"], &answer["result"], &answer["status"]), (&json!("g"), &json!(false), &json!(0)));
    assert_eq!(answer["values"], "action server /count did not connect within 50ms");
    user.send(goal("g", json!({"from": 3}))).await;
    let answer = user.json().await;
    let goal_type = world.by_version("x_msgs/CountGoal", "x_msgs/action/Count_Goal");
    assert_eq!(answer["values"], format!("field from of {goal_type}: there is no such field"));
    user.send(json!({"op": "send_action_goal", "action": "/count", "action_type": "x_msgs/Lost"})).await;
    let lost = world.full_name("x_msgs/Lost", "action");
    let expected = format!("action /count: no definition of {lost} is known");
    assert!(user.json().await["values"].as_str().unwrap().starts_with(&expected));
    user.send(json!({"op": "cancel_action_goal", "id": "g", "action": "/count"})).await;
    assert_eq!(user.refusal().await, "cancel_action_goal: no goal with id g is under way");
    user.send(json!({"op": "action_feedback", "id": "g", "action": "/count", "values": {}})).await;
    assert!(user.refusal().await.contains("/count is not advertised by this client"));
}

#[tokio::test]
async fn a_goal_of_another_type_is_answered_at_once_with_both() {
    let world = World::new().await;
    let dig = |id: &str| {
        json!({"op": "send_action_goal", "id": id, "action": "/count", "action_type": "x_msgs/Dig",
        "args": {"to": 3}})
    };
    let expected = format!(
        "action /count has type {}, not {}; use the type that it has",
        world.full_name(COUNT, "action"),
        world.full_name("x_msgs/Dig", "action")
    );
    for (mut server, mut user) in pairs(&world).await {
        // One goal waits for a server, and one is sent when it is available.
        user.send(dig("early")).await;
        user.sync().await;
        serve(&mut server).await;
        for id in ["early", "late"] {
            if id == "late" {
                user.send(dig(id)).await;
            }
            let answer = user.json().await;
            assert_eq!(
                (&answer["id"], &answer["values"], &answer["result"]),
                (&json!(id), &json!(expected), &json!(false))
            );
        }
        // The right one still gets through.
        user.send(goal("right", json!({"to": 3}))).await;
        assert_eq!(server.json().await["args"], json!({"to": 3}));
        server.send(json!({"op": "unadvertise_action", "action": "/count"})).await;
        assert_eq!(user.json().await["id"], "right");
        world
            .wait_for_graph(|graph| {
                let action = graph.actions.get("/count");
                action.is_none_or(|action| action.servers.is_empty())
            })
            .await;
    }
}

#[tokio::test]
async fn a_goal_that_is_cancelled_before_its_server_is_there_is_never_sent() {
    let world = World::new().await;
    let other = world.another_bridge().await;
    let mut user = Client::connect(&other, SessionOptions::default()).await;
    user.send(goal("g", json!({"to": 3}))).await;
    user.send(json!({"op": "cancel_action_goal", "id": "g", "action": "/count"})).await;
    assert_eq!(
        user.json().await,
        json!({"op": "action_result", "id": "g", "action": "/count", "values": {"all": []}, "status": 5,
            "result": true})
    );
    // The server appears, and receives only the next goal.
    let mut server = world.client().await;
    serve(&mut server).await;
    user.send(goal("h", json!({"to": 4}))).await;
    let asked = server.json().await;
    assert_eq!((&asked["op"], &asked["args"]), (&json!("send_action_goal"), &json!({"to": 4})));
    user.send(json!({"op": "cancel_action_goal", "id": "h", "action": "/count"})).await;
    assert_eq!(server.json().await["op"], "cancel_action_goal");
}
