//! Nodes that register their complete interface only once they have been given what they wait for.

use bytes::Bytes;
use ros::codec::{self, FillOptions};
use serde_json::json;

use super::*;

const SURROUNDINGS: [(&str, &str); 8] = [
    ("tf2_msgs/msg/TFMessage", "geometry_msgs/TransformStamped[] transforms\n"),
    ("geometry_msgs/msg/TransformStamped", "Header header\nstring child_frame_id\nTransform transform\n"),
    ("geometry_msgs/msg/Transform", "Vector3 translation\nQuaternion rotation\n"),
    ("geometry_msgs/msg/Vector3", "float64 x\nfloat64 y\nfloat64 z\n"),
    ("geometry_msgs/msg/Quaternion", "float64 x\nfloat64 y\nfloat64 z\nfloat64 w\n"),
    ("rosgraph_msgs/msg/Clock", "time clock\n"),
    (
        "rosgraph_msgs/msg/Log",
        "Header header\nbyte level\nstring name\nstring msg\nstring file\nstring function\nuint32 line\n\
         string[] topics\n",
    ),
    ("std_msgs/msg/Empty", ""),
];

async fn new_fixture() -> MasterFixture {
    let mut lab = MasterFixture::new().await;
    lab.definitions.extend(SURROUNDINGS.map(|(key, text)| (key.to_owned(), text.to_owned())));
    lab.registry = Arc::new(Registry::from_definitions(&lab.definitions).expect("valid"));
    lab
}

/// Parts of the fixture for a node in a separate task.
#[derive(Clone)]
struct Node {
    bus: Arc<Ros1Bus>,
    registry: Arc<Registry>,
}

impl Node {
    fn for_fixture(lab: &MasterFixture) -> Self {
        Self { bus: lab.node.clone(), registry: lab.registry.clone() }
    }

    fn wire(&self, name: &str) -> WireType {
        let message = self.registry.message(name).expect("defined");
        WireType::from_message(&message)
    }

    async fn hears(&self, topic: &str, type_name: &str) -> Subscription {
        let wanted = match type_name {
            "*" => WireType::any(),
            name => self.wire(name),
        };
        self.bus.subscribe(topic, wanted, QosProfile::keep_last(10)).await.expect("subscribed")
    }

    async fn tells(&self, topic: &str, wire_type: WireType) -> Box<dyn Publisher> {
        self.bus.advertise(topic, wire_type, QosProfile::keep_last(1)).await.expect("advertised")
    }

    /// Waits until the transforms contain a frame.
    async fn knows(&self, transforms: &mut Subscription, frame: &str) {
        loop {
            let message = transforms.messages.recv().await.expect("told");
            if message.bytes.windows(frame.len()).any(|bytes| bytes == frame.as_bytes()) {
                return;
            }
        }
    }
}

#[tokio::test]
async fn a_node_that_waits_for_transforms_time_a_service_and_a_map_is_seen_whole() {
    let lab = new_fixture().await;
    let node = Node::for_fixture(&lab);
    let base = ros::bus::ParamValue::String("chassis".into());
    lab.node.parameters().expect("offered").set("/package/base_frame", base).await.expect("set");
    let mut transforms = node.hears("/tf", "tf2_msgs/TFMessage").await;
    let waiting = tokio::spawn(async move {
        node.knows(&mut transforms, "chassis").await;
        let mut clock = node.hears("/clock", "rosgraph_msgs/Clock").await;
        clock.messages.recv().await.expect("told");
        // Like waitForService.
        let mut polls = tokio::time::interval(Duration::from_millis(20));
        while node.bus.service_type("/where").await.is_err() {
            polls.tick().await;
        }
        let mut map = node.hears("/map", "std_msgs/String").await;
        map.messages.recv().await.expect("told");
        // A single message, as with wait_for_message.
        drop(map);
        let turn = node.registry.action("lab/Turn").expect("defined");
        // Like move_base, which sends goals to itself.
        let own_goals = node.tells("/turn/goal", node.wire(turn.action_goal.name())).await;
        let goals = node.hears("/turn/goal", turn.action_goal.name()).await;
        let cancel = node.hears("/turn/cancel", "actionlib_msgs/GoalID").await;
        let status = node.tells("/turn/status", node.wire("actionlib_msgs/GoalStatusArray")).await;
        let feedback = node.tells("/turn/feedback", node.wire(turn.action_feedback.name())).await;
        let result = node.tells("/turn/result", node.wire(turn.action_result.name())).await;
        (transforms, own_goals, goals, cancel, status, feedback, result)
    });

    let options = ProbeOptions { settle: Duration::from_millis(400), ..lab.options(&["/package"]) };
    let found = lab.run_probe_with(&options, std::future::pending()).await.expect("found");
    let interface = &found.interface;
    let topics: Vec<_> = interface.topics.iter().map(|topic| (topic.name.as_str(), topic.lazy)).collect();
    assert_eq!(topics, [("/map", true), ("/tf", false)], "{found:?}");
    let actions: Vec<_> = interface.actions.iter().map(|action| action.name.as_str()).collect();
    assert_eq!(actions, ["/turn"]);
    // Not required for a ready servant: it appears with the robot's input.
    assert_eq!(interface.late, ["/turn"]);
    let needs: Vec<_> = interface.needs.iter().map(|need| need.name.as_str()).collect();
    assert_eq!(needs, ["/where"]);
    drop(waiting.await.expect("it got all that it waited for"));
    lab.ends().await;
}

#[tokio::test]
async fn frames_are_heard_in_complaints() {
    let lab = new_fixture().await;
    let node = Node::for_fixture(&lab);
    let mut transforms = node.hears("/tf", "tf2_msgs/TFMessage").await;
    let log = node.tells("/rosout", node.wire("rosgraph_msgs/Log")).await;
    let complaining = tokio::spawn(async move {
        let json = json!({"level": 4, "name": "/package", "msg": "waiting for the transform from spine to hall"});
        let message = node.registry.message("rosgraph_msgs/Log").expect("defined");
        let mut bytes = Vec::new();
        codec::from_json(&message, json.to_string().as_bytes(), &mut bytes, &FillOptions::default()).expect("valid");
        let bytes = Bytes::from(bytes);
        let mut again = tokio::time::interval(Duration::from_millis(30));
        let known = node.knows(&mut transforms, "spine");
        tokio::pin!(known);
        loop {
            tokio::select! {
                () = &mut known => break,
                _ = again.tick() => log.publish(bytes.clone()),
            }
        }
        let wire = node.wire("std_msgs/String");
        (node.tells("/planned", wire).await, log)
    });
    let found = lab.run_probe(&["/package"], std::future::pending()).await.expect("found");
    let planned = found.interface.topics.iter().find(|topic| topic.name == "/planned");
    assert!(planned.is_some_and(|topic| topic.lazy), "{found:?}");
    assert!(
        found
            .warnings
            .iter()
            .any(|warning| warning.contains("/package says: waiting") && warning.contains("--interface")),
        "{:?}",
        found.warnings
    );
    drop(complaining.await);
    lab.ends().await;
}

#[tokio::test]
async fn a_node_that_ends_of_what_it_is_given_is_published_as_it_was_seen() {
    let lab = new_fixture().await;
    let node = Node::for_fixture(&lab);
    let mut fragile = node.hears("/fragile", "std_msgs/String").await;
    let exited = async move {
        fragile.messages.recv().await.expect("told");
        "/package was ended by signal 11".to_owned()
    };
    let found = lab.run_probe(&["/package"], exited).await.expect("found all the same");
    assert_eq!(found.interface.topics[0].name, "/fragile");
    let told = |warning: &String| warning.contains("signal 11") && warning.contains("--interface");
    assert!(found.warnings.iter().any(told), "{:?}", found.warnings);
    lab.ends().await;
}

#[tokio::test]
async fn a_relay_has_the_type_that_is_stated_or_any() {
    for stated in [None, Some("std_msgs/String")] {
        let lab = new_fixture().await;
        let node = Node::for_fixture(&lab);
        let mut heard = node.hears("/in", "*").await;
        let relaying = tokio::spawn(async move {
            let message = heard.messages.recv().await.expect("told");
            (node.tells("/out", WireType::clone(&message.wire_type)).await, heard)
        });
        let types = stated.map(|of| ("/in".to_owned(), of.to_owned()));
        let options = ProbeOptions { types: types.into_iter().collect(), ..lab.options(&["/package"]) };
        let found = lab.run_probe_with(&options, std::future::pending()).await.expect("found");
        let topics: Vec<_> =
            found.interface.topics.iter().map(|topic| (topic.name.as_str(), topic.type_name.as_str())).collect();
        let of = stated.unwrap_or("*");
        assert_eq!(topics, [("/in", of), ("/out", of)], "{found:?}");
        let told = |warning: &String| warning.contains("/in, /out") && warning.contains("--interface");
        assert_eq!(found.warnings.iter().any(told), stated.is_none(), "{:?}", found.warnings);
        drop(relaying.await);
        lab.ends().await;
    }
}

#[tokio::test]
async fn an_interface_without_anything_in_it_is_told() {
    let lab = new_fixture().await;
    let _log = lab.advertises("/rosout", lab.wire("rosgraph_msgs/Log"), false).await;
    let found = lab.run_probe(&["/package"], std::future::pending()).await.expect("found");
    let told = |warning: &String| {
        warning.starts_with("no topic, service or action of /package") && warning.contains("--interface")
    };
    assert!(found.warnings.iter().any(told), "{:?}", found.warnings);
    lab.ends().await;
}

#[tokio::test]
async fn outputs_that_carry_the_stamp_of_an_input_answer_it() {
    let lab = new_fixture().await;
    let node = Node::for_fixture(&lab);
    let stamped = "geometry_msgs/TransformStamped";
    let _switch = node.hears("/a_switch", "std_msgs/Empty").await;
    let _unanswered = node.hears("/another", stamped).await;
    let mut images = node.hears("/image", stamped).await;
    let boxes = node.tells("/boxes", node.wire(stamped)).await;
    let beat = node.tells("/beat", node.wire(stamped)).await;
    let answering = tokio::spawn(async move {
        while let Some(image) = images.messages.recv().await {
            boxes.publish(image.bytes);
            // Also stamped, but with a time of its own.
            beat.publish(bytes::Bytes::from_static(&[7; 200]));
        }
    });
    let found = lab.run_probe(&["/package"], std::future::pending()).await;
    let watched = found.expect("found").watched;
    let expected = ObservedAnswer { input: "/image".to_owned(), output: "/boxes".to_owned() };
    assert_eq!(watched, BTreeSet::from([expected]));
    answering.abort();
    lab.ends().await;
}
