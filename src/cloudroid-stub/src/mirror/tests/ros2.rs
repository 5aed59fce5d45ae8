//! Tests of features that only ROS 2 nodes have: quality of service of each endpoint, and actions that consist of
//! service calls.

use ros::bus::{ActionHandler, GoalEnd, GoalError, GoalEvents, GoalOutcome, QosReliability};
use tokio::sync::mpsc;

use super::*;
use crate::local::OriginalSetup;

#[tokio::test]
async fn ends_have_the_quality_of_service_of_the_node() {
    let scene = Scene::new(RosVersion::Two, "/node").await;
    let weak = QosProfile { reliability: QosReliability::BestEffort, ..QosProfile::keep_last(5) };
    let string = || string_type(RosVersion::Two);
    let scan = scene.real.advertise("/scan", string(), weak).await.unwrap();
    let _command = scene.real.subscribe("/command", string(), weak).await;
    let state = QosProfile::keep_last(1).latching(true);
    let map = scene.real.advertise("/map", string(), state).await.unwrap();
    let _link = scene.connect().await;
    let app = scene.robot.node("/app").await;
    wait_for_graph(&app, "all ends", |graph| {
        let node = graph.ends.get("/node");
        node.is_some_and(|node| node.publishers.len() == 2 && node.subscribers.len() == 1)
    })
    .await;
    let node = app.graph().borrow().ends["/node"].clone();
    let is_weak = |qos: &QosProfile| qos.reliability == QosReliability::BestEffort && !qos.is_latching();
    assert!(is_weak(&node.publishers["/scan"].1), "{node:?}");
    assert!(is_weak(&node.subscribers["/command"].1), "{node:?}");
    let of_map = node.publishers["/map"].1;
    assert!(of_map.is_latching() && of_map.reliability == QosReliability::Reliable);
    // A message published before there was a subscriber is received; the one published while there was none is
    // replaced.
    map.publish(scene.bytes("one"));
    let mut heard = subscribe(&app, "/map").await;
    assert_eq!(next_text(&mut heard).await, "one");
    drop(heard);
    let mut listeners = map.matched_subscribers();
    let left = listeners.wait_for(|now| now.peers.is_empty());
    timeout(SOON, left).await.unwrap().unwrap();
    map.publish(scene.bytes("two"));
    let latecomer = scene.robot.node("/late").await;
    let mut late = subscribe(&latecomer, "/map").await;
    assert_eq!(next_text(&mut late).await, "two");
    drop(scan);
    wait_for_graph(&app, "no scan", |graph| !graph.ends["/node"].publishers.contains_key("/scan")).await;
}

#[tokio::test]
async fn a_late_subscriber_is_given_as_many_messages_as_the_node_keeps() {
    let scene = Scene::new(RosVersion::Two, "/node").await;
    let string = string_type(RosVersion::Two);
    let plans = scene.real.advertise("/plan", string, QosProfile::keep_last(3).latching(true)).await.unwrap();
    for text in ["one", "two", "three", "four"] {
        plans.publish(scene.bytes(text));
    }
    let _link = scene.connect().await;
    let app = scene.robot.node("/app").await;
    wait_for_graph(&app, "the output", |graph| is_published(graph, "/plan")).await;
    // The first makes the cloud subscribe; the second is given what is kept on the robot.
    let mut heard = subscribe(&app, "/plan").await;
    let late = scene.robot.node("/late").await;
    for expected in ["two", "three", "four"] {
        assert_eq!(next_text(&mut heard).await, expected);
    }
    let mut heard_late = subscribe(&late, "/plan").await;
    for expected in ["two", "three", "four"] {
        assert_eq!(next_text(&mut heard_late).await, expected);
    }
    plans.publish(scene.bytes("five"));
    for heard in [&mut heard, &mut heard_late] {
        assert_eq!(next_text(heard).await, "five");
    }
    let later = scene.robot.node("/later").await;
    let mut heard = subscribe(&later, "/plan").await;
    for expected in ["three", "four", "five"] {
        assert_eq!(next_text(&mut heard).await, expected);
    }
}

#[tokio::test]
async fn an_old_message_is_given_to_nobody_who_does_not_request_it() {
    let scene = Scene::new(RosVersion::Two, "/node").await;
    let string = || string_type(RosVersion::Two);
    let state = QosProfile::keep_last(1).latching(true);
    let command = scene.real.advertise("/command", string(), state).await.unwrap();
    command.publish(scene.bytes("old"));
    let _link = scene.connect().await;
    let app = scene.robot.node("/app").await;
    wait_for_graph(&app, "the output", |graph| is_published(graph, "/command")).await;
    let mut heard = app.subscribe("/command", string(), QosProfile::keep_last(5)).await.unwrap();
    let mut listeners = command.matched_subscribers();
    let connected = listeners.wait_for(|now| now.connected_count() > 0);
    timeout(SOON, connected).await.unwrap().unwrap();
    command.publish(scene.bytes("new"));
    assert_eq!(next_text(&mut heard).await, "new");
    // A later subscriber that requests it is given it.
    let late = scene.robot.node("/late").await;
    assert_eq!(next_text(&mut subscribe(&late, "/command").await).await, "new");
}

#[tokio::test]
async fn the_cloud_is_told_with_whom_no_messages_pass() {
    let scene = Scene::new(RosVersion::Two, "/node").await;
    let string = || string_type(RosVersion::Two);
    let qos = QosProfile::keep_last(5);
    let _state = scene.real.advertise("/state", string(), qos).await;
    let _command = scene.real.subscribe("/command", string(), qos).await;
    let _link = scene.connect().await;
    let app = scene.robot.node("/app").await;
    let other = || WireType { name: "std_msgs/msg/Int32".to_owned(), ..string() };
    let state = app.subscribe("/state", other(), qos).await.unwrap();
    let command = app.advertise("/command", other(), qos).await.unwrap();
    let told = async |expected: &[&str]| {
        let refused = || scene.hub.status().remove(0).refused;
        let topics = || -> Vec<String> { refused().into_iter().map(|one| one.topic).collect() };
        let looked = async {
            while topics() != expected {
                tokio::time::sleep(Duration::from_millis(10)).await;
            }
        };
        let came = timeout(SOON, looked).await;
        assert!(came.is_ok(), "not {expected:?}: {:?}", refused());
        refused()
    };
    let refused = told(&["/command", "/state"]).await;
    assert_eq!(refused[1].node, "/app");
    assert!(refused[1].why.contains("its type is std_msgs/msg/Int32"), "{refused:?}");
    drop(command);
    told(&["/state"]).await;
    drop(state);
    told(&[]).await;
}

/// Forwards goals to the test, which ends them.
struct ForwardedGoals(mpsc::UnboundedSender<(String, Bytes)>);

impl ActionHandler for ForwardedGoals {
    fn on_goal(&self, id: &str, goal: Bytes) -> Result<(), FailureReason> {
        let sent = self.0.send((id.to_owned(), goal));
        sent.map_err(|error| FailureReason::new(error.to_string()))
    }
    fn on_cancel(&self, id: &str) {
        let _ = self.0.send((id.to_owned(), Bytes::new()));
    }
    fn on_failed(&self, reason: &str) {
        panic!("{reason}");
    }
}

/// Records the feedback and the outcome of one goal as text.
struct OutcomeLog(mpsc::UnboundedSender<String>);

impl GoalEvents for OutcomeLog {
    fn on_feedback(&self, feedback: Bytes) {
        let _ = self.0.send(format!("at {}", feedback[4]));
    }
    fn on_ended(&self, end: Result<GoalEnd, GoalError>) {
        let end = end.unwrap();
        let number = end.result.get(4).copied().unwrap_or_default();
        let _ = self.0.send(format!("{:?} {number}", end.outcome));
    }
}

fn number(number: u8) -> Bytes {
    vec![0, 1, 0, 0, number, 0, 0, 0].into()
}

#[tokio::test]
async fn goals_go_to_the_cloud_and_what_comes_of_them_comes_back() {
    for promised in [false, true] {
        let scene = Scene::new(RosVersion::Two, "/node").await;
        let registry = Registry::for_version(RosVersion::Two);
        let text = "int32 number\n---\nint32 number\n---\nint32 number\n";
        registry.insert("tests/action/Count", text).unwrap();
        let of = registry.action("tests/action/Count").unwrap();
        if promised {
            let watcher = scene.robot.node("/node_cloudroid").await;
            let diagnostics = Diagnostics::new(&watcher, "/node", "robot").await;
            let sla = serde_json::json!({"t_desire": 50, "t_max": 100, "local": "none"});
            let setting =
                OriginalSetup { program: None, node: "/node".to_owned(), domain: scene.robot.domain(), patience: SOON };
            let sla = QosSla::parse(sla).unwrap();
            let promise = scene.mirror.start_promise(sla, setting, Vec::new(), diagnostics.unwrap(), &watcher);
            promise.await.unwrap();
        }
        let (sender, mut goals) = mpsc::unbounded_channel();
        let handler = Arc::new(ForwardedGoals(sender));
        let server = scene.real.serve_action("/count", &of, handler).unwrap();
        let _link = scene.connect().await;
        let app = scene.robot.node("/app").await;
        let client = app.action_client("/count", &of).unwrap();
        client.wait_for_server(SOON).await.unwrap();
        let (told, mut hears) = mpsc::unbounded_channel();
        let mut hears = async || timeout(SOON, hears.recv()).await.unwrap().unwrap();
        let id = "00112233-4455-6677-8899-aabbccddeeff";
        client.send_goal(id, number(7), Arc::new(OutcomeLog(told.clone())));
        let (taken, goal) = timeout(SOON, goals.recv()).await.unwrap().unwrap();
        assert_eq!((taken.as_str(), &goal), (id, &number(7)));
        assert!(server.publish_feedback(id, number(3)));
        assert_eq!(hears().await, "at 3");
        let end = |outcome, result| GoalEnd { outcome, text: String::new(), result };
        assert!(server.end_goal(id, end(GoalOutcome::Succeeded, number(8))));
        assert_eq!(hears().await, "Succeeded 8");
        // A canceled goal.
        let id = "10112233-4455-6677-8899-aabbccddeeff";
        client.send_goal(id, number(7), Arc::new(OutcomeLog(told)));
        goals.recv().await.unwrap();
        client.cancel_goal(id);
        let (canceled, _) = timeout(SOON, goals.recv()).await.unwrap().unwrap();
        assert!(server.end_goal(&canceled, end(GoalOutcome::Canceled, number(1))));
        assert_eq!(hears().await, "Canceled 1");
        if let Some(keeper) = scene.mirror.keeper() {
            let counts = keeper.report().counts;
            assert_eq!((counts.requests, counts.from_cloud), (2, 2));
        }
    }
}
