//! A robot's bus over servants of the other ROS: nodes of ROS 2 in memory, nodes of ROS 1 at a real Master.

mod actions;
mod lent_actions;
mod parameters;

use std::net::SocketAddr;
use std::time::Duration;

use ros::bus::{
    Bus, BusError, CallFate, FailureReason, Lender, LentService, MatchedPeers, ParamValue, PeerId, QosProfile,
    RosVersion, ServiceHandler, ServiceType, Subscription, WireType, enclave_for,
};
use ros::codec::put::CdrWriter;
use ros::codec::{FillOptions, JsonOptions, from_json, to_json};
use ros::net::HostSockets;
use ros::ros1::Ros1Bus;
use ros::ros1::master::{Master, MasterOptions};
use ros::schema::{MessageType, Registry};
use serde_json::{Value, json};
use tokio::net::TcpListener;
use tokio::time::timeout;

use super::memory_bus::{MemoryBus, MemorySystem};
use super::*;
use crate::TranslationRules;

/// Only limits the duration of a failing test.
const LONG: Duration = Duration::from_secs(120);

/// Returns the definitions of a servant's image.
fn definitions(version: RosVersion) -> Arc<Registry> {
    let registry = Registry::for_version(version);
    for (key, text) in [
        ("std_msgs/msg/String", "string data"),
        ("std_srvs/srv/Trigger", "---\nbool success\nstring message"),
        ("geometry_msgs/msg/Point", "float64 x\nfloat64 y\nfloat64 z"),
        ("geometry_msgs/msg/PointStamped", "std_msgs/Header header\nPoint point"),
        ("x_msgs/action/Count", "int32 order\n---\nint32 sum\n---\nint32 part\n"),
    ] {
        registry.insert(key, text).expect("a definition");
    }
    Arc::new(registry)
}

/// Returns a message type under its name in ROS 1.
fn type_of(version: RosVersion, name: &str) -> Arc<MessageType> {
    let name = match version {
        RosVersion::One => name.to_owned(),
        RosVersion::Two => name.replacen('/', "/msg/", 1),
    };
    definitions(version).message(&name).expect("a type")
}

fn string(version: RosVersion) -> WireType {
    WireType::from_message(&type_of(version, "std_msgs/String"))
}

fn trigger(version: RosVersion) -> Arc<ServiceDef> {
    let service = definitions(version).service("std_srvs/Trigger");
    service.expect("a service")
}

fn serialize(of: &MessageType, value: &Value) -> Bytes {
    let mut out = Vec::new();
    from_json(of, value.to_string().as_bytes(), &mut out, &FillOptions::default()).expect("a message");
    out.into()
}

fn parse(of: &MessageType, bytes: &[u8]) -> Value {
    let mut out = Vec::new();
    to_json(of, bytes, &mut out, &JsonOptions::default()).expect("a message");
    serde_json::from_slice(&out).expect("JSON")
}

fn say(version: RosVersion, text: &str) -> Bytes {
    serialize(&type_of(version, "std_msgs/String"), &json!({ "data": text }))
}

#[derive(Default)]
struct RecordedLosses(Mutex<Vec<String>>);

impl TranslationObserver for RecordedLosses {
    fn on_loss(&self, _name: &str, text: &str) {
        self.0.lock().push(text.to_owned());
    }
}

/// Returns the bus of a robot of the other ROS.
fn translate(inner: Arc<dyn Bus>) -> (Arc<TranslatedBus>, Arc<RecordedLosses>) {
    translate_within(inner, &Budget::without_limit())
}

/// Likewise, with the servant's budget.
fn translate_within(inner: Arc<dyn Bus>, budget: &Budget) -> (Arc<TranslatedBus>, Arc<RecordedLosses>) {
    let losses = Arc::new(RecordedLosses::default());
    let (version, registry) = (inner.version(), definitions(inner.version()));
    let types = TypeTranslations::new(TranslationRules::default()).with_known(Arc::clone(&registry), version);
    (TranslatedBus::new(inner, Arc::new(types), registry, Arc::clone(&losses) as _, budget), losses)
}

/// A servant of ROS 2: a robot's bus, and a node.
fn servant_of_ros2() -> (Arc<TranslatedBus>, Arc<RecordedLosses>, Arc<MemoryBus>) {
    let system = Arc::new(MemorySystem::default());
    let (bus, losses) = translate(system.join("/bridge"));
    (bus, losses, system.join("/see"))
}

/// A servant of ROS 1: a robot's bus, and a node.
async fn servant_of_ros1() -> (Arc<TranslatedBus>, Arc<RecordedLosses>, Arc<Ros1Bus>) {
    let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
    let address: SocketAddr = listener.local_addr().expect("an address");
    let master = Master::new(MasterOptions::default());
    tokio::spawn(async move { master.serve(listener, Arc::new(HostSockets)).await });
    let join = |name: &'static str| Ros1Bus::connect(Arc::new(HostSockets), address, name);
    let (bus, losses) = translate(join("/bridge").await.expect("a bus"));
    (bus, losses, join("/see").await.expect("a node"))
}

async fn wait_graph(bus: &dyn Bus, wanted: impl Fn(&Graph) -> bool) -> Arc<Graph> {
    let mut graphs = bus.graph();
    match timeout(LONG, graphs.wait_for(|graph| wanted(graph))).await {
        Ok(graph) => Arc::clone(&*graph.expect("the bus is open")),
        Err(_) => panic!("{:#?}", bus.graph().borrow()),
    }
}

async fn next(subscription: &mut Subscription) -> ros::bus::SerializedMessage {
    let message = timeout(LONG, subscription.messages.recv()).await;
    message.expect("a message comes").expect("the topic is there")
}

async fn wait_matched(mut matched: watch::Receiver<MatchedPeers>, node: &str) {
    let there = timeout(LONG, matched.wait_for(|now| now.has_node(node))).await;
    there.expect("they match").expect("the topic is there");
}

/// Answers with this result in its own ROS.
struct Answer(Result<Bytes, FailureReason>);

#[async_trait]
impl ServiceHandler for Answer {
    async fn call(&self, _: Bytes, _: &str) -> Result<Bytes, FailureReason> {
        self.0.clone()
    }
}

/// Returns a handler whose response has this text.
fn answer(version: RosVersion, text: &str) -> Arc<Answer> {
    let response = json!({ "success": true, "message": text });
    Arc::new(Answer(Ok(serialize(&trigger(version).response, &response))))
}

fn failure(reason: &str) -> Arc<Answer> {
    Arc::new(Answer(Err(FailureReason::new(reason))))
}

#[tokio::test]
async fn following_the_graph_is_charged_to_the_servant() {
    let work = budget::WorkLimit { cores: 1.0, burst: LONG };
    let budget = Budget::new("the daemon", 1 << 20).child_with_work("servant x", 1 << 20, work);
    let system = Arc::new(MemorySystem::default());
    let (bus, _) = translate_within(system.join("/bridge"), &budget);
    let before = budget.work_time();
    let node = system.join("/see");
    let _found = node.advertise("/found", string(RosVersion::Two), QosProfile::keep_last(5)).await;
    wait_graph(&*bus, |graph| graph.topics.contains_key("/found")).await;
    assert!(budget.work_time() > before);
}

#[tokio::test]
async fn a_robot_of_ros_1_hears_a_node_of_ros_2_and_is_heard() {
    let (bus, _, node) = servant_of_ros2();
    let qos = QosProfile::keep_last(5);
    let found = node.advertise("/found", string(RosVersion::Two), qos).await.expect("a publisher");
    let graph = wait_graph(&*bus, |graph| graph.topics.contains_key("/found")).await;
    assert_eq!(graph.topics["/found"].type_name, "std_msgs/String");
    assert_eq!(bus.version(), RosVersion::One);
    let of = string(RosVersion::One);
    assert_eq!(bus.topic_type("/found").await.expect("a type").digest, of.digest);
    assert_eq!(bus.message(&of).expect("its definition").full_text().trim_end(), of.definition);
    let mut heard = bus.subscribe("/found", WireType::any(), qos).await.expect("a subscription");
    found.publish(say(RosVersion::Two, "people"));
    let message = next(&mut heard).await;
    assert_eq!(message.bytes, say(RosVersion::One, "people"));
    assert_eq!((&*message.wire_type.name, message.publisher.node()), ("std_msgs/String", "/see"));
    // A node that comes late is given what the robot has latched.
    let map = bus.advertise("/map", of, qos.latching(true)).await.expect("a publisher");
    map.publish(say(RosVersion::One, "walls"));
    let late = node.subscribe("/map", string(RosVersion::Two), qos.latching(true)).await;
    let mut late = late.expect("a subscription");
    let message = next(&mut late).await;
    assert_eq!(message.bytes, say(RosVersion::Two, "walls"));
    wait_matched(map.matched_subscribers(), "/see").await;
}

#[tokio::test]
async fn a_stamp_is_at_its_place_in_either_ros() {
    let (bus, _, node) = servant_of_ros2();
    let of = |version| type_of(version, "geometry_msgs/PointStamped");
    let wire = |version| WireType::from_message(&of(version));
    let mut heard = node.subscribe("/point", wire(RosVersion::Two), QosProfile::keep_last(5)).await.expect("a topic");
    let point = bus.advertise("/point", wire(RosVersion::One), QosProfile::keep_last(5)).await.expect("a topic");
    let stamp = json!({ "secs": 1_700_000_000, "nsecs": 7 });
    let sent = json!({ "header": { "seq": 3, "stamp": stamp, "frame_id": "map" }, "point": { "x": 1.5 } });
    let sent = serialize(&of(RosVersion::One), &sent);
    point.publish(sent.clone());
    let came = next(&mut heard).await.bytes;
    assert_eq!(came[4..12], sent[4..12], "requests are recognized by these bytes");
    assert_eq!(parse(&of(RosVersion::Two), &came)["point"]["x"], 1.5);
}

#[tokio::test]
async fn a_robot_of_ros_1_calls_a_service_of_ros_2() {
    let (bus, _, node) = servant_of_ros2();
    let of = ServiceType::from_service(&trigger(RosVersion::Two));
    let _serving = node.serve("/see/now", of, answer(RosVersion::Two, "noon")).await.expect("it is served");
    let graph = wait_graph(&*bus, |graph| graph.services.contains_key("/see/now")).await;
    assert_eq!(graph.services["/see/now"], "/see");
    let ours = bus.service_type("/see/now").await.expect("a type");
    assert_eq!(ours, ServiceType::from_service(&trigger(RosVersion::One)));
    assert!(bus.service(&ours).is_some());
    let response = bus.call_typed("/see/now", &ours.digest, Bytes::new(), LONG).await.expect("a response");
    assert_eq!(parse(&trigger(RosVersion::One).response, &response)["message"], "noon");
    let other = bus.call_typed("/see/now", &Digest::from("0"), Bytes::new(), LONG).await;
    assert!(matches!(other, Err(BusError::TypeMismatch { .. })), "{other:?}");
    let nobody = bus.call("/nobody", Bytes::new(), LONG).await;
    assert!(matches!(nobody, Err(BusError::NoService(_))), "{nobody:?}");
}

#[tokio::test]
async fn a_failure_of_ros_2_that_a_caller_of_ros_1_can_be_told_is_one() {
    let (bus, losses, node) = servant_of_ros2();
    let of = ServiceType::from_service(&trigger(RosVersion::Two));
    let _serving = node.serve("/see/now", of, failure("no clock")).await.expect("it is served");
    let failed = bus.call("/see/now", Bytes::new(), LONG).await;
    assert!(matches!(failed, Err(BusError::CallFailed { fate: CallFate::Answered, .. })), "{failed:?}");
    assert!(losses.0.lock().is_empty());
}

#[tokio::test]
async fn a_robot_of_ros_2_sees_types_and_quality_of_nodes_of_ros_1() {
    let (bus, _, node) = servant_of_ros1().await;
    let qos = QosProfile::keep_last(5);
    let of = || string(RosVersion::One);
    let map = node.advertise("/map", of(), qos.latching(true)).await.expect("a topic");
    let found = node.advertise("/found", of(), qos).await.expect("a topic");
    let mut scans = node.subscribe("/scan", of(), qos).await.expect("a topic");
    let service = ServiceType::from_service(&trigger(RosVersion::One));
    let _serving = node.serve("/now", service, answer(RosVersion::One, "noon")).await.expect("it is served");
    let graph = wait_graph(&*bus, |graph| {
        graph.ends.get("/see").is_some_and(|ends| {
            ends.publishers.len() >= 2 && ends.subscribers.contains_key("/scan") && ends.services.contains_key("/now")
        })
    })
    .await;
    let ends = &graph.ends["/see"];
    let (of_map, map_qos) = &ends.publishers["/map"];
    assert_eq!((&*of_map.name, &of_map.digest), ("std_msgs/msg/String", &string(RosVersion::Two).digest));
    assert!(map_qos.is_latching() && !ends.publishers["/found"].1.is_latching());
    assert!(ends.subscribers["/scan"].1.is_latching(), "nodes of ROS 1 are given what was latched");
    let service = &ends.services["/now"];
    assert!(service.matches(&ServiceType::from_service(&trigger(RosVersion::Two))), "{service:?}");
    map.publish(say(RosVersion::One, "walls"));
    let mut heard = bus.subscribe("/map", WireType::any(), qos.latching(true)).await.expect("a subscription");
    let message = next(&mut heard).await;
    assert_eq!((message.bytes, message.latching), (say(RosVersion::Two, "walls"), true));
    let scan = bus.advertise("/scan", string(RosVersion::Two), qos).await.expect("a publisher");
    wait_matched(scan.matched_subscribers(), "/see").await;
    scan.publish(say(RosVersion::Two, "near"));
    assert_eq!(next(&mut scans).await.bytes, say(RosVersion::One, "near"));
    drop(found);
}

#[tokio::test]
async fn a_call_that_fails_in_ros_1_ends_with_the_default_in_ros_2() {
    let (bus, losses, node) = servant_of_ros1().await;
    let of = ServiceType::from_service(&trigger(RosVersion::One));
    let _serving = node.serve("/now", of, failure("no clock")).await.expect("it is served");
    let two = trigger(RosVersion::Two);
    let request = serialize(&two.request, &json!({}));
    for _ in 0..2 {
        let response = bus.call("/now", request.clone(), LONG).await.expect("an answer");
        let response = parse(&two.response, &response);
        assert_eq!(response, json!({ "success": false, "message": "" }));
    }
    let told = losses.0.lock().clone();
    let named = told.iter().filter(|text| text.contains("/now has failed") && text.contains("no clock"));
    // Again only after a while.
    assert!(matches!(named.count(), 1 | 2), "{told:?}");
    // A service that is not there is no failure of it.
    let nobody = bus.call("/nobody", request, LONG).await;
    assert!(matches!(nobody, Err(BusError::NoService(_))), "{nobody:?}");
}

/// Lends one service of a robot.
struct OneService(ServiceType, Arc<Answer>);

#[async_trait]
impl Lender for OneService {
    async fn find_service(&self, service: &str, _: &str) -> Option<LentService> {
        (service == "/robot/secret").then(|| lent_service(self.0.clone(), Arc::clone(&self.1)))
    }
}

fn lent_service(service_type: ServiceType, handler: Arc<Answer>) -> LentService {
    let (sender, gone) = watch::channel(false);
    // Without its sender it would count as gone.
    std::mem::forget(sender);
    LentService { service_type, handler, gone }
}

#[tokio::test]
async fn a_node_of_ros_1_calls_a_robot_of_ros_2() {
    let (bus, _, node) = servant_of_ros1().await;
    let of = ServiceType::from_service(&trigger(RosVersion::Two));
    let lender = Arc::new(OneService(of, answer(RosVersion::Two, "42")));
    bus.lending().expect("it lends").lend(lender).await.expect("it lends");
    let response = node.call("/robot/secret", Bytes::new(), LONG).await.expect("a response");
    assert_eq!(parse(&trigger(RosVersion::One).response, &response)["message"], "42");
}

#[tokio::test]
async fn a_node_of_ros_2_is_answered_even_if_the_robot_of_ros_1_fails() {
    let (bus, losses, _node) = servant_of_ros2();
    let of = || ServiceType::from_service(&trigger(RosVersion::One));
    let two = trigger(RosVersion::Two);
    let request = serialize(&two.request, &json!({}));
    for (handler, expected) in [(answer(RosVersion::One, "42"), "42"), (failure("not today"), "")] {
        let seen = bus.lend_to_servant("/robot/secret", lent_service(of(), handler)).expect("it is lent");
        assert!(seen.service_type.matches(&ServiceType::from_service(&two)));
        let response = seen.handler.call(request.clone(), "/see").await.expect("an answer");
        assert_eq!(parse(&two.response, &response)["message"], expected);
    }
    assert!(losses.0.lock().iter().any(|text| text.contains("not today")));
    // A type that the image does not have is not lent, and the robot is told the reason once.
    for _ in 0..2 {
        let other = lent_service(ServiceType::new("lab_msgs/Brew", "0"), failure("x"));
        assert!(bus.lend_to_servant("/brew", other).is_err());
    }
    let told = losses.0.lock().clone();
    assert_eq!(told.iter().filter(|text| text.contains("lab_msgs/Brew")).count(), 1, "{told:?}");
}

#[tokio::test]
async fn what_cannot_be_carried_is_left_out_or_dropped_with_a_reason() {
    let (bus, losses, node) = servant_of_ros2();
    let unknown = WireType::with_name("lab_msgs/msg/Brew").with_version(RosVersion::Two);
    let _brew = node.advertise("/brew", unknown, QosProfile::keep_last(5)).await.expect("a topic");
    let found = node.advertise("/found", string(RosVersion::Two), QosProfile::keep_last(5)).await.expect("a topic");
    let graph = wait_graph(&*bus, |graph| graph.topics.contains_key("/found")).await;
    assert!(!graph.topics.contains_key("/brew"));
    let left_out = bus.left_out().borrow().clone();
    let brew = &left_out["topic /brew"];
    assert!(brew.nodes.contains("/see") && brew.reason.contains("lab_msgs/msg/Brew"), "{brew:?}");
    assert!(bus.message_problem("lab_msgs/msg/Brew").is_some() && bus.message_problem("std_msgs/msg/String").is_none());
    let mut heard = bus.subscribe("/found", WireType::any(), QosProfile::keep_last(5)).await.expect("a subscription");
    for _ in 0..2 {
        found.publish(Bytes::from_static(&[0, 1, 0, 0, 255]));
    }
    found.publish(say(RosVersion::Two, "people"));
    assert_eq!(next(&mut heard).await.bytes, say(RosVersion::One, "people"));
    let counted = bus.losses();
    assert!(matches!(&counted[..], [one] if one.name == "/found" && one.untranslated == 2), "{counted:?}");
    assert_eq!(losses.0.lock().len(), 1, "said once");
    // A type of the robot's that refers to one that nobody describes is not published.
    let brew = WireType::new("lab_msgs/Brew", "0", "lab_msgs/Bean bean\n");
    let refused = bus.advertise("/brewed", brew, QosProfile::keep_last(1)).await.err();
    assert!(matches!(refused, Some(BusError::NotTranslated { .. })), "{refused:?}");
}

#[tokio::test]
async fn parameters_of_a_servant_are_those_of_the_robots_ros() {
    let (bus, _, node) = servant_of_ros2();
    let rate = vec![("rate".to_owned(), Some(ParamValue::Int(5)))];
    node.node_parameters().expect("they are offered").set("/see", rate).await.expect("a node");
    let parameters = bus.parameters().expect("they are offered");
    assert_eq!(parameters.get("/see/rate").await.expect("a parameter"), ParamValue::Int(5));
    assert!(bus.node_parameters().is_err(), "ROS 1 has none");
    parameters.set("/late/rate", ParamValue::Int(6)).await.expect("it is kept");
    assert_eq!(bus.prepare_launch("/late", &[], &BTreeMap::new()).argv, ["--ros-args", "-p", "rate:=6", "--"]);

    let (bus, _, node) = servant_of_ros1().await;
    node.parameters().expect("a Master").set("/see/rate", ParamValue::Int(5)).await.expect("a Master");
    assert!(bus.parameters().is_err(), "ROS 2 has none");
    let _topic = node.advertise("/alive", string(RosVersion::One), QosProfile::keep_last(1)).await.expect("a topic");
    let service = "/see/get_parameters";
    let graph = wait_graph(&*bus, |graph| graph.services.contains_key(service)).await;
    let of = bus.service_type(service).await.expect("a type");
    assert_eq!(of.name, "rcl_interfaces/srv/GetParameters");
    assert_eq!(graph.ends["/see"].services[service], of);
    let mut request = CdrWriter::new();
    request.length(1);
    request.text("rate");
    let answer = bus.call(service, request.finish(), LONG).await.expect("an answer");
    // One value, an integer.
    assert_eq!((&answer[4..9], &answer[12..20]), (&[1, 0, 0, 0, 2][..], &[5, 0, 0, 0, 0, 0, 0, 0][..]));
    let launch = bus.prepare_launch("/late", &["_rate:=6".to_owned()], &BTreeMap::new());
    assert_eq!(launch.parameters, [("/late/rate".to_owned(), ParamValue::Int(6))]);
}

#[test]
fn a_process_of_ros_2_is_one_node_of_ros_1() {
    let types = Arc::new(TypeTranslations::new(TranslationRules::default()));
    let twins = KnownTwins::new(definitions(RosVersion::Two), types, RosVersion::One);
    let topic = |publishers: &[&str], name: &str| ros::bus::TopicNodes {
        type_name: name.to_owned(),
        publishers: publishers.iter().map(ToString::to_string).collect(),
        subscribers: Vec::new(),
    };
    let mark = enclave_for("/see").expect("a short name");
    let list = ServiceType::new("rcl_interfaces/srv/ListParameters", "*").with_version(RosVersion::Two);
    let ends = ros::bus::NodeEntities {
        services: [("/eye/list_parameters".to_owned(), list)].into(),
        ..ros::bus::NodeEntities::default()
    };
    let inner = Graph {
        topics: [
            ("/found".to_owned(), topic(&["/eye", "/see"], "std_msgs/msg/String")),
            ("/other".to_owned(), topic(&["/other"], "std_msgs/msg/String")),
            ("/parameter_events".to_owned(), topic(&["/eye"], "rcl_interfaces/msg/ParameterEvent")),
        ]
        .into(),
        services: [("/eye/list_parameters".to_owned(), "/eye".to_owned())].into(),
        nodes: ["/see", "/eye", "/other"].map(|node| (node.to_owned(), String::new())).into(),
        sought: [("/robot/secret".to_owned(), vec!["/eye".to_owned()])].into(),
        ends: [("/eye".to_owned(), ends)].into(),
        enclaves: [(mark, ["/see", "/eye"].map(str::to_owned).into())].into(),
        ..Graph::default()
    };
    let translated = graph::for_ros1(&inner, "/bridge", &twins);
    let graph = translated.graph;
    assert_eq!(graph.topics["/found"].publishers, ["/see"]);
    assert_eq!(graph.topics["/other"].publishers, ["/other"]);
    assert_eq!(graph.sought["/robot/secret"], ["/see"]);
    assert_eq!(graph.nodes.keys().collect::<Vec<_>>(), ["/other", "/see"]);
    // What belongs to ROS 2 itself is neither shown nor missed; ROS 1 has dynamic_reconfigure instead.
    let topics: Vec<_> = graph.topics.keys().collect();
    assert_eq!(topics, ["/eye/parameter_descriptions", "/eye/parameter_updates", "/found", "/other"]);
    assert_eq!(graph.topics["/eye/parameter_updates"].publishers, ["/see"]);
    assert_eq!(graph.services, [("/eye/set_parameters".to_owned(), "/see".to_owned())].into());
    assert!(translated.left_out.is_empty(), "{:?}", translated.left_out);
    assert_eq!(PeerId::new("/eye", 7).with_node("/see"), PeerId::new("/see", 7));
}

#[test]
fn names_that_ros_2_does_not_allow_are_named() {
    let types = Arc::new(TypeTranslations::new(TranslationRules::default()));
    let twins = KnownTwins::new(definitions(RosVersion::One), types, RosVersion::Two);
    let ends = ros::bus::TopicNodes {
        type_name: "std_msgs/String".to_owned(),
        subscribers: vec!["/see".to_owned()],
        ..ros::bus::TopicNodes::default()
    };
    let inner = Graph { topics: [("/2d/map".to_owned(), ends)].into(), ..Graph::default() };
    let translated = graph::for_ros2(&inner, "/bridge", &twins, |_| None, |_| None);
    assert!(translated.graph.topics.is_empty());
    assert!(translated.left_out["topic /2d/map"].reason.contains("begins with a digit"));
}
