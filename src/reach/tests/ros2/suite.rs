//! The cases of rosbridge_suite's own tests of its WebSocket, with nodes of rclpy: what its clients rely on, to the
//! letter of its messages. Each case has the name of its file there.

use std::time::Duration;

use serde_json::{Value, json};
use tokio::task::JoinHandle;
use tokio::time::timeout;
use tokio_tungstenite::tungstenite::protocol::Message;

use super::lab::{LONG, Lab, Peer};
use super::rosbridge::{BridgedServant, RosbridgeFormat, RosbridgeRobot};

const SERVICE: &str = "/test_service";
/// Interval at which what may be lost is repeated.
const AGAIN: Duration = Duration::from_millis(200);

/// The node of `suite.py`, and a bridge.
struct Suite {
    node: Peer,
    servant: BridgedServant,
}

impl Suite {
    async fn start(lab: &Lab) -> Self {
        Self { node: lab.node("suite.py", &[]).await, servant: BridgedServant::start(lab).await }
    }

    async fn robot(&self) -> RosbridgeRobot {
        self.servant.robot(RosbridgeFormat::Json).await
    }

    /// Waits until the node sees so many publishers of a topic.
    async fn wait_for_publishers(&mut self, topic: &str, count: usize) {
        let seen = timeout(LONG, async {
            while self.node.obey(&format!("publishers {topic}")).await != [json!(count)] {
                tokio::time::sleep(Duration::from_millis(10)).await;
            }
        });
        seen.await.unwrap_or_else(|_| panic!("{topic} should have {count} publishers"));
    }

    /// Waits until the node has seen everything that this robot has asked for so far.
    async fn wait_until_seen(&mut self, robot: &mut RosbridgeRobot, marker: &str) {
        robot.send(json!({"op": "advertise", "topic": marker, "type": "std_msgs/String"})).await;
        self.wait_for_publishers(marker, 1).await;
    }
}

/// Returns the publication of a String as a client receives it.
fn publication(topic: &str, text: &str) -> Value {
    json!({"op": "publish", "topic": topic, "msg": {"data": text}})
}

fn subscription(topic: &str) -> Value {
    json!({"op": "subscribe", "topic": topic, "type": "std_msgs/String"})
}

fn advertisement(topic: &str) -> Value {
    json!({"op": "advertise", "topic": topic, "type": "std_msgs/String"})
}

/// Adds an id to an operation.
fn with_id(mut op: Value, id: &str) -> Value {
    op["id"] = id.into();
    op
}

/// Starts a bridge with a client that serves the action, and a node that has found it.
async fn advertise_fibonacci(lab: &Lab) -> (RosbridgeRobot, Peer) {
    let servant = BridgedServant::start(lab).await;
    let mut robot = servant.robot(RosbridgeFormat::Json).await;
    robot.send(json!({"op": "advertise_action", "action": "/fib", "type": "test_msgs/Fibonacci"})).await;
    let mut client = lab.node("fibonacci.py", &["client"]).await;
    assert_eq!(client.obey("there").await, [json!(true)]);
    (robot, client)
}

/// Receives the next goal, which must be this one.
async fn receive_goal(robot: &mut RosbridgeRobot, order: i32) -> Value {
    let goal = robot.receive("send_action_goal").await;
    assert_eq!((&goal["action"], &goal["args"]), (&json!("/fib"), &json!({"order": order})));
    // As it was advertised.
    assert_eq!(goal["action_type"], "test_msgs/Fibonacci");
    goal
}

fn success_result(goal: &Value, sequence: &[i32]) -> Value {
    json!({"op": "action_result", "action": "/fib", "id": goal["id"], "values": {"sequence": sequence}, "status": 4,
        "result": true})
}

#[tokio::test]
async fn advertise_action() {
    let lab = Lab::new();
    let (mut robot, mut client) = advertise_fibonacci(&lab).await;
    client.tell("goal 3").await;
    client.tell("goal 5").await;
    let goals = [receive_goal(&mut robot, 3).await, receive_goal(&mut robot, 5).await];
    let results: [&[i32]; 2] = [&[0, 1, 1, 2], &[0, 1, 1, 2, 3, 5]];
    for (goal, sequence) in goals.iter().zip(results) {
        robot.send(success_result(goal, sequence)).await;
    }
    let mut ended = [client.wait_for("ended").await, client.wait_for("ended").await];
    ended.sort_by_key(|end| end[1].to_string().len());
    for (end, sequence) in ended.iter().zip(results) {
        assert_eq!(*end, [json!(4), json!(sequence)]);
    }
}

#[tokio::test]
async fn advertise_action_feedback() {
    let lab = Lab::new();
    let (mut robot, mut client) = advertise_fibonacci(&lab).await;
    client.tell("goal 5").await;
    let goal = receive_goal(&mut robot, 5).await;
    let feedback = json!({"op": "action_feedback", "action": "/fib", "id": goal["id"],
        "values": {"sequence": [0, 1, 1, 2]}});
    robot.send(feedback).await;
    robot.send(success_result(&goal, &[0, 1, 1, 2, 3, 5])).await;
    let [fed, ended] = client.wait_for_each(["feedback", "ended"]).await;
    assert_eq!(fed, [json!([0, 1, 1, 2])]);
    assert_eq!(ended, [json!(4), json!([0, 1, 1, 2, 3, 5])]);
}

#[tokio::test]
async fn advertise_publish() {
    let lab = Lab::new();
    let mut suite = Suite::start(&lab).await;
    let mut robot = suite.robot().await;
    robot.send(advertisement("/one")).await;
    suite.wait_for_publishers("/one", 1).await;
    robot.send(json!({"op": "unadvertise", "topic": "/one"})).await;
    suite.wait_for_publishers("/one", 0).await;

    // Each id counts, and without one all of them are meant.
    for id in ["a", "b"] {
        robot.send(with_id(advertisement("/two"), id)).await;
    }
    suite.wait_for_publishers("/two", 1).await;
    robot.send(json!({"op": "unadvertise", "topic": "/two", "id": "a"})).await;
    suite.wait_until_seen(&mut robot, "/marker").await;
    suite.wait_for_publishers("/two", 1).await;
    robot.send(json!({"op": "unadvertise", "topic": "/two", "id": "b"})).await;
    suite.wait_for_publishers("/two", 0).await;
    for id in ["a", "b"] {
        robot.send(with_id(advertisement("/two"), id)).await;
    }
    suite.wait_for_publishers("/two", 1).await;
    robot.send(json!({"op": "unadvertise", "topic": "/two"})).await;
    suite.wait_for_publishers("/two", 0).await;

    // A message advertises its topic, under its own id.
    let mut publish = publication("/three", "hello");
    publish["type"] = "std_msgs/String".into();
    robot.send(with_id(publish.clone(), "message")).await;
    suite.wait_for_publishers("/three", 1).await;
    robot.send(json!({"op": "unadvertise", "topic": "/three", "id": "message"})).await;
    suite.wait_for_publishers("/three", 0).await;

    // Nothing is left of a client that leaves.
    robot.send(publish).await;
    robot.send(advertisement("/one")).await;
    for topic in ["/one", "/three"] {
        suite.wait_for_publishers(topic, 1).await;
    }
    drop(robot);
    for topic in ["/one", "/three", "/marker"] {
        suite.wait_for_publishers(topic, 0).await;
    }
}

/// Advertises the service and waits until it is served.
async fn advertise_set_bool(robot: &mut RosbridgeRobot) {
    robot.send(json!({"op": "set_level", "level": "info"})).await;
    robot.send(json!({"op": "advertise_service", "service": SERVICE, "type": "std_srvs/SetBool"})).await;
    let told = robot.receive("status").await;
    assert_eq!(told["msg"], format!("advertise_service: advertised {SERVICE}"));
}

fn response(id: &Value, message: &str) -> Value {
    json!({"op": "service_response", "service": SERVICE, "id": id, "result": true,
        "values": {"success": true, "message": message}})
}

#[tokio::test]
async fn advertise_service() {
    let lab = Lab::new();
    let mut suite = Suite::start(&lab).await;
    let mut robot = suite.robot().await;
    advertise_set_bool(&mut robot).await;
    assert_eq!(suite.node.obey("served").await, [json!(true)]);
    // Twenty times, because the order is what matters.
    for _ in 0..20 {
        for data in [true, false] {
            suite.node.tell(&format!("ask {data}")).await;
        }
        let asked = [robot.receive("call_service").await, robot.receive("call_service").await];
        for (asked, (data, message)) in asked.iter().zip([(true, "one"), (false, "two")]) {
            assert_eq!((&asked["service"], &asked["args"]), (&json!(SERVICE), &json!({"data": data})));
            robot.send(response(&asked["id"], message)).await;
        }
        let mut answers = [suite.node.wait_for("answer").await, suite.node.wait_for("answer").await];
        answers.sort_by_key(|answer| answer[1].to_string());
        assert_eq!(answers, [[json!(true), json!("one")], [json!(true), json!("two")]]);
    }
}

#[tokio::test]
async fn advertise_service_duplicate() {
    let lab = Lab::new();
    let mut suite = Suite::start(&lab).await;
    let call = |data: bool| {
        json!({"op": "call_service", "service": SERVICE, "id": "service_request:/test_service:1",
            "args": {"data": data}})
    };
    let mut first = suite.robot().await;
    advertise_set_bool(&mut first).await;
    assert_eq!(suite.node.obey("served").await, [json!(true)]);
    suite.node.tell("ask true").await;
    assert_eq!(first.receive("call_service").await, call(true));
    // It leaves without an answer, and another one takes its place.
    drop(first);
    let mut second = suite.robot().await;
    advertise_set_bool(&mut second).await;
    // The node discovers it a moment later.
    let asked = timeout(LONG, async {
        loop {
            suite.node.tell("ask false").await;
            if let Ok(asked) = timeout(AGAIN, second.receive("call_service")).await {
                return asked;
            }
        }
    });
    let asked = asked.await.expect("the second client should be asked");
    assert_eq!(asked, call(false));
    second.send(response(&asked["id"], "by the second")).await;
    assert_eq!(suite.node.wait_for("answer").await, [json!(true), json!("by the second")]);
}

#[tokio::test]
async fn best_effort_publisher() {
    let lab = Lab::new();
    let mut suite = Suite::start(&lab).await;
    suite.node.tell("repeat /a_topic hello").await;
    let mut robot = suite.robot().await;
    robot.send(subscription("/a_topic")).await;
    assert_eq!(robot.receive("publish").await, publication("/a_topic", "hello"));
}

#[tokio::test]
async fn call_service() {
    let lab = Lab::new();
    let suite = Suite::start(&lab).await;
    let mut robot = suite.robot().await;
    suite.servant.wait_graph(|graph| ["/hello", "/slow"].iter().all(|one| graph.services.contains_key(*one))).await;
    let call = |service: &str, seconds: f64| {
        json!({"op": "call_service", "service": service, "type": "std_srvs/SetBool", "args": {"data": true},
            "timeout": seconds})
    };
    let answered = |service: &str| {
        json!({"op": "service_response", "service": service, "result": true,
            "values": {"success": true, "message": "Hello, world!"}})
    };
    robot.send(call("/hello", LONG.as_secs_f64())).await;
    assert_eq!(robot.receive("service_response").await, answered("/hello"));
    // It takes 0.2 s.
    robot.send(call("/slow", 0.1)).await;
    robot.send(call("/slow", LONG.as_secs_f64())).await;
    assert_eq!(
        robot.receive("service_response").await,
        json!({"op": "service_response", "service": "/slow", "result": false,
            "values": "Timeout exceeded while waiting for service response"})
    );
    assert_eq!(robot.receive("service_response").await, answered("/slow"));
}

#[tokio::test]
async fn event_loop_starvation() {
    let lab = Lab::new();
    let mut suite = Suite::start(&lab).await;
    suite.node.tell("load").await;
    // It takes what it can of 30 MB/s.
    let mut loaded = suite.robot().await;
    for number in 0..20 {
        let subscribe = json!({"op": "subscribe", "topic": format!("/load_{number}"),
            "type": "std_msgs/msg/Float64MultiArray"});
        loaded.send(subscribe).await;
    }
    loaded.receive("publish").await;
    let loaded: JoinHandle<()> = tokio::spawn(async move {
        loop {
            loaded.next_frame("a message").await;
        }
    });
    let mut robot = suite.robot().await;
    robot.send(subscription("/probe")).await;
    let mut last = None;
    for _ in 0..20 {
        let heard = robot.receive("publish").await;
        let number: u32 = heard["msg"]["data"].as_str().expect("a text").parse().expect("a number");
        assert!(last.is_none_or(|last| number == last + 1), "{number} after {last:?}");
        last = Some(number);
    }
    assert!(!loaded.is_finished());
    loaded.abort();
}

#[tokio::test]
async fn multiple_subscribers() {
    let lab = Lab::new();
    let mut suite = Suite::start(&lab).await;
    let mut robots = [suite.robot().await, suite.robot().await];
    // The topic does not exist yet.
    for robot in &mut robots {
        robot.send(subscription("/a_topic")).await;
    }
    suite.node.tell("tell /a_topic hello").await;
    for robot in &mut robots {
        assert_eq!(robot.receive("publish").await, publication("/a_topic", "hello"));
    }
}

#[tokio::test]
async fn multiple_subscribers_raw() {
    let lab = Lab::new();
    let mut suite = Suite::start(&lab).await;
    let mut robots = [suite.robot().await, suite.robot().await];
    for robot in &mut robots {
        let mut subscribe = subscription("/a_topic");
        subscribe["compression"] = "cbor-raw".into();
        robot.send(subscribe).await;
    }
    suite.node.tell("tell /a_topic hello").await;
    for robot in &mut robots {
        let Message::Binary(frame) = robot.next_frame("the message").await else {
            panic!("it should be CBOR");
        };
        assert!(frame.windows(5).any(|part| part == b"hello"), "{frame:?}");
    }
}

#[tokio::test]
async fn send_action_goal() {
    let lab = Lab::new();
    let _server = lab.node("fibonacci.py", &["server"]).await;
    let servant = BridgedServant::start(&lab).await;
    let mut robot = servant.robot(RosbridgeFormat::Json).await;
    robot
        .send(json!({"op": "send_action_goal", "action": "/fib", "action_type": "test_msgs/Fibonacci",
            "args": {"order": 5}, "feedback": true}))
        .await;
    let whole = [0, 1, 1, 2, 3, 5];
    for length in 3..=6 {
        let told = robot.receive("action_feedback").await;
        assert_eq!(told["values"]["sequence"], json!(whole[..length]));
    }
    assert_eq!(
        robot.receive("action_result").await,
        json!({"op": "action_result", "action": "/fib", "values": {"sequence": whole}, "status": 4, "result": true})
    );
}

#[tokio::test]
async fn smoke() {
    const COUNT: usize = 10;
    let lab = Lab::new();
    let mut suite = Suite::start(&lab).await;
    let mut robot = suite.robot().await;
    suite.node.tell("hear /a_topic").await;
    let is_heard = |graph: &ros::bus::Graph| graph.topics.get("/a_topic").is_some_and(|a| !a.subscribers.is_empty());
    suite.servant.wait_graph(is_heard).await;
    let mut subscribe = subscription("/b_topic");
    subscribe["queue_length"] = 0.into();
    robot.send(subscribe).await;
    robot.send(advertisement("/a_topic")).await;
    for _ in 0..COUNT {
        robot.send(publication("/a_topic", "AAAAAAAAAA")).await;
    }
    suite.node.tell(&format!("tell /b_topic BBBBBBBBBB {COUNT}")).await;
    for _ in 0..COUNT {
        assert_eq!(robot.receive("publish").await, publication("/b_topic", "BBBBBBBBBB"));
        assert_eq!(suite.node.wait_for("heard").await, [json!("AAAAAAAAAA")]);
    }
}

#[tokio::test]
async fn transient_local_publisher() {
    let lab = Lab::new();
    let mut suite = Suite::start(&lab).await;
    suite.node.tell("keep /a_topic hello").await;
    let mut robots = Vec::new();
    for _ in 0..3 {
        let mut robot = suite.robot().await;
        robot.send(subscription("/a_topic")).await;
        assert_eq!(robot.receive("publish").await, publication("/a_topic", "hello"));
        robots.push(robot);
    }
}
