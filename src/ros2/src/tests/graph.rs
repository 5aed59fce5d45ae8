use ros_bus::{BusError, Graph, JoinOptions, NodeNames, QosProfile, net::HostSockets};

use super::*;
use crate::Ros2Bus;

async fn graph(bus: &Ros2Bus, wanted: impl Fn(&Graph) -> bool) -> Arc<Graph> {
    let mut graph = bus.graph();
    let found = timeout(LONG, graph.wait_for(|graph| wanted(graph))).await;
    let found = found.map(|found| found.map(|graph| Arc::clone(&graph)));
    match found {
        Ok(found) => found.expect("the bus is open"),
        Err(_) => panic!("{:#?}", bus.graph().borrow()),
    }
}

#[tokio::test]
async fn nodes_are_shown_with_what_they_have() {
    let (one, two) = (join(50, "/one").await, join(50, "/ns/two").await);
    let qos = QosProfile::keep_last(1);
    let publisher = one.advertise("/chatter", string(), qos).await.unwrap();
    let _heard = two.subscribe("/chatter", string(), qos).await.unwrap();
    let nodes = |list: &[&str]| list.iter().map(ToString::to_string).collect::<Vec<_>>();
    for bus in [&one, &two] {
        let graph = graph(bus, |graph| {
            let chatter = graph.topics.get("/chatter");
            let ends = chatter.map(|it| (it.publishers.clone(), it.subscribers.clone()));
            ends == Some((nodes(&["/one"]), nodes(&["/ns/two"])))
        });
        let graph = graph.await;
        assert_eq!(graph.topics["/chatter"].type_name, "std_msgs/msg/String");
        assert_eq!(graph.nodes["/one"], one.guid().to_string());
        assert_eq!(graph.nodes["/ns/two"], two.guid().to_string());
    }
    let before = two.graph().borrow().generation;
    drop(publisher);
    let after = graph(&two, |graph| {
        let chatter = graph.topics.get("/chatter");
        chatter.is_some_and(|chatter| chatter.publishers.is_empty())
    });
    assert!(after.await.generation > before);
    one.close().await;
    graph(&two, |graph| !graph.nodes.contains_key("/one")).await;
}

#[tokio::test]
async fn a_bus_that_stands_for_several_nodes_is_seen_as_these() {
    let (one, two) = (join(53, "/ears").await, join(53, "/other").await);
    let qos = QosProfile::keep_last(1);
    let names = |names: &[&str]| names.iter().map(ToString::to_string).collect();
    let mouth = NodeNames { publishes: names(&["/said", "/log"]), ..NodeNames::default() };
    let ears = NodeNames { publishes: names(&["/log"]), ..NodeNames::default() };
    let both = |mouth: &NodeNames| {
        [("/ears".to_owned(), ears.clone()), ("/mouth".to_owned(), mouth.clone()), ("no name".to_owned(), ears.clone())]
    };
    one.set_represented_nodes(both(&mouth).into());
    let _said = one.advertise("/said", string(), qos).await.unwrap();
    let _log = one.advertise("/log", string(), qos).await.unwrap();
    let _heard = one.subscribe("/said", string(), qos).await.unwrap();
    let is = |graph: &Graph, said: &str| {
        let said_by = graph.topics.get("/said");
        said_by.is_some_and(|ends| ends.publishers == [said] && ends.subscribers == ["/ears"])
            && graph.topics.contains_key("/log")
    };
    let seen = graph(&two, |graph| is(graph, "/mouth")).await;
    let nodes: Vec<_> = seen.nodes.keys().collect();
    assert_eq!(nodes, ["/ears", "/mouth", "/other"]);
    assert_eq!(seen.nodes["/mouth"], one.guid().to_string());
    // It is its own again when no other node is said to have it.
    one.set_represented_nodes([].into());
    let seen = graph(&two, |graph| is(graph, "/ears")).await;
    assert!(!seen.nodes.contains_key("/mouth"), "{seen:#?}");
}

#[tokio::test]
async fn names_and_domains_that_are_none_are_refused() {
    let connect = |options| Ros2Bus::connect(Arc::new(HostSockets), options);
    let named = connect(JoinOptions::in_domain(domain(51), "no name")).await;
    assert!(matches!(named, Err(BusError::BadName(_))));
    let far = connect(JoinOptions::in_domain(233, "/one")).await;
    let said = far.expect_err("there is no such domain").to_string();
    assert!(said.contains("ROS_DOMAIN_ID 233"), "{said}");
    let bus = join(51, "/one").await;
    let qos = QosProfile::keep_last(1);
    for bad in ["chatter", "/2", "/a b"] {
        let subscribed = bus.subscribe(bad, string(), qos).await;
        assert!(matches!(subscribed, Err(BusError::BadName(_))), "{bad}");
    }
    let typed = bus.subscribe("/a", WireType::with_name("std_msgs/ String"), qos).await;
    assert!(matches!(typed, Err(BusError::BadName(_))));
}
