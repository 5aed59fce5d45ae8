use std::sync::Arc;
use std::time::Duration;

use ros_bus::{ActionHandler, ActionServer, FailureReason};
use ros_message::schema::{ActionDef, Registry};

use super::*;
use crate::testing::TestNode;
use crate::xmlrpc::Value;

struct Nothing;

impl ActionHandler for Nothing {
    fn on_goal(&self, _id: &str, _goal: Bytes) -> Result<(), FailureReason> {
        Ok(())
    }

    fn on_cancel(&self, _id: &str) {}

    fn on_failed(&self, reason: &str) {
        panic!("{reason}");
    }
}

fn dig() -> Arc<ActionDef> {
    let definitions = Registry::new();
    let text = "int32 metres\n---\n---\n";
    definitions.insert("pkg/action/Dig", text).unwrap();
    definitions.action("pkg/Dig").unwrap()
}

fn serve_dig(bus: &Ros1Bus) -> Box<dyn ActionServer> {
    let handler = Arc::new(Nothing);
    bus.serve_action("/dig", &dig(), handler).unwrap()
}

/// Another node of the action, which reports the given connections and is never connected to.
async fn node_reporting(master: &TestMaster, connections: Value) -> TestNode {
    let node = TestNode::start_answering(connections).await;
    let list = ["/other", "/dig/result", "pkg/DigActionResult", &node.uri].map(Value::from);
    master.call("registerPublisher", &list).await;
    node
}

/// Waits for the next query for the node's connections.
async fn wait_until_asked(node: &mut TestNode) {
    while node.next().await.0 != "getBusInfo" {}
}

async fn both_there(bus: &Ros1Bus) {
    let of = |graph: &Graph| graph.topics.get("/dig/result").map(|of| of.publishers.len());
    wait_for_graph(bus, |graph| of(graph) == Some(2)).await;
}

#[tokio::test]
async fn no_goal_is_sent_to_a_server_that_does_not_send_its_results_here_yet() {
    let master = TestMaster::start().await;
    let (one, two) = (join(&master, "/one").await, join(&master, "/two").await);
    let _server = serve_dig(&two);
    let mut late = node_reporting(&master, Value::Array(Vec::new())).await;
    both_there(&one).await;
    let client = one.action_client("/dig", &dig()).unwrap();
    let ready = tokio::spawn(async move { client.wait_for_server(PATIENCE).await });
    for _ in 0..3 {
        wait_until_asked(&mut late).await;
    }
    assert!(!ready.is_finished(), "it hears nothing of it");
    let gone = ["/other", "/dig/result", &late.uri].map(Value::from);
    master.call("unregisterPublisher", &gone).await;
    ready.await.unwrap().unwrap();
}

#[tokio::test]
async fn a_server_that_sends_its_results_here_is_asked_once() {
    let master = TestMaster::start().await;
    let (one, two) = (join(&master, "/one").await, join(&master, "/two").await);
    let _server = serve_dig(&two);
    let row = [Value::Int(1), "/one".into(), "o".into(), "TCPROS".into(), "/dig/result".into(), true.into()];
    let rows = Value::Array(vec![Value::Array(row.to_vec())]);
    let mut other = node_reporting(&master, rows).await;
    both_there(&one).await;
    let client = one.action_client("/dig", &dig()).unwrap();
    client.wait_for_server(PATIENCE).await.unwrap();
    wait_until_asked(&mut other).await;
    client.wait_for_server(PATIENCE).await.unwrap();
    while let Ok((method, _)) = other.calls.try_recv() {
        assert_ne!(method, "getBusInfo");
    }
}

#[tokio::test]
async fn a_server_that_never_says_so_delays_the_first_goal_alone() {
    let master = TestMaster::start().await;
    let (one, two) = (join(&master, "/one").await, join(&master, "/two").await);
    let _server = serve_dig(&two);
    let mut other = node_reporting(&master, Value::Array(Vec::new())).await;
    both_there(&one).await;
    let client = one.action_client("/dig", &dig()).unwrap();
    client.wait_for_server(PATIENCE).await.unwrap();
    while other.calls.try_recv().is_ok() {}
    client.wait_for_server(Duration::from_secs(1)).await.unwrap();
    while let Ok((method, _)) = other.calls.try_recv() {
        assert_ne!(method, "getBusInfo");
    }
}

#[tokio::test]
async fn who_only_observes_goals_is_no_server() {
    let master = TestMaster::start().await;
    let (one, two) = (join(&master, "/one").await, join(&master, "/two").await);
    let observed = two.subscribe("/dig/goal", WireType::any(), QosProfile::keep_last(1));
    let observed = observed.await.unwrap();
    let client = one.action_client("/dig", &dig()).unwrap();
    let connected = ros_bus::wait_for_connected(observed.matched.clone(), 1);
    tokio::time::timeout(PATIENCE, connected).await.unwrap();
    let ready = client.wait_for_server(Duration::from_millis(300)).await;
    assert!(matches!(ready, Err(BusError::Timeout { .. })), "{ready:?}");
    let _server = serve_dig(&two);
    client.wait_for_server(PATIENCE).await.unwrap();
}
