//! Grants of a client, and their changes.

use std::sync::Arc;

use access::{ConnectionAccess, Grants};
use async_trait::async_trait;
use bridge::{ClientGrants, SessionEnd, SessionOptions};
use bytes::Bytes;
use ros::bus::{FailureReason, ServiceHandler, ServiceType};
use serde_json::json;
use tokio::sync::watch;

use super::support::{World, wait_connected, with_timeout};

fn standing(allow: &[&str]) -> ConnectionAccess {
    let grants = allow.iter().map(|text| text.parse().expect("a grant"));
    ConnectionAccess::Granted(Arc::new(Grants::new(grants)))
}

fn options_with(granted: watch::Receiver<ConnectionAccess>) -> SessionOptions {
    SessionOptions { granted: ClientGrants::from_standing(granted), ..SessionOptions::default() }
}

struct Nothing;

#[async_trait]
impl ServiceHandler for Nothing {
    async fn call(&self, _request: Bytes, _caller: &str) -> Result<Bytes, FailureReason> {
        Ok(Bytes::new())
    }
}

#[tokio::test]
async fn each_operation_is_refused_that_is_not_granted() {
    let world = World::new().await;
    let _text = world.node_publishes("/text", "std_msgs/String", false).await;
    let (_sender, granted) = watch::channel(standing(&["subscribe:/other"]));
    let mut client = world.client_with(options_with(granted)).await;
    for (op, grant) in [
        (json!({"op": "subscribe", "topic": "/text"}), "subscribe:/text"),
        // By a relative name, too.
        (json!({"op": "subscribe", "topic": "text"}), "subscribe:/text"),
        (json!({"op": "advertise", "topic": "/number", "type": "std_msgs/Int32"}), "publish:/number"),
        (json!({"op": "publish", "topic": "/text", "msg": {"data": "x"}}), "publish:/text"),
        (json!({"op": "advertise_service", "service": "/mine", "type": "x_msgs/Nothing"}), "advertise:/mine"),
        (json!({"op": "advertise_action", "action": "/act", "type": "x_msgs/Count"}), "advertise:/act"),
    ] {
        client.send(op.clone()).await;
        let told = client.json().await;
        assert_eq!(told["op"], "status", "{op}: {told}");
        let msg = told["msg"].as_str().expect("a text");
        assert!(msg.contains(&format!("{grant} is not granted")), "{op}: {msg}");
        assert!(msg.contains("granted: subscribe:/other"), "{msg}");
    }
    for (op, answer, grant) in [
        (json!({"op": "call_service", "service": "/nothing", "id": "c"}), "service_response", "call:/nothing"),
        (
            json!({"op": "call_service", "service": "/rosapi/set_param", "id": "c",
                   "args": {"name": "/node:p", "value": "1"}}),
            "service_response",
            "call:/rosapi/set_param",
        ),
        (
            json!({"op": "send_action_goal", "action": "/act", "action_type": "x_msgs/Count", "id": "g",
                   "args": {"to": 1}}),
            "action_result",
            "call:/act",
        ),
    ] {
        client.send(op.clone()).await;
        let told = client.json().await;
        assert_eq!((&told["op"], &told["result"]), (&json!(answer), &json!(false)), "{op}: {told}");
        let reason = told["values"].as_str().expect("a reason");
        assert!(reason.contains(&format!("{grant} is not granted")), "{reason}");
    }
}

#[tokio::test]
async fn rosapi_tells_of_names_alone_that_its_caller_may_use() {
    let world = World::new().await;
    let _shown = world.node_publishes("/camera/image", "std_msgs/String", false).await;
    let _hidden = world.node_publishes("/secret", "std_msgs/String", false).await;
    let def = world.registry.service("x_msgs/Nothing").expect("defined");
    let served = |name: &'static str| world.node.serve(name, ServiceType::from_service(&def), Arc::new(Nothing));
    let _services = (served("/detect").await.expect("served"), served("/hidden").await.expect("served"));
    // The bridge knows them: a client with all grants sees them.
    let mut free = world.client().await;
    for (service, names) in [("topics", ["/camera/image", "/secret"]), ("services", ["/detect", "/hidden"])] {
        loop {
            let call = json!({"op": "call_service", "service": format!("/rosapi/{service}")});
            free.send(call).await;
            let told = free.json().await.to_string();
            if names.iter().all(|name| told.contains(name)) {
                break;
            }
        }
    }
    let (_sender, granted) = watch::channel(standing(&["subscribe:/camera/**", "call:/detect"]));
    let mut client = world.client_with(options_with(granted)).await;
    let mut ask = async |service: &str, args: serde_json::Value| {
        let call = json!({"op": "call_service", "service": format!("/rosapi/{service}"), "args": args});
        client.send(call).await;
        let answer = client.json().await;
        assert_eq!(answer["result"], true, "{answer}");
        answer["values"].clone()
    };
    let topics = ask("topics", json!({})).await;
    assert_eq!(topics["topics"], json!(["/camera/image"]));
    let services = ask("services", json!({})).await.to_string();
    assert!(services.contains("/detect") && !services.contains("/hidden"), "{services}");
    for (service, args, field) in [
        ("topic_type", json!({"topic": "/secret"}), "type"),
        ("service_type", json!({"service": "/hidden"}), "type"),
        ("service_node", json!({"service": "/hidden"}), "node"),
    ] {
        assert_eq!(ask(service, args).await[field], "", "{service}");
    }
    let known = ask("service_type", json!({"service": "/detect"})).await;
    assert_eq!(known["type"], world.full_name("x_msgs/Nothing", "srv"));
    let publishers = ask("publishers", json!({"topic": "/secret"})).await;
    assert_eq!(publishers["publishers"], json!([]));
}

#[tokio::test]
async fn what_is_not_granted_any_more_is_taken_back_at_once() {
    let world = World::new().await;
    let text = world.node_publishes("/text", "std_msgs/String", false).await;
    let kept = world.node_publishes("/kept", "std_msgs/String", false).await;
    let mut numbers = world.node_subscribes("/number", "std_msgs/Int32").await;
    let (sender, granted) = watch::channel(standing(&["*:**"]));
    let mut client = world.client_with(options_with(granted)).await;
    for topic in ["/text", "/kept"] {
        client.send(json!({"op": "subscribe", "topic": topic})).await;
    }
    client.send(json!({"op": "advertise", "topic": "/number", "type": "std_msgs/Int32"})).await;
    client.send(json!({"op": "publish", "topic": "/number", "msg": {"data": 1}})).await;
    assert!(with_timeout(numbers.messages.recv()).await.is_some());
    wait_connected(text.as_ref(), 1).await;
    wait_connected(kept.as_ref(), 1).await;
    client.send(json!({"op": "advertise_service", "service": "/mine", "type": "x_msgs/Nothing"})).await;
    world.wait_for_graph(|graph| graph.services.contains_key("/mine")).await;
    sender.send_replace(standing(&["subscribe:/kept"]));
    let mut told = Vec::new();
    for _ in 0..3 {
        let status = client.json().await;
        told.push(status["msg"].as_str().expect("a status").to_owned());
    }
    told.sort();
    for (told, grant) in told.iter().zip(["advertise:/mine", "publish:/number", "subscribe:/text"]) {
        assert!(told.starts_with(&format!("{grant} is no longer granted to this client")), "{told}");
    }
    world.wait_for_graph(|graph| !graph.services.contains_key("/mine")).await;
    text.publish(world.message("std_msgs/String", json!({"data": "lost"})));
    kept.publish(world.message("std_msgs/String", json!({"data": "heard"})));
    assert_eq!(client.json().await["msg"]["data"], "heard");
    client.send(json!({"op": "publish", "topic": "/number", "msg": {"data": 2}})).await;
    let refused = client.json().await;
    assert!(refused["msg"].as_str().expect("a status").contains("publish:/number is not granted"), "{refused}");
}

#[tokio::test]
async fn a_connection_whose_token_is_over_ends_with_the_reason() {
    let world = World::new().await;
    let (sender, granted) = watch::channel(standing(&["*:**"]));
    let mut client = world.client_with(options_with(granted)).await;
    client.send(json!({"op": "call_service", "service": "/rosapi/get_time"})).await;
    client.json().await;
    sender.send_replace(ConnectionAccess::Ended("this token was revoked".into()));
    let closed = client.expect_close().await;
    assert_eq!(closed, (1008, "this token was revoked".to_owned()));
}

#[tokio::test]
async fn who_comes_back_has_what_the_new_connection_is_granted() {
    let world = World::new().await;
    let resumable = |granted| SessionOptions { resume: Some("secret".to_owned()), ..options_with(granted) };
    let (first, granted) = watch::channel(standing(&["*:**"]));
    let client = world.client_with(resumable(granted)).await;
    assert!(matches!(client.abort().await, SessionEnd::Lost(_)));
    drop(first);

    let (sender, granted) = watch::channel(standing(&["call:/rosapi/get_time"]));
    let mut client = world.client_with(resumable(granted)).await;
    client.send(json!({"op": "subscribe", "topic": "/text", "type": "std_msgs/String"})).await;
    let refused = client.json().await;
    assert!(refused["msg"].as_str().is_some_and(|words| words.contains("not granted")), "{refused}");
    sender.send_replace(ConnectionAccess::Ended("this token was revoked".into()));
    let closed = client.expect_close().await;
    assert_eq!(closed, (1008, "this token was revoked".to_owned()));
}

#[tokio::test]
async fn a_goal_is_cancelled_with_its_grant_whether_it_has_an_id_or_not() {
    for id in [None, Some("g")] {
        let world = World::new().await;
        let mut server = world.client().await;
        super::actions::serve(&mut server).await;
        let (sender, granted) = watch::channel(standing(&["*:**"]));
        let mut client = world.client_with(options_with(granted)).await;
        let mut goal = json!({"op": "send_action_goal", "action": "/count", "action_type": "x_msgs/Count",
                              "args": {"to": 1}});
        if let Some(id) = id {
            goal["id"] = json!(id);
        }
        client.send(goal).await;
        let asked = server.json().await;
        assert_eq!(asked["op"], "send_action_goal");
        sender.send_replace(standing(&["subscribe:/kept"]));
        let told = server.json().await;
        assert_eq!((&told["op"], &told["id"]), (&json!("cancel_action_goal"), &asked["id"]), "{id:?}");
        let told = client.json().await;
        let words = "call:/count is no longer granted to this client";
        assert!(told["msg"].as_str().is_some_and(|told| told.contains(words)), "{told}");
    }
}

#[tokio::test]
async fn what_is_refused_is_told_to_whoever_records_it() {
    let world = World::new().await;
    let (_sender, granted) = watch::channel(standing(&["subscribe:/other"]));
    let (told, mut heard) = tokio::sync::mpsc::unbounded_channel();
    let options = SessionOptions {
        granted: ClientGrants::from_standing(granted).with_refusal_observer(move |operation| {
            let _ = told.send(operation.to_owned());
        }),
        ..SessionOptions::default()
    };
    let mut client = world.client_with(options).await;
    client.send(json!({"op": "subscribe", "topic": "/text"})).await;
    let call = json!({"op": "call_service", "service": "/nothing", "id": "c"});
    client.send(call).await;
    for operation in ["subscribe:/text", "call:/nothing"] {
        let refused = with_timeout(heard.recv()).await.expect("told");
        assert_eq!(refused, operation);
    }
}
