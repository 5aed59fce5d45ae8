//! ROS 2 nodes in memory.

use std::sync::atomic::{AtomicU8, Ordering};

use bytes::Bytes;
use package::interface::{Durability, Reliability};
use ros::bus::{ParamValue, QosReliability as OnBus, RosVersion};
use ros::codec::{FillOptions, JsonOptions, from_json, to_json};
use serde_json::{Value, json};

use super::memory_bus::{MemoryBus, MemorySystem};
use super::*;

const DEFINITIONS: [(&str, &str); 8] = [
    ("std_msgs/msg/String", "string data\n"),
    ("lab/msg/Seen", "Where[] at\n"),
    ("lab/msg/Where", "float64 x\n"),
    ("lab/srv/Look", "---\nWhere at\n"),
    ("lab/action/Turn", "Where to\n---\nbool done\n---\nfloat64 left\n"),
    ("lifecycle_msgs/msg/State", "uint8 id\nstring label\n"),
    ("lifecycle_msgs/srv/ChangeState", "Transition transition\n---\nbool success\n"),
    ("lifecycle_msgs/srv/GetState", "---\nState current_state\n"),
];

/// Definitions of an image, and a system whose nodes report only digests.
struct Ros2System {
    definitions: BTreeMap<String, String>,
    registry: Arc<Registry>,
    system: Arc<MemorySystem>,
}

impl Ros2System {
    fn new() -> Self {
        let transition = ("lifecycle_msgs/msg/Transition", "uint8 id\nstring label\n");
        let all = DEFINITIONS.into_iter().chain([transition]);
        let definitions = all.map(|(key, text)| (key.to_owned(), text.to_owned()));
        let definitions: BTreeMap<String, String> = definitions.collect();
        let registry = Registry::with_definitions(RosVersion::Two, &definitions).expect("valid");
        Self { definitions, registry: Arc::new(registry), system: Arc::default() }
    }

    fn wire(&self, name: &str) -> WireType {
        WireType::from_message(&self.registry.message(name).expect("defined"))
    }

    fn service(&self, name: &str) -> ServiceType {
        ServiceType::from_service(&self.registry.service(name).expect("defined"))
    }

    async fn run_probe(&self, nodes: &[&str]) -> Result<ProbeResult, ProbeError> {
        let nodes = nodes.iter().map(|&node| node.to_owned()).collect();
        let options = ProbeOptions {
            patience: Duration::from_secs(5),
            settle: Duration::from_millis(50),
            restless: Duration::from_secs(4),
            ..ProbeOptions::new(nodes, "/looker")
        };
        let bus: Arc<dyn Bus> = self.system.join("/looker");
        let never = std::future::pending();
        probe(&bus, &self.registry, &self.definitions, &options, never).await
    }
}

/// Handler that always answers with zeros.
struct Zeros;

#[async_trait::async_trait]
impl ServiceHandler for Zeros {
    async fn call(&self, _request: Bytes, _caller: &str) -> Result<Bytes, FailureReason> {
        Ok(Bytes::from_static(&[0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]))
    }
}

#[tokio::test]
async fn qualities_and_parameters_are_found_and_what_every_node_has_is_hidden() {
    let two = Ros2System::new();
    let node = two.system.join_demanding("/see");
    let seen = two.wire("lab/msg/Seen");
    let weak = QosProfile { reliability: OnBus::BestEffort, ..QosProfile::keep_last(1) };
    let _out = node.advertise("/seen", seen.clone(), weak).await.expect("a topic");
    let latched = QosProfile::keep_last(1).latching(true);
    let string = two.wire("std_msgs/msg/String");
    let mut input = node.subscribe("/map", string.clone(), latched).await.expect("a topic");
    let _map = node.advertise("/state", string.clone(), latched).await.expect("a topic");
    let _log = node.advertise("/parameter_events", string, latched).await.expect("a topic");
    let zeros = || Arc::new(Zeros);
    let _look = node.serve("/look", two.service("lab/srv/Look"), zeros()).await.expect("served");
    let _own = node.serve("/see/get_parameters", two.service("lab/srv/Look"), zeros()).await;
    let _needs = node.seek("/where", two.service("lab/srv/Look"));
    let turn = two.registry.action("lab/action/Turn").expect("defined");
    let _turns = node.action_client("/turn", &turn).expect("a client");
    let set = [("rate", 2.5.into()), ("use_sim_time", false.into()), ("camera.id", "x".into())];
    let parameters = node.node_parameters().expect("offered");
    let set = set.map(|(name, value): (&str, Value)| {
        let value: ParamValue = serde_json::from_value(value).expect("a value");
        (name.to_owned(), Some(value))
    });
    parameters.set("/see", set.into()).await.expect("set");

    let found = two.run_probe(&["/see"]).await.expect("found");
    let interface = found.interface;
    let topic = |name: &str| {
        let mut topics = interface.topics.iter();
        topics.find(|topic| topic.name == name).expect(name)
    };
    let names: Vec<&str> = interface.topics.iter().map(|it| it.name.as_str()).collect();
    assert_eq!(names, ["/map", "/seen", "/state"]);
    let qos = topic("/seen").qos.expect("told");
    assert_eq!((qos.reliability, qos.durability), (Reliability::BestEffort, Durability::Volatile));
    assert!(!topic("/seen").latched && topic("/state").latched);
    assert_eq!(topic("/seen").type_name, "lab/msg/Seen");
    assert_eq!(topic("/seen").md5, seen.digest.to_string());
    let asked = topic("/map").qos.expect("told");
    assert_eq!(asked.durability, Durability::TransientLocal);
    // It requests a latched message and got it.
    assert!(input.messages.try_recv().is_some(), "{:?}", found.warnings);
    let services: Vec<&str> = interface.services.iter().map(|it| it.name.as_str()).collect();
    assert_eq!(services, ["/look"]);
    assert!(interface.services[0].md5.starts_with("RIHS01_"));
    let needs: Vec<_> = interface.needs.iter().map(|need| (&*need.name, need.nodes.len())).collect();
    assert_eq!(needs, [("/turn", 1), ("/where", 1)]);
    let shown: Vec<_> = interface.parameters.iter().map(|it| (&*it.name, it.own_name(), it.value.clone())).collect();
    assert_eq!(
        shown,
        [("/see/camera.id", Some("camera.id"), Some(json!("x"))), ("/see/rate", Some("rate"), Some(json!(2.5))),]
    );
    let said = interface.parameters[1].descriptor.as_ref().expect("told");
    assert_eq!((&*said.kind, &*said.description), ("double", "rate of /see"));
    let keys: Vec<&str> = interface.definitions.keys().map(String::as_str).collect();
    assert_eq!(keys, ["lab/msg/Seen", "lab/msg/Where", "lab/srv/Look", "std_msgs/msg/String"]);
}

/// A lifecycle node as in rclcpp: configured, then activated, which starts its work; `refuses` is the transition that
/// fails, or what it does while nobody subscribes to its output: [`REFUSES_UNHEARD`] or [`WAITS_UNHEARD`].
struct Stages {
    registry: Arc<Registry>,
    node: Arc<MemoryBus>,
    refuses: &'static str,
    state: AtomicU8,
    working: Mutex<Option<Box<dyn Publisher>>>,
}

impl Stages {
    fn state(&self) -> Value {
        let state = self.state.load(Ordering::SeqCst);
        let labels = ["unknown", "unconfigured", "inactive", "active"];
        json!({"current_state": {"id": state, "label": labels[usize::from(state)]}})
    }

    async fn change(&self, label: &str) -> bool {
        let state = self.state.load(Ordering::SeqCst);
        let fits = matches!((label, state), ("configure", 1) | ("activate", 2));
        if !fits || label == self.refuses {
            return false;
        }
        let begins_to_publish = match self.refuses {
            REFUSES_UNHEARD | WAITS_UNHEARD => "configure",
            _ => "activate",
        };
        if label == "activate" && !self.is_heard().await {
            return false;
        }
        self.state.store(state + 1, Ordering::SeqCst);
        if label == begins_to_publish {
            let of = WireType::from_message(&self.registry.message("std_msgs/msg/String").expect("defined"));
            let publisher = self.node.advertise("/driven", of, QosProfile::keep_last(1)).await;
            *self.working.lock() = Some(publisher.expect("advertised"));
        }
        true
    }

    /// Returns whether somebody subscribes to its output, if that matters to it.
    async fn is_heard(&self) -> bool {
        let subscribers = self.working.lock().as_ref().map(|publisher| publisher.matched_subscribers());
        let Some(mut subscribers) = subscribers else {
            return true;
        };
        if self.refuses == WAITS_UNHEARD {
            let heard = subscribers.wait_for(|matched| matched.connected_count() > 0).await;
            return heard.is_ok();
        }
        let count = subscribers.borrow().connected_count();
        count > 0
    }
}

const REFUSES_UNHEARD: &str = "refuses while nobody subscribes";
const WAITS_UNHEARD: &str = "waits while nobody subscribes";

/// One of its lifecycle services.
struct Stage(Arc<Stages>, &'static str);

#[async_trait::async_trait]
impl ServiceHandler for Stage {
    async fn call(&self, request: Bytes, _caller: &str) -> Result<Bytes, FailureReason> {
        let Self(stages, name) = self;
        let of = stages.registry.service(name).expect("defined");
        let mut text = Vec::new();
        to_json(&of.request, &request, &mut text, &JsonOptions::default()).expect("a request");
        let asked: Value = serde_json::from_slice(&text).expect("JSON");
        let answer = match asked["transition"]["label"].as_str() {
            Some(label) => json!({"success": stages.change(label).await}),
            None => stages.state(),
        };
        let mut bytes = Vec::new();
        let text = answer.to_string();
        from_json(&of.response, text.as_bytes(), &mut bytes, &FillOptions::default()).expect("fits");
        Ok(bytes.into())
    }
}

/// Starts a lifecycle node in this state; the returned guard keeps its services alive.
async fn start_lifecycle_node(two: &Ros2System, refuses: &'static str, state: u8) -> (Arc<Stages>, impl Sized) {
    let node = two.system.join("/drive");
    let stages = Arc::new(Stages {
        registry: Arc::clone(&two.registry),
        node: Arc::clone(&node),
        refuses,
        state: state.into(),
        working: Mutex::default(),
    });
    let mut served = Vec::new();
    for (service, of) in
        [("/drive/change_state", "lifecycle_msgs/srv/ChangeState"), ("/drive/get_state", "lifecycle_msgs/srv/GetState")]
    {
        let handler = Arc::new(Stage(Arc::clone(&stages), of));
        let serving = node.serve(service, two.service(of), handler).await;
        served.push(serving.expect("served"));
    }
    (stages, served)
}

#[tokio::test]
async fn a_node_with_a_lifecycle_is_activated_and_its_services_are_its_lifecycle() {
    let two = Ros2System::new();
    let (stages, _served) = start_lifecycle_node(&two, "", 1).await;
    let interface = two.run_probe(&["/drive"]).await.expect("found").interface;
    assert_eq!(stages.state()["current_state"]["label"], "active");
    assert_eq!(interface.lifecycle, ["/drive"]);
    assert_eq!(interface.services, []);
    let topics: Vec<&str> = interface.topics.iter().map(|it| it.name.as_str()).collect();
    assert_eq!(topics, ["/driven"], "it publishes once it is active");
}

#[tokio::test]
async fn a_node_that_activates_for_subscribers_only_is_activated() {
    for refuses in [REFUSES_UNHEARD, WAITS_UNHEARD] {
        let two = Ros2System::new();
        let (stages, _served) = start_lifecycle_node(&two, refuses, 1).await;
        let found = two.run_probe(&["/drive"]).await.unwrap_or_else(|error| panic!("it {refuses}: {error}"));
        assert_eq!(stages.state()["current_state"]["label"], "active", "{refuses}");
        let topics: Vec<&str> = found.interface.topics.iter().map(|it| it.name.as_str()).collect();
        assert_eq!(topics, ["/driven"], "{refuses}");
    }
}

#[tokio::test]
async fn a_node_that_does_not_activate_is_named_with_the_transition() {
    for (refuses, words) in [
        ("configure", "/drive does not configure: /drive did not configure, and is unconfigured now"),
        ("activate", "/drive does not activate: /drive did not activate, and is inactive now"),
    ] {
        let two = Ros2System::new();
        let (_stages, _served) = start_lifecycle_node(&two, refuses, 1).await;
        let error = two.run_probe(&["/drive"]).await.expect_err("refused").to_string();
        assert!(error.contains(words), "{error}");
    }
}

#[tokio::test]
async fn a_node_that_somebody_drives_is_left_to_it() {
    let two = Ros2System::new();
    let (stages, _served) = start_lifecycle_node(&two, "", 1).await;
    let manager = two.system.join("/manager");
    let _drives = manager.seek("/drive/change_state", two.service("lifecycle_msgs/srv/ChangeState"));
    let found = two.run_probe(&["/drive"]).await.expect("found");
    assert_eq!(stages.state()["current_state"]["label"], "unconfigured");
    assert_eq!(found.interface.lifecycle, ["/drive"]);

    let two = Ros2System::new();
    let (stages, _served) = start_lifecycle_node(&two, "", 2).await;
    let found = two.run_probe(&["/drive"]).await.expect("found");
    assert_eq!(stages.state()["current_state"]["label"], "inactive");
    let told = found.warnings.iter().any(|it| it.contains("/drive was inactive"));
    assert!(told, "{:?}", found.warnings);
}

#[tokio::test]
async fn actions_bring_the_definitions_that_their_parts_refer_to() {
    struct Nothing;
    impl ros::bus::ActionHandler for Nothing {
        fn on_goal(&self, _id: &str, _goal: Bytes) -> Result<(), FailureReason> {
            Ok(())
        }
        fn on_cancel(&self, _id: &str) {}
        fn on_failed(&self, reason: &str) {
            panic!("{reason}");
        }
    }
    let two = Ros2System::new();
    let node = two.system.join("/see");
    let turn = two.registry.action("lab/action/Turn").expect("defined");
    let _served = node.serve_action("/turn", &turn, Arc::new(Nothing)).expect("served");
    let interface = two.run_probe(&["/see"]).await.expect("found").interface;
    let actions: Vec<_> = interface.actions.iter().map(|it| (&*it.name, &*it.type_name)).collect();
    assert_eq!(actions, [("/turn", "lab/action/Turn")]);
    let keys: Vec<&str> = interface.definitions.keys().map(String::as_str).collect();
    assert_eq!(keys, ["lab/action/Turn", "lab/msg/Where"]);
}
