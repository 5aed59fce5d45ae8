use std::sync::Arc;
use std::time::{Duration, Instant};

use async_trait::async_trait;
use bytes::Bytes;
use ros::bus::{Bus, BusError, CallFate, FailureReason, ServiceHandler};
use serde_json::json;

use super::lab::{LONG, Lab, cdr, json, set_bool, set_bool_type, wait_graph};

const NODE: &str = "/cloudroid_bridge";

pub fn request(data: bool) -> Bytes {
    cdr(&set_bool().request, &format!(r#"{{"data":{data}}}"#))
}

/// Returns the request with the name of its caller.
pub struct CallerEchoService;

#[async_trait]
impl ServiceHandler for CallerEchoService {
    async fn call(&self, request: Bytes, caller: &str) -> Result<Bytes, FailureReason> {
        let asked = json(&set_bool().request, &request);
        let success = asked == r#"{"data":true}"#;
        let answer = format!(r#"{{"success":{success},"message":"{caller}"}}"#);
        Ok(cdr(&set_bool().response, &answer))
    }
}

#[tokio::test]
async fn a_node_answers_calls() {
    let lab = Lab::new();
    let _peer = lab.peer().await;
    let bus = lab.join(NODE).await;
    wait_graph(&bus, |graph| graph.services.contains_key("/set")).await;
    let told = bus.service_type("/set").await.unwrap();
    let ours = set_bool_type();
    assert_eq!((&told.name, &told.request, &told.response), (&ours.name, &ours.request, &ours.response));
    for number in 0..100 {
        let data = number % 2 == 0;
        let answer = bus.call("/set", request(data), LONG).await.unwrap();
        let expected = format!(r#"{{"success":{data},"message":"set"}}"#);
        assert_eq!(json(&set_bool().response, &answer), expected);
    }
}

/// Tests a call that is the first operation of a bus.
#[tokio::test]
async fn a_call_waits_until_both_ends_know_each_other() {
    let lab = Lab::new();
    let _peer = lab.peer().await;
    for _ in 0..5 {
        let bus = lab.join(NODE).await;
        wait_graph(&bus, |graph| graph.services.contains_key("/set")).await;
        let answer = bus.call("/set", request(true), LONG).await.unwrap();
        assert_eq!(json(&set_bool().response, &answer), r#"{"success":true,"message":"set"}"#);
        bus.close().await;
    }
}

#[tokio::test]
async fn a_node_is_answered() {
    let lab = Lab::new();
    let mut peer = lab.peer().await;
    let bus = lab.join(NODE).await;
    let _served = bus.serve("/ask", set_bool_type(), Arc::new(CallerEchoService)).await.unwrap();
    for data in [true, false] {
        let answer = peer.obey(&format!("call {data}")).await;
        assert_eq!(answer, [json!(data), json!("/lab/peer")]);
    }
}

#[tokio::test]
async fn a_server_that_is_killed_while_it_works_is_noticed() {
    let lab = Lab::new();
    let mut peer = lab.peer().await;
    let bus = lab.join(NODE).await;
    wait_graph(&bus, |graph| graph.services.contains_key("/hang")).await;
    let calling = Arc::clone(&bus);
    let call = tokio::spawn(async move { calling.call("/hang", request(true), LONG).await });
    peer.wait_for("asked").await;
    let begun = Instant::now();
    peer.kill();
    let failed = call.await.unwrap();
    assert!(matches!(failed, Err(BusError::CallFailed { fate: CallFate::Unknown, .. })), "{failed:?}");
    // Its own lease is 20 s; its ports are checked five times a second.
    assert!(begun.elapsed() < Duration::from_secs(2), "{:?}", begun.elapsed());
}
