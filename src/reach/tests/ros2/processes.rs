//! Processes with several nodes: how a link reports them, and how the stub's end shows them.

use std::collections::BTreeSet;
use std::sync::Arc;

use link::control::{Graph, InputChannel};
use ros::bus::{Bus, NodeNames, QosProfile, RosVersion, ServiceType};
use ros::schema::Registry;
use serde_json::{Value, json as value};

use super::lab::{GET_PARAMETERS, Lab, Peer, cdr, json, string, string_message, string_type};
use super::robot::{CloudRequest, LinkedRobot, RunTracker, find_output, find_service, hello, hub};

const NODE: &str = "/cloudroid_bridge";
/// Arguments as by [`ros::flavour::Flavour::robot_identity`] for the node `/alto`.
const MARK: [&str; 3] = ["--ros-args", "--enclave", "/cloudroid_link/alto"];
const DEFINITIONS: [(&str, &str); 3] = [("std_msgs/msg/String", "string data"), GET_PARAMETERS[0], GET_PARAMETERS[1]];

fn names(names: &[&str]) -> BTreeSet<String> {
    names.iter().map(ToString::to_string).collect()
}

fn songs(graph: &Graph) -> bool {
    let topics = ["/alto/song", "/low/tenor/song", "/songs"];
    let mut topics = topics.iter();
    topics.all(|topic| find_output(graph, topic).is_some())
        && graph.inputs.len() == 2
        && find_service(graph, "/low/tenor/get_parameters").is_some()
        && graph.nodes.len() == 2
}

#[tokio::test]
async fn all_nodes_of_a_process_are_told_with_what_each_of_them_has() {
    let lab = Lab::new();
    let _duet = lab.node("duet.py", &MARK).await;
    // A node of another process.
    let _peer = lab.peer().await;
    let bus = lab.join(NODE).await;
    let hub = hub(Arc::clone(&bus) as _, Arc::new(RunTracker::default()), &DEFINITIONS);
    let mut robot = LinkedRobot::connect(&hub, &hello("/alto")).await;
    let graph = robot.wait_graph(songs).await;
    let NodeNames { publishes, subscribes, serves } = &graph.nodes["/low/tenor"];
    let published = ["/low/tenor/song", "/parameter_events", "/rosout", "/songs"];
    assert_eq!(*publishes, names(&published));
    assert_eq!(*subscribes, names(&["/low/tenor/note"]));
    assert!(serves.contains("/low/tenor/set_parameters"), "{graph:#?}");
    assert!(graph.nodes["/alto"].publishes.contains("/songs"));
    let all: BTreeSet<String> = graph.outputs.iter().map(|it| it.topic.clone()).collect();
    let others = ["/alto/song"];
    assert_eq!(all, &names(&published) | &names(&others));
    // Messages of the second node arrive, also on a topic that both publish.
    for topic in ["/low/tenor/song", "/songs"] {
        robot.listen(find_output(&graph, topic).unwrap());
    }
    let of = string_type();
    robot.open_input(InputChannel {
        channel: 1,
        topic: "/low/tenor/note".to_owned(),
        type_name: of.name.clone(),
        md5: of.digest.to_string(),
        ..InputChannel::default()
    });
    robot.publish(1, string_message("c"));
    for _ in 0..2 {
        let heard: Value = serde_json::from_str(&json(&string(), &robot.next_message().await.1)).unwrap();
        assert_eq!(heard["data"], "/low/tenor: c");
    }
    let registry = Registry::for_version(RosVersion::Two);
    for (key, text) in DEFINITIONS {
        registry.insert(key, text).expect("a definition");
    }
    let get = registry.service("rcl_interfaces/srv/GetParameters").unwrap();
    let asked = cdr(&get.request, r#"{"names":["pitch"]}"#);
    let answer = robot.call(find_service(&graph, "/low/tenor/get_parameters").unwrap(), asked);
    let answer: Value = serde_json::from_str(&json(&get.response, &answer.await.unwrap())).unwrap();
    assert_eq!(answer["values"][0]["string_value"], "tenor", "{answer}");
    // Services that the second node looks up are looked up on the robot; unmet ones are in this link's status.
    let mut asked = robot.next_request().await;
    while !matches!(&asked, CloudRequest::Lookup(service) if service == "/lost") {
        asked = robot.next_request().await;
    }
    assert_eq!(hub.status()[0].unserved, ["/lost"]);
    // All of them are nodes of another link.
    let other = LinkedRobot::connect(&hub, &hello("/lab/peer")).await;
    let siblings = ["/alto".to_owned(), "/low/tenor".to_owned()];
    other.wait_graph(|graph| graph.siblings == siblings).await;
}

async fn ends(peer: &mut Peer, name: &str, namespace: &str) -> Value {
    Value::from(peer.obey(&format!("graph {name} {namespace}")).await)
}

#[tokio::test]
async fn nodes_that_a_bus_stands_for_are_nodes_to_rclpy() {
    let lab = Lab::new();
    let mut peer = lab.node("duet.py", &[]).await;
    let bus = lab.join("/ears").await;
    let ears = NodeNames { publishes: names(&["/log"]), ..NodeNames::default() };
    let mouth = NodeNames {
        publishes: names(&["/log", "/said"]),
        subscribes: names(&["/words"]),
        serves: names(&["/face/mouth/shut"]),
    };
    let nodes = [("/ears".to_owned(), ears), ("/face/mouth".to_owned(), mouth)];
    let qos = QosProfile::keep_last(1);
    let _log = bus.advertise("/log", string_type(), qos).await.unwrap();
    let _said = bus.advertise("/said", string_type(), qos).await.unwrap();
    let _words = bus.subscribe("/words", string_type(), qos).await.unwrap();
    let of = ServiceType::new("std_srvs/srv/SetBool", "*");
    let shut = Arc::new(super::services::CallerEchoService);
    let _shut = bus.serve("/face/mouth/shut", of, shut).await.unwrap();
    assert_eq!(ends(&mut peer, "ears", "/").await, value!([["/log", "/said"], ["/words"], ["/face/mouth/shut"]]));
    bus.set_represented_nodes(nodes.into());
    assert_eq!(ends(&mut peer, "mouth", "/face").await, value!([["/log", "/said"], ["/words"], ["/face/mouth/shut"]]));
    assert_eq!(ends(&mut peer, "ears", "/").await, value!([["/log"], [], []]));
    // There is one publisher of the topic that both have.
    let publishers = peer.obey("publishers /log").await;
    assert_eq!(publishers.len(), 1, "{publishers:?}");
    assert_eq!(peer.obey("publishers /said").await, [value!("mouth")]);
}
