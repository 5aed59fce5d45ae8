//! A client loses its connection and comes back.

use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use bridge::{BridgeOptions, SessionEnd, SessionOptions};
use bytes::Bytes;
use ros::bus::{FailureReason, ServiceHandler, ServiceType};
use ros::codec;
use serde_json::json;
use tokio::sync::Notify;

use super::support::{World, patient, wait_connected, with_timeout};

fn with_token(token: &str) -> SessionOptions {
    SessionOptions { resume: Some(token.to_owned()), ..SessionOptions::default() }
}

/// A service that answers when it is released.
struct Gated(Arc<Notify>, Bytes);

#[async_trait]
impl ServiceHandler for Gated {
    async fn call(&self, _request: Bytes, _caller: &str) -> Result<Bytes, FailureReason> {
        self.0.notified().await;
        Ok(self.1.clone())
    }
}

#[tokio::test]
async fn subscriptions_advertisements_and_calls_outlive_the_socket() {
    let world = World::new().await;
    let publisher = world.node_publishes("/text", "std_msgs/String", false).await;
    let mut heard = world.node_subscribes("/number", "std_msgs/Int32").await;
    let def = world.registry.service("x_msgs/Nothing").unwrap();
    let gate = Arc::new(Notify::new());
    let service_type = ServiceType::from_service(&def);
    let answer = codec::default_message(&def.response).into();
    let _served = world.node.serve("/gated", service_type, Arc::new(Gated(gate.clone(), answer))).await.unwrap();
    world.wait_for_graph(|graph| graph.services.contains_key("/gated")).await;

    let mut client = world.client_with(with_token("secret")).await;
    client.send(json!({"op": "subscribe", "topic": "/text"})).await;
    client.send(json!({"op": "advertise", "topic": "/number", "type": "std_msgs/Int32"})).await;
    client.send(json!({"op": "publish", "topic": "/number", "msg": {"data": 1}})).await;
    client.send(json!({"op": "call_service", "id": "c", "service": "/gated"})).await;
    client.sync().await;
    wait_connected(publisher.as_ref(), 1).await;
    assert!(with_timeout(heard.messages.recv()).await.is_some());
    assert!(matches!(client.abort().await, SessionEnd::Lost(_)));
    let mut sessions = world.bridge.sessions();
    with_timeout(sessions.wait_for(|count| count.away == 1 && count.connected == 0)).await.unwrap();

    publisher.publish(world.message("std_msgs/String", json!({"data": "meanwhile"})));
    gate.notify_one();

    // Another client does not find them.
    let mut stranger = world.client_with(with_token("guess")).await;
    stranger.sync().await;

    let mut client = world.client_with(with_token("secret")).await;
    let mut got = [client.json().await, client.json().await].map(|message| message["op"].to_string());
    got.sort();
    assert_eq!(got, ["\"publish\"", "\"service_response\""]);
    client.send(json!({"op": "publish", "topic": "/number", "msg": {"data": 2}})).await;
    assert_eq!(with_timeout(heard.messages.recv()).await.unwrap().bytes, world.serialize(&[2, 0, 0, 0]));
    client.sync().await;
    assert_eq!(publisher.matched_subscribers().borrow().connected_count(), 1);
    assert_eq!(world.bridge.metrics().resumed.get(), 1);
}

#[tokio::test]
async fn the_newer_connection_takes_over() {
    let world = World::new().await;
    let mut old = world.client_with(with_token("secret")).await;
    old.send(json!({"op": "subscribe", "topic": "/x", "type": "std_msgs/String"})).await;
    old.sync().await;
    let mut new = world.client_with(with_token("secret")).await;
    assert_eq!(old.expect_close().await, (4001, "a newer connection has taken this session over".into()));
    old.abort().await;
    new.send(json!({"op": "advertise", "topic": "/x", "type": "std_msgs/String"})).await;
    new.send(json!({"op": "publish", "topic": "/x", "msg": {"data": "mine"}})).await;
    assert_eq!(new.json().await["msg"]["data"], "mine");
    let mut sessions = world.bridge.sessions();
    with_timeout(sessions.wait_for(|count| count.away == 0 && count.connected == 1)).await.unwrap();
}

#[tokio::test]
async fn who_does_not_come_back_in_time_has_lost_everything() {
    let options = BridgeOptions { resume_grace: Duration::from_millis(50), ..patient() };
    let world = World::with_options(options).await;
    let publisher = world.node_publishes("/text", "std_msgs/String", false).await;
    let mut client = world.client_with(with_token("secret")).await;
    client.send(json!({"op": "subscribe", "topic": "/text"})).await;
    client.sync().await;
    wait_connected(publisher.as_ref(), 1).await;
    client.abort().await;
    with_timeout(publisher.matched_subscribers().wait_for(|now| now.connected_count() == 0)).await.unwrap();
    let mut client = world.client_with(with_token("secret")).await;
    client.sync().await;
    assert_eq!(world.bridge.metrics().resumed.get(), 0);
}

#[tokio::test]
async fn a_client_without_token_leaves_nothing_behind() {
    let world = World::new().await;
    let publisher = world.node_publishes("/text", "std_msgs/String", false).await;
    let mut client = world.client().await;
    client.send(json!({"op": "subscribe", "topic": "/text"})).await;
    client.sync().await;
    wait_connected(publisher.as_ref(), 1).await;
    client.abort().await;
    with_timeout(publisher.matched_subscribers().wait_for(|now| now.connected_count() == 0)).await.unwrap();
}
