//! A DDS implementation other than Fast DDS, whose services have headers of their own.

use std::sync::Arc;

use ros::bus::Bus;
use serde_json::json as value;

use super::lab::{LONG, Lab, Peer, json, set_bool, set_bool_type, wait_graph};
use super::network::converse;
use super::services::{CallerEchoService, request};

const NODE: &str = "/cloudroid_bridge";
const SCRIPT: &str = "cyclone.py";

async fn peer(lab: &Lab) -> Peer {
    lab.node(SCRIPT, &[]).await
}

#[tokio::test]
async fn messages_go_there_and_back() {
    let lab = Lab::new();
    let _peer = peer(&lab).await;
    let bus = lab.join(NODE).await;
    converse(&bus).await;
}

#[tokio::test]
async fn its_services_are_called() {
    let lab = Lab::new();
    let _peer = peer(&lab).await;
    let bus = lab.join(NODE).await;
    wait_graph(&bus, |graph| graph.services.contains_key("/set")).await;
    for data in [true, false] {
        let answer = bus.call("/set", request(data), LONG).await.unwrap();
        let expected = format!(r#"{{"success":{data},"message":"set"}}"#);
        assert_eq!(json(&set_bool().response, &answer), expected);
    }
}

#[tokio::test]
async fn it_is_answered() {
    let lab = Lab::new();
    let mut peer = peer(&lab).await;
    let bus = lab.join(NODE).await;
    let served = bus.serve("/ask", set_bool_type(), Arc::new(CallerEchoService)).await;
    let _served = served.unwrap();
    for (number, data) in [true, false].into_iter().enumerate() {
        let answer = peer.obey(&format!("call {data}")).await;
        // It has no nodes: the caller is a participant.
        assert_eq!(answer[..2], [value!(number), value!(data)]);
        let caller = answer[2].as_str().expect("a caller");
        assert!(caller.starts_with("01.10."), "{caller}");
    }
}
