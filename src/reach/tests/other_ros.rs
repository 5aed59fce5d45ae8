//! Links of robots whose ROS is not the servant's: a simulated robot's end, and a servant of ROS 1 at a real Master or
//! of ROS 2 in memory.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use bytes::Bytes;
use link::control::{Exit, FromRobot, Hello, InputChannel, NodeLaunch};
use package::interface::Interface;
use parking_lot::Mutex;
use reach::links::{Hub, HubOptions, NodeController, NodeError};
use ros::bus::{
    Bus, FailureReason, GoalEnd, GoalError, GoalEvents, GoalOutcome, ParamValue, QosProfile, RosVersion,
    ServiceHandler, ServiceType, WireType, wait_for_connected,
};
use ros::codec::put::CdrWriter;
use ros::codec::{FillOptions, JsonOptions, Time, from_json, to_json};
use ros::net::HostSockets;
use ros::ros1::Ros1Bus;
use ros::ros1::actions::messages::{self, ActionlibStatus, GoalId, GoalState};
use ros::ros1::master::{Master, MasterOptions};
use ros::schema::{ActionDef, MessageType, Registry};
use serde_json::{Value, json};
use tokio::sync::mpsc;
use tokio::time::timeout;
use translation::TranslationRules;

#[allow(dead_code, reason = "not all of its nodes are needed here")]
#[path = "../../../tests/support/memory_bus.rs"]
mod memory_bus;
#[allow(dead_code, reason = "not all that a robot can do is needed here")]
#[path = "ros2/robot.rs"]
mod robot;

use memory_bus::MemorySystem;
use robot::{CloudRequest, LinkedRobot, expect_refusal, find_output, find_service};

/// Surroundings that the robot's end expects.
mod lab {
    /// Only limits the duration of a failing test.
    pub const LONG: std::time::Duration = std::time::Duration::from_secs(120);
}

const LONG: Duration = lab::LONG;
const NODE: &str = "/see";

/// Nodes of a servant, which run in this process.
#[derive(Default)]
struct ServantNodes {
    interface: Option<Interface>,
    /// The descriptions with which nodes were started.
    started: Mutex<BTreeMap<String, NodeLaunch>>,
}

#[async_trait]
impl NodeController for ServantNodes {
    fn service(&self) -> &str {
        "vision"
    }
    fn interface(&self) -> Option<&Interface> {
        self.interface.as_ref()
    }
    async fn start(&self, node: &NodeLaunch, _: &str) -> Result<(), NodeError> {
        self.started.lock().insert(node.name.clone(), node.clone());
        Ok(())
    }
    async fn signal(&self, node: &str, _: i32) -> Result<(), NodeError> {
        self.started.lock().remove(node);
        Ok(())
    }
    async fn wait_exit(&self, node: &str) -> Exit {
        if self.is_running(node).await {
            std::future::pending::<()>().await;
        }
        Exit::default()
    }
    async fn is_running(&self, node: &str) -> bool {
        self.started.lock().contains_key(node)
    }
    fn parameters(&self, _: &NodeLaunch) -> Vec<(String, ParamValue)> {
        Vec::new()
    }
    fn translate(&self, _: &NodeLaunch, text: &str) -> String {
        text.to_owned()
    }
    fn warn(&self, _: &str, _: &str) {}
    fn output_lines(&self, _: &str) -> mpsc::Receiver<(bool, String)> {
        mpsc::channel(1).1
    }
}

/// Returns the definitions of an image.
fn definitions(version: RosVersion) -> Registry {
    let registry = Registry::for_version(version);
    for (key, text) in [
        ("std_msgs/msg/String", "string data"),
        ("std_srvs/srv/Trigger", "---\nbool success\nstring message"),
        ("x_msgs/action/Count", "int32 order\n---\nint32 sum\n---\nint32 part\n"),
    ] {
        registry.insert(key, text).expect("a definition");
    }
    registry
}

fn string(version: RosVersion) -> Arc<MessageType> {
    definitions(version).message("std_msgs/String").expect("a type")
}

fn say(version: RosVersion, text: &str) -> Bytes {
    serialize(&string(version), &json!({ "data": text }))
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

/// A servant with a hub, and one of its nodes.
struct Servant {
    version: RosVersion,
    hub: Arc<Hub>,
    nodes: Arc<ServantNodes>,
    bus: Arc<dyn Bus>,
    node: Arc<dyn Bus>,
}

impl Servant {
    async fn new(version: RosVersion, interface: Option<Interface>) -> Self {
        Self::with_options(version, interface, HubOptions::default()).await
    }

    async fn with_options(version: RosVersion, interface: Option<Interface>, options: HubOptions) -> Self {
        let (bus, node): (Arc<dyn Bus>, Arc<dyn Bus>) = match version {
            RosVersion::One => {
                let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.expect("a port");
                let address = listener.local_addr().expect("an address");
                let master = Master::new(MasterOptions::default());
                tokio::spawn(async move { master.serve(listener, Arc::new(HostSockets)).await });
                let join = |name: &'static str| Ros1Bus::connect(Arc::new(HostSockets), address, name);
                (join("/bridge").await.expect("a bus"), join(NODE).await.expect("a node"))
            }
            RosVersion::Two => {
                let system = Arc::new(MemorySystem::default());
                (system.join("/bridge"), system.join(NODE))
            }
        };
        let nodes = Arc::new(ServantNodes { interface, ..ServantNodes::default() });
        let registry = Arc::new(definitions(version));
        let hub = Hub::new("s", Arc::clone(&bus), registry, Arc::clone(&nodes) as _, options);
        Self { version, hub, nodes, bus, node }
    }

    /// Returns the hello of a robot of the other ROS.
    fn hello(&self) -> Hello {
        let ros = self.robot().number();
        Hello { ros, ..robot::hello(NODE) }
    }

    /// Returns the robot's ROS.
    fn robot(&self) -> RosVersion {
        self.version.other()
    }
}

/// A service whose responses have this text.
struct Telling(RosVersion, &'static str);

#[async_trait]
impl ServiceHandler for Telling {
    async fn call(&self, _: Bytes, _: &str) -> Result<Bytes, FailureReason> {
        let of = definitions(self.0).service("std_srvs/Trigger").expect("a service");
        Ok(serialize(&of.response, &json!({ "success": true, "message": self.1 })))
    }
}

fn input(version: RosVersion, channel: u32, topic: &str, latching: bool) -> InputChannel {
    input_of(&string(version), channel, topic, latching)
}

fn input_of(of: &MessageType, channel: u32, topic: &str, latching: bool) -> InputChannel {
    let of = WireType::from_message(of);
    InputChannel {
        channel,
        topic: topic.to_owned(),
        type_name: of.name,
        md5: of.digest.to_string(),
        definition: of.definition,
        latching,
        ..InputChannel::default()
    }
}

async fn topics_and_calls_cross(version: RosVersion) {
    let servant = Servant::new(version, None).await;
    let (node, ours, theirs) = (&servant.node, servant.robot(), version);
    let qos = QosProfile::keep_last(5);
    let of = || WireType::from_message(&string(theirs));
    let mut heard = node.subscribe("/image", of(), qos).await.expect("a topic");
    let found = node.advertise("/found", of(), qos).await.expect("a topic");
    let map = node.advertise("/map", of(), qos.latching(true)).await.expect("a topic");
    map.publish(say(theirs, "walls"));
    let trigger = |version| definitions(version).service("std_srvs/Trigger").expect("a service");
    let service = ServiceType::from_service(&trigger(theirs));
    let _serving = node.serve("/see/now", service, Arc::new(Telling(theirs, "noon"))).await.expect("it is served");
    let mut robot = LinkedRobot::connect(&servant.hub, &servant.hello()).await;
    let graph = robot.wait_graph(|graph| {
        let has = |topic| find_output(graph, topic).is_some();
        has("/found") && has("/map") && find_service(graph, "/see/now").is_some() && !graph.inputs.is_empty()
    });
    let graph = graph.await;
    // Everything is in the robot's terms, with definitions.
    let wanted = WireType::from_message(&string(ours));
    let output = find_output(&graph, "/found").expect("an output");
    assert_eq!((&output.type_name, output.md5.as_str()), (&wanted.name, wanted.digest.as_str()));
    let told = graph.inputs.iter().find(|input| input.topic == "/image").expect("an input");
    assert_eq!((&told.type_name, told.md5.as_str()), (&wanted.name, wanted.digest.as_str()));
    assert!(told.qos.is_none(), "with a request for latched messages an original is given no others: {told:?}");
    let definition = robot.definition(&wanted.name, wanted.digest.as_str()).expect("told");
    assert_eq!(definition.trim_end(), wanted.definition);
    if ours == RosVersion::Two {
        let latched = |topic| find_output(&graph, topic).and_then(|output| output.qos.clone());
        assert!(latched("/map").is_some_and(|qos| qos.transient_local), "{graph:#?}");
        assert!(latched("/found").is_some_and(|qos| !qos.transient_local), "{graph:#?}");
    }
    // An input reaches the node, and its answer the robot.
    robot.listen(output);
    robot.open_input(input(ours, 1, "/image", false));
    robot.publish(1, say(ours, "picture"));
    let message = timeout(LONG, heard.messages.recv()).await.expect("it comes").expect("the topic is there");
    assert_eq!(message.bytes, say(theirs, "picture"));
    // In ROS 1 the hub hears nothing that is published before it is connected.
    timeout(LONG, wait_for_connected(found.matched_subscribers(), 1)).await.expect("the robot listens");
    found.publish(say(theirs, "people"));
    assert_eq!(robot.next_message().await, (output.channel, say(ours, "people")));
    // What was latched before the robot subscribed reaches it.
    let map = find_output(&graph, "/map").expect("an output");
    robot.listen(map);
    assert_eq!(robot.next_message().await, (map.channel, say(ours, "walls")));
    // What the robot latches reaches a node that comes later.
    robot.open_input(input(ours, 2, "/plan", true));
    robot.publish(2, say(ours, "left"));
    let mut late = node.subscribe("/plan", of(), qos.latching(true)).await.expect("a topic");
    let message = timeout(LONG, late.messages.recv()).await.expect("it comes").expect("the topic is there");
    assert_eq!(message.bytes, say(theirs, "left"));
    let served = find_service(&graph, "/see/now").expect("a service");
    let request = serialize(&trigger(ours).request, &json!({}));
    let response = robot.call(served, request).await.expect("a response");
    assert_eq!(parse(&trigger(ours).response, &response)["message"], "noon");
}

#[tokio::test]
async fn a_robot_of_ros_1_uses_a_servant_of_ros_2() {
    topics_and_calls_cross(RosVersion::Two).await;
}

#[tokio::test]
async fn a_robot_of_ros_2_uses_a_servant_of_ros_1() {
    topics_and_calls_cross(RosVersion::One).await;
}

#[tokio::test]
async fn rules_of_a_lab_name_the_types_of_its_robots() {
    let rule = "- {ros1_package_name: lab_msgs, ros1_message_name: Text, ros2_package_name: std_msgs, \
                ros2_message_name: String}";
    let rules = TranslationRules::default().with_yaml("lab.yaml", rule).expect("a rule");
    let options = HubOptions { rules: Arc::new(rules), ..HubOptions::default() };
    let servant = Servant::with_options(RosVersion::Two, None, options).await;
    let of = WireType::from_message(&string(RosVersion::Two));
    let _found = servant.node.advertise("/found", of, QosProfile::keep_last(5)).await.expect("a topic");
    let robot = LinkedRobot::connect(&servant.hub, &servant.hello()).await;
    let graph = robot.wait_graph(|graph| find_output(graph, "/found").is_some()).await;
    assert_eq!(find_output(&graph, "/found").expect("an output").type_name, "lab_msgs/Text");
}

#[tokio::test]
async fn a_node_of_ros_1_calls_a_robot_of_ros_2() {
    let servant = Servant::new(RosVersion::One, None).await;
    let mut robot = LinkedRobot::connect(&servant.hub, &servant.hello()).await;
    let node = Arc::clone(&servant.node);
    let calling = tokio::spawn(async move { node.call("/robot/secret", Bytes::new(), LONG).await });
    let asked = robot.next_request().await;
    assert!(matches!(&asked, CloudRequest::Lookup(service) if service == "/robot/secret"), "{asked:?}");
    let two = definitions(RosVersion::Two).service("std_srvs/Trigger").expect("a service");
    robot.send_lent("/robot/secret", Some((7, &ServiceType::from_service(&two))));
    let CloudRequest::Call(id, 7, _) = robot.next_request().await else {
        panic!("it is called");
    };
    let response = serialize(&two.response, &json!({ "success": true, "message": "42" }));
    robot.session.answer(id, link::clock::now(), Ok(response));
    let response = timeout(LONG, calling).await.expect("it ends").expect("no panic").expect("a response");
    let one = definitions(RosVersion::One).service("std_srvs/Trigger").expect("a service");
    assert_eq!(parse(&one.response, &response)["message"], "42");
}

fn count(version: RosVersion) -> Arc<ActionDef> {
    definitions(version).action("x_msgs/Count").expect("an action")
}

/// Reports feedback, then the result, of a goal sent in this ROS.
struct GoalSender(RosVersion, mpsc::UnboundedSender<Result<i64, GoalOutcome>>);

impl GoalEvents for GoalSender {
    fn on_feedback(&self, feedback: Bytes) {
        let told = parse(&count(self.0).feedback, &feedback);
        let _ = self.1.send(Ok(told["part"].as_i64().expect("a number")));
    }

    fn on_ended(&self, end: Result<GoalEnd, GoalError>) {
        let _ = self.1.send(match end {
            Ok(GoalEnd { outcome: GoalOutcome::Succeeded, result, .. }) => {
                Ok(parse(&count(self.0).result, &result)["sum"].as_i64().expect("a number"))
            }
            Ok(end) => Err(end.outcome),
            Err(_) => Err(GoalOutcome::Unknown),
        });
    }
}

/// Returns the events of a goal, and what they will tell.
fn goal_events(version: RosVersion) -> (Arc<GoalSender>, mpsc::UnboundedReceiver<Result<i64, GoalOutcome>>) {
    let (told, tells) = mpsc::unbounded_channel();
    (Arc::new(GoalSender(version, told)), tells)
}

async fn next_told(told: &mut mpsc::UnboundedReceiver<Result<i64, GoalOutcome>>) -> Result<i64, GoalOutcome> {
    timeout(LONG, told.recv()).await.expect("it is told").expect("the goal is there")
}

const UUID: &str = "07070707-0707-0707-0707-070707070707";

#[tokio::test]
async fn a_node_of_ros_2_sends_goals_to_a_robot_of_ros_1() {
    let servant = Servant::new(RosVersion::Two, None).await;
    let client = servant.node.action_client("/count", &count(RosVersion::Two)).expect("a client");
    let mut robot = LinkedRobot::connect(&servant.hub, &servant.hello()).await;
    let graph = robot.wait_graph(|graph| {
        let has = |topic| find_output(graph, topic).is_some();
        let feeds = graph.inputs.iter().filter(|input| input.topic.starts_with("/count/") && input.feed).count();
        has("/count/goal") && has("/count/cancel") && feeds == 3
    });
    let graph = graph.await;
    let of = count(RosVersion::One);
    let goals = find_output(&graph, "/count/goal").expect("an output");
    assert_eq!((&*goals.type_name, &*goals.md5), ("x_msgs/CountActionGoal", of.action_goal.md5()));
    assert!(robot.definition(&goals.type_name, &goals.md5).is_some());
    // A server of the robot appears.
    let cancels = find_output(&graph, "/count/cancel").expect("an output");
    robot.listen(goals);
    robot.listen(cancels);
    robot.open_input(input_of(&of.action_feedback, 1, "/count/feedback", false));
    robot.open_input(input_of(&of.action_result, 2, "/count/result", false));
    client.wait_for_server(LONG).await.expect("a server");
    let order = serialize(&count(RosVersion::Two).goal, &json!({ "order": 7 }));
    let (events, mut told) = goal_events(RosVersion::Two);
    client.send_goal(UUID, order.clone(), events);
    let (channel, goal) = robot.next_message().await;
    let (id, goal) = messages::read_goal(&goal).expect("a goal");
    assert_eq!((channel, &*id.id), (goals.channel, UUID));
    assert_eq!(parse(&of.goal, &goal), json!({ "order": 7 }));
    let state = |status| {
        let goal = GoalId { id: UUID.to_owned(), ..GoalId::default() };
        GoalState { goal, status, text: String::new() }
    };
    let part = serialize(&of.feedback, &json!({ "part": 3 }));
    robot.publish(1, messages::write_state(Time::default(), &state(ActionlibStatus::Active), &part));
    assert_eq!(next_told(&mut told).await, Ok(3));
    client.cancel_goal(UUID);
    let (channel, cancel) = robot.next_message().await;
    let cancel = messages::read_cancel(&cancel).expect("a cancel");
    assert_eq!((channel, &*cancel.id), (cancels.channel, UUID));
    let sum = serialize(&of.result, &json!({ "sum": 9 }));
    robot.publish(2, messages::write_state(Time::default(), &state(ActionlibStatus::Preempted), &sum));
    assert_eq!(next_told(&mut told).await, Err(GoalOutcome::Canceled));
    // Its goals end with the server.
    let (events, mut told) = goal_events(RosVersion::Two);
    client.send_goal("another", order, events);
    robot.next_message().await;
    robot.session.send_control(&FromRobot::Close { channel: 2 });
    assert_eq!(next_told(&mut told).await, Err(GoalOutcome::Unknown));
}

#[tokio::test]
async fn a_node_of_ros_1_sends_goals_to_a_robot_of_ros_2() {
    let servant = Servant::new(RosVersion::One, None).await;
    let client = servant.node.action_client("/count", &count(RosVersion::One)).expect("a client");
    let mut robot = LinkedRobot::connect(&servant.hub, &servant.hello()).await;
    let feedback = "/count/_action/feedback";
    robot.wait_graph(|graph| graph.inputs.iter().any(|input| input.topic == feedback && input.feed)).await;
    let of = count(RosVersion::Two);
    robot.open_input(input_of(&of.action_feedback, 1, feedback, false));
    // Each part is looked up, and lent.
    let services = of.services.as_ref().expect("of ROS 2");
    let cancel = Registry::for_version(RosVersion::Two).service("action_msgs/srv/CancelGoal").expect("known to all");
    let parts = [("send_goal", &services.send_goal), ("get_result", &services.get_result), ("cancel_goal", &cancel)];
    let mut lent = BTreeSet::new();
    while lent.len() < parts.len() {
        let asked = robot.next_request().await;
        let CloudRequest::Lookup(service) = asked else { panic!("{asked:?}") };
        let (channel, (_, of)) = (1..).zip(parts).find(|(_, (part, _))| service.ends_with(part)).expect("a part");
        robot.send_lent(&service, Some((channel, &ServiceType::from_service(of))));
        lent.insert(service);
    }
    client.wait_for_server(LONG).await.expect("a server");
    let (events, mut told) = goal_events(RosVersion::One);
    client.send_goal(UUID, serialize(&count(RosVersion::One).goal, &json!({ "order": 7 })), events);
    let (call, request) = next_call(&mut robot, 1).await;
    // Behind the head of its format a message begins with the goal's id.
    assert_eq!(request[4..20], [7; 16]);
    assert_eq!(parse(&services.send_goal.request, &request)["goal"], json!({ "order": 7 }));
    let accepted = serialize(&services.send_goal.response, &json!({ "accepted": true }));
    robot.session.answer(call, link::clock::now(), Ok(accepted));
    let (call, request) = next_call(&mut robot, 2).await;
    assert_eq!(request[4..20], [7; 16]);
    let uuid = json!({ "uuid": vec![7; 16] });
    robot.publish(1, serialize(&of.action_feedback, &json!({ "goal_id": uuid, "feedback": { "part": 3 } })));
    assert_eq!(next_told(&mut told).await, Ok(3));
    // Succeeded.
    let result = serialize(&services.get_result.response, &json!({ "status": 4, "result": { "sum": 9 } }));
    robot.session.answer(call, link::clock::now(), Ok(result));
    assert_eq!(next_told(&mut told).await, Ok(9));
}

/// Returns the next call of a service, and its request; lookups in between are repeated ones.
async fn next_call(robot: &mut LinkedRobot, channel: u32) -> (u32, Bytes) {
    loop {
        match robot.next_request().await {
            CloudRequest::Lookup(_) => {}
            CloudRequest::Call(id, called, request) => {
                assert_eq!(called, channel);
                return (id, request);
            }
        }
    }
}

#[tokio::test]
async fn a_node_is_started_in_the_terms_of_its_ros() {
    let servant = Servant::new(RosVersion::One, None).await;
    let mut hello = servant.hello();
    hello.node.argv =
        ["--ros-args", "-r", "image:=/left", "-p", "rate:=2", "--log-level", "debug"].map(str::to_owned).into();
    hello.node.named_by_argv = true;
    hello.parameters.insert("use_sim_time".to_owned(), ParamValue::Bool(true));
    let robot = LinkedRobot::connect(&servant.hub, &hello).await;
    // Its parameters stand at the Master before it starts.
    assert_eq!(servant.nodes.started.lock()[NODE].argv, ["image:=/left"]);
    assert_eq!(servant.bus.parameter("/see/rate").await.expect("a parameter"), ParamValue::Int(2));
    let simulated = servant.bus.parameter("/use_sim_time").await.expect("a parameter");
    assert_eq!(simulated, ParamValue::Bool(true));
    assert_eq!(robot.wait_notice("--log-level debug").await, 1);
}

#[tokio::test]
async fn parameters_of_a_robot_of_ros_1_are_those_of_the_node_of_ros_2() {
    let gain = json!({ "name": "/look/gain", "node": "/look", "descriptor": { "type": "double" } });
    let interface = serde_json::from_value(json!({ "parameters": [gain] })).expect("an interface");
    let servant = Servant::new(RosVersion::Two, Some(interface)).await;
    let mut hello = servant.hello();
    hello.node.argv = vec!["_rate:=2".to_owned()];
    let value = |value: Value| serde_json::from_value::<ParamValue>(value).expect("a value");
    let see = value(json!({ "gain": 1, "gains": { "p": 0.5 }, "boxes": [[1]] }));
    hello.parameters = [("see".to_owned(), see), ("map_frame".to_owned(), value(json!("map")))].into();
    let mut robot = LinkedRobot::connect(&servant.hub, &hello).await;
    // With the type that the push has recorded, and overridden by the command line.
    let expected = "--ros-args -p gain:=1.0 -p gains.p:=0.5 -- --ros-args -p rate:=2 --";
    assert_eq!(servant.nodes.started.lock()[NODE].argv.join(" "), expected);
    assert_eq!(robot.wait_notice("boxes: a list of lists cannot be a ROS 2 parameter").await, 1);
    // The node declares its parameters, and the robot learns what they are.
    let parameters = servant.node.node_parameters().expect("they are offered");
    let declared = [("gain", value(json!(1.0))), ("own", value(json!(true)))];
    let declared = declared.map(|(name, value)| (name.to_owned(), Some(value))).to_vec();
    parameters.set(NODE, declared).await.expect("a node");
    robot.wait_change("/see/gain", Some(&value(json!(1.0)))).await;
    robot.wait_change("/see/own", Some(&value(json!(true)))).await;
    // A change on the robot is set at the node.
    robot.session.send_control(&FromRobot::Parameters(vec![("/see/gain".to_owned(), Some(value(json!(3))))]));
    let mut events = parameters.watch(Some(NODE)).await.expect("events");
    let names = ["gain".to_owned()];
    while parameters.get(NODE, &names).await.expect("a node") != [Some(value(json!(3.0)))] {
        timeout(LONG, events.next()).await.expect("it is set");
    }
    // So it is by a client of dynamic_reconfigure, which is told before.
    let graph = robot.wait_graph(|graph| {
        find_output(graph, "/see/parameter_updates").is_some() && find_service(graph, "/see/set_parameters").is_some()
    });
    let graph = graph.await;
    let (updates, set) = (find_output(&graph, "/see/parameter_updates"), find_service(&graph, "/see/set_parameters"));
    let (updates, set) = (updates.expect("an output"), set.expect("a service"));
    assert_eq!(
        (&*updates.type_name, &*set.type_name),
        ("dynamic_reconfigure/Config", "dynamic_reconfigure/Reconfigure")
    );
    assert!(robot.definition(&updates.type_name, &updates.md5).expect("told").starts_with("BoolParameter[] bools"));
    robot.listen(updates);
    let (channel, told) = robot.next_message().await;
    assert!(channel == updates.channel && has_gain(&told, 3.0), "{told:?}");
    let response = robot.call(set, gain_config(4.0)).await.expect("a response");
    assert!(has_gain(&response, 4.0), "{response:?}");
    assert!(has_gain(&robot.next_message().await.1, 4.0));
    robot.wait_change("/see/gain", Some(&value(json!(4.0)))).await;
}

/// Serializes a dynamic_reconfigure/Config with one double.
fn gain_config(gain: f64) -> Bytes {
    // Bools, integers, texts; one double; groups.
    let counts = |counts: &[u32]| counts.iter().flat_map(|count| count.to_le_bytes()).collect::<Vec<u8>>();
    [counts(&[0, 0, 0, 1]), counts(&[4]), b"gain".to_vec(), gain.to_le_bytes().to_vec(), counts(&[0])].concat().into()
}

/// Returns whether a message contains this gain.
fn has_gain(message: &[u8], gain: f64) -> bool {
    let wanted = [&b"gain"[..], &gain.to_le_bytes()].concat();
    message.windows(wanted.len()).any(|part| part == wanted)
}

#[tokio::test]
async fn a_robot_of_ros_2_has_the_parameter_services_of_a_node_of_ros_1() {
    let servant = Servant::new(RosVersion::One, None).await;
    let alive = WireType::from_message(&string(RosVersion::One));
    let _alive = servant.node.advertise("/alive", alive, QosProfile::keep_last(1)).await.expect("a topic");
    let parameters = servant.bus.parameters().expect("a Master");
    parameters.set("/see/rate", ParamValue::Int(5)).await.expect("a Master");
    let mut robot = LinkedRobot::connect(&servant.hub, &servant.hello()).await;
    let graph = robot.wait_graph(|graph| {
        find_service(graph, "/see/set_parameters").is_some() && find_output(graph, "/parameter_events").is_some()
    });
    let graph = graph.await;
    let events = find_output(&graph, "/parameter_events").expect("an output");
    let of = ros::ros2::interfaces::message("rcl_interfaces/msg/ParameterEvent").expect("a type");
    assert_eq!((&*events.type_name, &*events.md5), (of.name(), of.digest()));
    robot.listen(events);
    let served = find_service(&graph, "/see/set_parameters").expect("a service");
    assert_eq!(served.type_name, "rcl_interfaces/srv/SetParameters");
    // One parameter, the integer 6.
    let mut request = CdrWriter::new();
    request.length(1);
    request.text("rate");
    request.byte(2);
    request.byte(0);
    request.number(6i64.to_le_bytes());
    request.number(0f64.to_le_bytes());
    request.text("");
    (0..5).for_each(|_| request.length(0));
    let response = robot.call(served, request.finish()).await.expect("a response");
    assert_eq!(response[4..9], [1, 0, 0, 0, 1], "one, and successful");
    assert_eq!(parameters.get("/see/rate").await.expect("a parameter"), ParamValue::Int(6));
    // The call has waited until the robot hears what it changes.
    let (channel, event) = robot.next_message().await;
    assert_eq!(channel, events.channel);
    let event = parse(&of, &event);
    assert_eq!((&event["node"], &event["changed_parameters"][0]["name"]), (&json!("/see"), &json!("rate")));
    assert_eq!(event["changed_parameters"][0]["value"]["integer_value"], 6);
}

#[tokio::test]
async fn what_the_robot_cannot_see_is_said_and_a_service_without_anything_else_is_refused() {
    let servant = Servant::new(RosVersion::Two, None).await;
    let unknown = || WireType::with_name("lab_msgs/msg/Brew").with_version(RosVersion::Two);
    let _brew = servant.node.advertise("/brew", unknown(), QosProfile::keep_last(1)).await.expect("a topic");
    let robot = LinkedRobot::connect(&servant.hub, &servant.hello()).await;
    assert_eq!(robot.wait_notice("topic /brew of /see is not on the robot").await, 1);
    let topic = |name: &str, of: &str| json!({ "name": name, "type": of, "direction": "output" });
    let brew = topic("/brew", "lab_msgs/msg/Brew");
    for (topics, refused) in
        [(vec![brew.clone()], true), (vec![brew, topic("/found", "std_msgs/msg/String")], false), (Vec::new(), false)]
    {
        let interface = serde_json::from_value(json!({ "topics": topics })).expect("an interface");
        let servant = Servant::new(RosVersion::Two, Some(interface)).await;
        if refused {
            let (reason, again) = expect_refusal(&servant.hub, &servant.hello()).await;
            assert!(!again && reason.contains("topic /brew: the definition of lab_msgs/msg/Brew"), "{reason}");
            assert!(servant.nodes.started.lock().is_empty());
        } else {
            LinkedRobot::connect(&servant.hub, &servant.hello()).await;
        }
        // Robots of the servant's ROS need no counterparts.
        LinkedRobot::connect(&servant.hub, &robot::hello("/other")).await;
    }
}

#[tokio::test]
async fn one_node_runs_for_robots_of_either_ros() {
    let servant = Servant::new(RosVersion::Two, None).await;
    let _first = LinkedRobot::connect(&servant.hub, &servant.hello()).await;
    // The same machine starts its node anew, in the other ROS.
    let second = Hello { run: "another".to_owned(), ..robot::hello(NODE) };
    let _second = LinkedRobot::connect(&servant.hub, &second).await;
    let links = servant.hub.status();
    assert_eq!(links.iter().map(|link| &*link.node).collect::<Vec<_>>(), [NODE]);
}
