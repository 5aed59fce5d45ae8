//! Tests with a real Master and real nodes on loopback.

use std::net::SocketAddr;

use package::interface::Direction;
use ros::bus::{FailureReason, Publisher, QosProfile, ServiceHandler, ServiceType, WireType};
use ros::net::HostSockets;
use ros::ros1::Ros1Bus;
use ros::ros1::master::{Master, MasterOptions};
use tokio::net::TcpListener;

use super::*;

mod feeding;
mod loading;
#[path = "../../../tests/support/memory_bus.rs"]
mod memory_bus;
#[path = "../../../tests/support/memory_container.rs"]
mod memory_container;
mod ros2_nodes;

const STRING: (&str, &str) = ("std_msgs/msg/String", "string data\n");
const ADD: (&str, &str) = ("lab/srv/Add", "int64 a\nint64 b\n---\nint64 sum\n");
const TURN: (&str, &str) = ("lab/action/Turn", "float64 angle\n---\nbool done\n---\nfloat64 left\n");

/// A Master on loopback, the definitions of an image, and a node of its package.
struct MasterFixture {
    address: SocketAddr,
    definitions: BTreeMap<String, String>,
    registry: Arc<Registry>,
    node: Arc<Ros1Bus>,
    serving: tokio::task::JoinHandle<()>,
}

impl MasterFixture {
    async fn new() -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
        let address = listener.local_addr().expect("bound");
        let master = Master::new(MasterOptions::default());
        let serving = tokio::spawn(async move { master.serve(listener, Arc::new(HostSockets)).await });
        let definitions: BTreeMap<String, String> =
            [STRING, ADD, TURN].map(|(key, text)| (key.to_owned(), text.to_owned())).into();
        let registry = Arc::new(Registry::from_definitions(&definitions).expect("valid"));
        let node = Ros1Bus::connect(Arc::new(HostSockets), address, "/package").await.expect("joined");
        Self { address, definitions, registry, node, serving }
    }

    fn wire(&self, name: &str) -> WireType {
        let message = self.registry.message(name).expect("defined");
        WireType::from_message(&message)
    }

    async fn advertises(&self, topic: &str, wire_type: WireType, latch: bool) -> Box<dyn Publisher> {
        self.node.advertise(topic, wire_type, QosProfile::keep_last(1).latching(latch)).await.expect("advertised")
    }

    async fn subscribes(&self, topic: &str, wire_type: WireType) -> Subscription {
        self.node.subscribe(topic, wire_type, QosProfile::keep_last(1)).await.expect("subscribed")
    }

    async fn serves(&self, service: &str) -> Box<dyn Send + Sync> {
        let add = self.registry.service("lab/Add").expect("defined");
        let add = ServiceType::new("lab/Add", add.md5.clone());
        let serving = self.node.serve(service, add, Arc::new(Sum));
        serving.await.expect("served")
    }

    fn options(&self, nodes: &[&str]) -> ProbeOptions {
        ProbeOptions {
            patience: Duration::from_millis(500),
            settle: Duration::from_millis(150),
            restless: Duration::from_secs(4),
            ..ProbeOptions::new(nodes.iter().map(|&node| node.to_owned()).collect(), "/looker")
        }
    }

    async fn run_probe(
        &self,
        nodes: &[&str],
        exited: impl Future<Output = String> + Send,
    ) -> Result<ProbeResult, ProbeError> {
        self.run_probe_with(&self.options(nodes), exited).await
    }

    async fn run_probe_with(
        &self,
        options: &ProbeOptions,
        exited: impl Future<Output = String> + Send,
    ) -> Result<ProbeResult, ProbeError> {
        let bus: Arc<dyn Bus> = Ros1Bus::connect(Arc::new(HostSockets), self.address, "/looker").await.expect("joined");
        let found = probe(&bus, &self.registry, &self.definitions, options, exited).await;
        bus.close().await;
        found
    }

    async fn ends(self) {
        self.node.close().await;
        self.serving.abort();
    }
}

struct Sum;

#[async_trait::async_trait]
impl ServiceHandler for Sum {
    async fn call(&self, _request: bytes::Bytes, _caller: &str) -> Result<bytes::Bytes, FailureReason> {
        Ok(bytes::Bytes::from_static(&[0; 8]))
    }
}

#[tokio::test]
async fn lazy_inputs_latched_outputs_services_and_parameters_are_found() {
    let lab = MasterFixture::new().await;
    let string = lab.wire("std_msgs/String");
    let _input = lab.subscribes("/eager", string.clone()).await;
    let latched = lab.advertises("/latched", string.clone(), true).await;
    latched.publish(bytes::Bytes::from_static(b"\x02\0\0\0hi"));
    let output = lab.advertises("/out", string.clone(), false).await;
    let _served = lab.serves("/add").await;
    lab.node.parameters().expect("offered").set("/package/gain", ros::bus::ParamValue::Double(0.5)).await.expect("set");
    // Activated as in real nodes, by the first subscriber of its output.
    let mut listeners = output.matched_subscribers();
    let node = lab.node.clone();
    let waking = tokio::spawn(async move {
        listeners.wait_for(|now| now.connected_count() > 0).await.expect("alive");
        node.subscribe("/sleepy", string, QosProfile::keep_last(1)).await.expect("subscribed")
    });

    let found = lab.run_probe(&["/package"], std::future::pending()).await.expect("found");
    let interface = found.interface;
    let topic = |name: &str| interface.topics.iter().find(|topic| topic.name == name).expect(name);
    assert_eq!((topic("/eager").direction, topic("/eager").lazy), (Direction::Input, false));
    assert_eq!((topic("/sleepy").direction, topic("/sleepy").lazy), (Direction::Input, true));
    assert_eq!((topic("/out").direction, topic("/out").latched), (Direction::Output, false));
    assert!(topic("/latched").latched);
    assert_eq!(topic("/out").type_name, "std_msgs/String");
    assert_eq!(topic("/out").nodes, ["/package"]);
    assert_eq!(interface.topics.len(), 4, "{:?}", interface.topics);
    assert_eq!(interface.services[0].type_name, "lab/Add");
    let gain = interface.parameters.iter().find(|parameter| parameter.name == "/package/gain").expect("written");
    assert_eq!(gain.value, Some(serde_json::json!(0.5)));
    assert_eq!(gain.written_by, ["/package"]);
    assert_eq!(interface.definitions.keys().collect::<Vec<_>>(), ["lab/srv/Add", "std_msgs/msg/String"]);
    drop(waking.await);
    lab.ends().await;
}

#[tokio::test(start_paused = true)]
async fn a_node_that_waits_for_a_core_is_waited_for() {
    let shows = |topics: &[&str]| {
        let nodes = || TopicNodes { publishers: vec!["/package".into()], ..TopicNodes::default() };
        Arc::new(Graph { topics: topics.iter().map(|&name| (name.to_owned(), nodes())).collect(), ..Graph::default() })
    };
    let (graph, mut watch) = tokio::sync::watch::channel(shows(&["/first"]));
    // It gets 1/40 of five seconds. Then it registers its remaining interface and settles.
    let begun = Instant::now();
    let crowded = Duration::from_secs(5);
    let work = CpuTimeSource::new(move || async move {
        let elapsed = begun.elapsed().min(crowded);
        Some(CpuTime { ran: elapsed / 40, waited: elapsed - elapsed / 40 })
    });
    let options = ProbeOptions { work: Some(work), ..ProbeOptions::new(vec!["/package".into()], "/looker") };
    let (all, shown) = (shows(&["/first", "/last"]), graph.clone());
    tokio::spawn(async move {
        tokio::time::sleep_until(begun + crowded).await;
        let _ = shown.send(all);
    });
    assert!(settle::wait_until_still(&mut watch, &options).await.expect("watched"));
    assert!(watch.borrow().topics.contains_key("/last"));
    let took = begun.elapsed() - crowded;
    assert!(took < 2 * options.settle, "{took:?}");
    // Too long in any case, according to [push].
    let work =
        CpuTimeSource::new(move || async move { Some(CpuTime { ran: Duration::ZERO, waited: begun.elapsed() }) });
    let options =
        ProbeOptions { patience: Duration::from_secs(30), settle: Duration::from_secs(5), work: Some(work), ..options };
    let began = Instant::now();
    settle::wait_until_still(&mut watch, &options).await.expect("watched");
    let took = began.elapsed();
    assert!(took >= 5 * options.settle && took < 7 * options.settle, "{took:?}");
}

#[tokio::test(start_paused = true)]
async fn an_answer_is_waited_for_in_the_nodes_own_time() {
    let options = ProbeOptions::new(Vec::new(), "/looker");
    let limit = Duration::from_secs(5);
    let late = || tokio::time::sleep(2 * limit);
    assert!(settle::await_answer(limit, &options, late()).await.is_none());
    // It waits for a core for nine of ten seconds.
    let begun = Instant::now();
    let work = CpuTimeSource::new(move || async move {
        Some(CpuTime { ran: Duration::ZERO, waited: begun.elapsed().mul_f64(0.9) })
    });
    let crowded = ProbeOptions { work: Some(work), ..options };
    assert!(settle::await_answer(limit, &crowded, late()).await.is_some());
    let began = Instant::now();
    let never = std::future::pending::<()>();
    assert!(settle::await_answer(limit, &crowded, never).await.is_none());
    let took = began.elapsed();
    assert!(took > 9 * limit && took <= crowded.patience, "{took:?}");
}

#[tokio::test]
async fn a_node_that_still_works_is_waited_for() {
    let lab = MasterFixture::new().await;
    let _first = lab.advertises("/first", lab.wire("std_msgs/String"), false).await;
    let bus: Arc<dyn Bus> = Ros1Bus::connect(Arc::new(HostSockets), lab.address, "/looker").await.expect("joined");
    // At the third query it is done, and only then registers its input. Without waiting for it, its later activity
    // would look like a reaction to the subscription.
    let (node, wire) = (lab.node.clone(), lab.wire("std_msgs/String"));
    let asked = Arc::new(std::sync::atomic::AtomicU32::new(0));
    let late = Arc::new(tokio::sync::Mutex::new(None));
    let kept = late.clone();
    let work = CpuTimeSource::new(move || {
        let (node, wire, late) = (node.clone(), wire.clone(), late.clone());
        let times = asked.fetch_add(1, std::sync::atomic::Ordering::Relaxed);
        async move {
            if times == 2 {
                *late.lock().await =
                    Some(node.subscribe("/late", wire, QosProfile::keep_last(1)).await.expect("subscribed"));
            }
            Some(CpuTime { ran: Duration::from_secs(times.min(2).into()), ..CpuTime::default() })
        }
    });
    let options = ProbeOptions {
        settle: Duration::from_millis(100),
        work: Some(work),
        ..ProbeOptions::new(vec!["/package".into()], "/looker")
    };
    let found = probe(&bus, &lab.registry, &lab.definitions, &options, std::future::pending()).await.expect("found");
    let topics = &found.interface.topics;
    let late = topics.iter().find(|topic| topic.name == "/late").expect("found");
    assert!(!late.lazy, "{late:?}");
    bus.close().await;
    drop(kept);
    lab.ends().await;
}

#[tokio::test]
async fn a_node_that_shows_nothing_yet_is_waited_for() {
    let lab = MasterFixture::new().await;
    let (node, wire_type) = (lab.node.clone(), lab.wire("std_msgs/String"));
    let _rosout = lab.advertises("/rosout", wire_type.clone(), false).await;
    let showing = tokio::spawn(async move {
        // Slow: long after the graph seemed to have settled.
        tokio::time::sleep(Duration::from_millis(600)).await;
        node.advertise("/late", wire_type, QosProfile::keep_last(1)).await.expect("advertised")
    });
    let found = lab.run_probe(&["/package"], std::future::pending()).await.expect("found");
    assert_eq!(found.interface.topics[0].name, "/late");
    drop(showing.await);
    lab.ends().await;
}

#[tokio::test]
async fn five_topics_are_an_action() {
    let lab = MasterFixture::new().await;
    let turn = lab.registry.action("lab/Turn").expect("defined");
    let wire = |message: &Arc<ros::schema::MessageType>| WireType::from_message(message);
    let _goal = lab.subscribes("/turn/goal", wire(&turn.action_goal)).await;
    let _cancel = lab.subscribes("/turn/cancel", lab.wire("actionlib_msgs/GoalID")).await;
    let _status = lab.advertises("/turn/status", lab.wire("actionlib_msgs/GoalStatusArray"), false).await;
    let _feedback = lab.advertises("/turn/feedback", wire(&turn.action_feedback), false).await;
    let _result = lab.advertises("/turn/result", wire(&turn.action_result), false).await;
    let found = lab.run_probe(&["/package"], std::future::pending()).await.expect("found");
    assert_eq!(found.interface.topics, []);
    assert_eq!(found.interface.actions[0].type_name, "lab/Turn");
    assert_eq!(
        (found.interface.actions[0].name.as_str(), found.interface.actions[0].node.as_str()),
        ("/turn", "/package")
    );
    lab.ends().await;
}

#[tokio::test]
async fn a_node_compiled_with_another_definition_is_refused() {
    let lab = MasterFixture::new().await;
    let other = WireType { digest: "0".repeat(32).into(), ..lab.wire("std_msgs/String") };
    let _input = lab.subscribes("/in", other).await;
    let error = lab.run_probe(&["/package"], std::future::pending()).await.expect_err("refused").to_string();
    assert!(error.contains("topic /in") && error.contains("std_msgs/String"), "{error}");
    lab.ends().await;
}

#[tokio::test]
async fn a_node_that_never_registers_is_named() {
    let lab = MasterFixture::new().await;
    let _output = lab.advertises("/out", lab.wire("std_msgs/String"), false).await;
    let error = lab.run_probe(&["/package", "/absent"], std::future::pending()).await.expect_err("absent").to_string();
    assert!(error.starts_with("/absent did not register"), "{error}");
    lab.ends().await;
}

#[tokio::test]
async fn a_node_that_ends_is_told_before_anything_else() {
    let lab = MasterFixture::new().await;
    let exited = async { "/package exited with 3".to_owned() };
    let error = lab.run_probe(&["/absent"], exited).await.expect_err("ended").to_string();
    assert_eq!(error, "/package exited with 3");
    lab.ends().await;
}

#[tokio::test]
async fn services_that_are_missed_are_named() {
    let lab = MasterFixture::new().await;
    let text = lab.wire("std_msgs/String");
    let _topic = lab.advertises("/said", text, false).await;
    for missing in ["/static_map", "/add"] {
        let called = lab.node.service_type(missing).await;
        assert!(called.is_err(), "{called:?}");
    }
    let never = lab.run_probe(&["/late"], std::future::pending()).await;
    let error = never.expect_err("it does not come").to_string();
    assert!(error.contains("such as the service /add or /static_map"), "{error}");
    // One of them appears before the end.
    let _add = lab.serves("/add").await;
    let found = lab.run_probe(&["/package"], std::future::pending()).await;
    let found = found.expect("an interface");
    let needs = found.interface.needs;
    assert_eq!(needs.len(), 1, "{needs:?}");
    assert_eq!(needs[0].name, "/static_map");
    assert_eq!(needs[0].nodes, ["/package"]);
    let told = |warning: &String| warning.contains("/static_map");
    assert!(found.warnings.iter().any(told), "{:?}", found.warnings);
    lab.ends().await;
}
