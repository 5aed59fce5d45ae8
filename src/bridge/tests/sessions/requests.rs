//! Durations of requests, as reported to the daemon.

use std::sync::Arc;
use std::time::Duration;

use bridge::{BridgeOptions, RequestObserver};
use bytes::Bytes;
use ros::bus::{FailureReason, ServiceHandler, ServiceType};
use serde_json::json;
use tokio::sync::mpsc;

use super::actions::serve;
use super::support::{Client, World, patient, wait_connected, with_timeout};

type Told = mpsc::UnboundedReceiver<Option<Duration>>;

/// Returns options of a bridge that reports requests, and the receiver. `pair`: the topics of requests.
fn observed_options(pair: Option<&str>) -> (BridgeOptions, Told) {
    let (sender, told) = mpsc::unbounded_channel();
    let options = BridgeOptions {
        called: RequestObserver::new(move |took| {
            let _ = sender.send(took);
        }),
        pair: pair.map(|pair| pair.parse().unwrap()),
        ..patient()
    };
    (options, told)
}

async fn next(told: &mut Told) -> Option<Duration> {
    with_timeout(told.recv()).await.unwrap()
}

/// Returns the second number, and refuses calls whose first is not 0; `self.0` is the number of bytes before both.
struct Refuses(usize);

#[async_trait::async_trait]
impl ServiceHandler for Refuses {
    async fn call(&self, request: Bytes, _caller: &str) -> Result<Bytes, FailureReason> {
        let (header, numbers) = request.split_at(self.0);
        match numbers[0] {
            0 => Ok([header, &numbers[8..]].concat().into()),
            _ => Err(FailureReason::new("not today")),
        }
    }
}

#[tokio::test]
async fn calls_of_the_servants_services_are_told_and_those_of_clients_are_not() {
    let (options, mut told) = observed_options(None);
    let world = World::with_options(options).await;
    let def = world.registry.service("x_msgs/Add").unwrap();
    let _served = world
        .node
        .serve("/add", ServiceType::from_service(&def), Arc::new(Refuses(world.by_version(0, 4))))
        .await
        .unwrap();
    let there = |graph: &ros::bus::Graph| graph.services.contains_key("/add");
    world.wait_for_graph(there).await;
    let (mut client, mut own) = (world.client().await, world.client().await);
    let call = |service: &str, a: u8| json!({"op": "call_service", "service": service, "args": {"a": a, "b": 2}});
    // Answered by another client of the same robot.
    own.send(json!({"op": "advertise_service", "service": "/own", "type": "x_msgs/Add"})).await;
    let there = |graph: &ros::bus::Graph| graph.services.contains_key("/own");
    world.wait_for_graph(there).await;
    client.sync().await;
    client.send(call("/own", 0)).await;
    let asked = own.json().await;
    own.send(json!({"op": "service_response", "id": asked["id"], "service": "/own", "values": {"sum": 1},
        "result": true}))
        .await;
    assert_eq!(client.json().await["result"], true);
    for (a, answered) in [(0, true), (1, false)] {
        client.send(call("/add", a)).await;
        assert_eq!(client.json().await["result"], answered);
        assert_eq!(next(&mut told).await.is_some(), answered);
    }
    assert!(told.try_recv().is_err(), "no more than those");
}

#[tokio::test]
async fn goals_are_told_but_for_those_that_their_client_cancels() {
    let (options, mut told) = observed_options(None);
    let world = World::with_options(options).await;
    let other = world.another_bridge().await;
    let mut server = Client::connect(&other, Default::default()).await;
    serve(&mut server).await;
    let mut user = world.client().await;
    for (id, result, succeeds) in [("g", true, true), ("h", false, false)] {
        user.send(json!({"op": "send_action_goal", "id": id, "action": "/count", "action_type": "x_msgs/Count",
            "args": {"to": 3}}))
            .await;
        let asked = server.json().await;
        server
            .send(json!({"op": "action_result", "id": asked["id"], "action": "/count", "values": {"all": []},
                "status": 4, "result": result}))
            .await;
        assert_eq!(user.json().await["id"], id);
        assert_eq!(next(&mut told).await.is_some(), succeeds, "{id}");
    }
    user.send(json!({"op": "send_action_goal", "id": "c", "action": "/count", "action_type": "x_msgs/Count",
        "args": {"to": 3}}))
        .await;
    let asked = server.json().await;
    user.send(json!({"op": "cancel_action_goal", "id": "c", "action": "/count"})).await;
    assert_eq!(server.json().await["op"], "cancel_action_goal");
    server
        .send(json!({"op": "action_result", "id": asked["id"], "action": "/count", "values": {"all": []}, "status": 5,
            "result": true}))
        .await;
    assert_eq!(user.json().await["id"], "c");
    assert!(told.try_recv().is_err(), "its end was its client's choice");
}

#[tokio::test]
async fn messages_that_the_servant_answers_are_told_once_they_reach_it() {
    let (options, mut told) = observed_options(Some("/place -> /found by stamp"));
    let world = World::with_options(options).await;
    let mut asked = world.node_subscribes("/place", "x_msgs/Place").await;
    let found = world.node_publishes("/found", "x_msgs/Place", false).await;
    let mut client = world.client().await;
    let metrics = world.bridge.metrics();
    client.send(json!({"op": "advertise", "topic": "/place", "type": "x_msgs/Place"})).await;
    let place = |secs: u32| json!({"header": {"stamp": {"secs": secs, "nsecs": 5}}});
    let publish = |secs| json!({"op": "publish", "topic": "/place", "msg": place(secs)});
    // Time that a message waits for the node to connect is not the node's.
    client.send(publish(1)).await;
    with_timeout(asked.messages.recv()).await.unwrap();
    client.sync().await;
    assert_eq!(metrics.asked.get(), 0, "nobody hears an answer");
    client.send(json!({"op": "subscribe", "topic": "/found"})).await;
    client.sync().await;
    wait_connected(&*found, 1).await;
    for secs in [2, 3] {
        client.send(publish(secs)).await;
        with_timeout(asked.messages.recv()).await.unwrap();
    }
    assert_eq!(metrics.asked.get(), 2);
    // The first was not recorded, each of the next ones is answered once; the fourth was never requested.
    for secs in [1, 3, 2, 2, 4] {
        found.publish(world.message("x_msgs/Place", place(secs)));
        assert_eq!(client.json().await["op"], "publish");
    }
    assert!(next(&mut told).await.is_some());
    assert!(next(&mut told).await.is_some());
    assert!(told.try_recv().is_err(), "no more than those");
    client.send(json!({"op": "unsubscribe", "topic": "/found"})).await;
    client.send(publish(5)).await;
    client.sync().await;
    assert_eq!(metrics.asked.get(), 2, "nobody hears an answer any more");
}
