//! Rosbridge sessions with nodes of rclpy. Each test runs twice, with a robot that uses JSON and one that uses CBOR.

use std::sync::Arc;

use bridge::{Bridge, BridgeOptions, SessionOptions};
use futures_util::{SinkExt as _, StreamExt as _};
use ros::bus::{Graph, RosVersion};
use ros::ros2::Ros2Bus;
use ros::schema::Registry;
use serde_json::{Value, json};
use tokio::io::DuplexStream;
use tokio::time::timeout;
use tokio_tungstenite::WebSocketStream;
use tokio_tungstenite::tungstenite::protocol::{Message, Role};

use super::lab::{LONG, Lab, wait_graph};

const DEFINITIONS: [(&str, &str); 9] = [
    ("std_msgs/msg/Float64MultiArray", "MultiArrayLayout layout\nfloat64[] data\n"),
    ("std_msgs/msg/Int32", "int32 data\n"),
    ("std_msgs/msg/MultiArrayDimension", "string label\nuint32 size\nuint32 stride\n"),
    ("std_msgs/msg/MultiArrayLayout", "MultiArrayDimension[] dim\nuint32 data_offset\n"),
    ("std_msgs/msg/String", "string data\n"),
    ("std_srvs/srv/SetBool", "bool data\n---\nbool success\nstring message\n"),
    ("std_srvs/srv/Trigger", "---\nbool success\nstring message\n"),
    ("test_msgs/action/Fibonacci", "int32 order\n---\nint32[] sequence\n---\nint32[] sequence\n"),
    ("x_msgs/action/Count", "int32 order\n---\n---\n"),
];

/// Encoding that a robot uses.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum RosbridgeFormat {
    Json,
    Cbor,
}

const BOTH: [RosbridgeFormat; 2] = [RosbridgeFormat::Json, RosbridgeFormat::Cbor];

/// The bridge of a ROS 2 servant.
pub(super) struct BridgedServant {
    bus: Arc<Ros2Bus>,
    bridge: Arc<Bridge>,
}

impl BridgedServant {
    pub(super) async fn start(lab: &Lab) -> Self {
        let bus = lab.join("/cloudroid_bridge").await;
        let registry = Registry::for_version(RosVersion::Two);
        for (name, text) in DEFINITIONS {
            registry.insert(name, text).expect("a definition");
        }
        // Longer than any wait of a test, so that a test which waits for a timeout fails.
        let options = BridgeOptions { action_timeout: 2 * LONG, call_timeout: 2 * LONG, ..BridgeOptions::default() };
        let bridge = Bridge::new(bus.clone(), Arc::new(registry), options);
        Self { bus, bridge }
    }

    /// Waits until its graph satisfies a condition.
    pub(super) async fn wait_graph(&self, wanted: impl Fn(&Graph) -> bool) {
        wait_graph(&self.bus, wanted).await;
    }

    pub(super) async fn robot(&self, speaks: RosbridgeFormat) -> RosbridgeRobot {
        let (ours, theirs) = tokio::io::duplex(64 * 1024);
        let bridge = Arc::clone(&self.bridge);
        tokio::spawn(async move { bridge.serve(theirs, SessionOptions::default()).await });
        let socket = WebSocketStream::from_raw_socket(ours, Role::Client, None).await;
        RosbridgeRobot { socket, speaks }
    }
}

/// A client of rosbridge.
pub(super) struct RosbridgeRobot {
    socket: WebSocketStream<DuplexStream>,
    speaks: RosbridgeFormat,
}

impl RosbridgeRobot {
    pub(super) async fn send(&mut self, op: Value) {
        let message = match self.speaks {
            RosbridgeFormat::Json => Message::text(op.to_string()),
            RosbridgeFormat::Cbor => {
                let mut bytes = Vec::new();
                ciborium::into_writer(&op, &mut bytes).expect("CBOR");
                Message::binary(bytes)
            }
        };
        self.socket.send(message).await.expect("a session");
    }

    /// Sends an operation that selects the encoding of what follows.
    async fn send_first(&mut self, what: &str, mut op: Value) {
        op["op"] = what.into();
        op["compression"] = match self.speaks {
            RosbridgeFormat::Json => "none".into(),
            RosbridgeFormat::Cbor => "cbor".into(),
        };
        self.send(op).await;
    }

    async fn subscribe(&mut self, op: Value) {
        self.send_first("subscribe", op).await;
    }

    /// Returns the next message, which must have this operation.
    pub(super) async fn receive(&mut self, op: &str) -> Value {
        let heard = self.next(op).await;
        assert_eq!(heard["op"], op, "{heard}");
        heard
    }

    /// Returns the end of its goal, skipping feedback.
    async fn receive_goal_end(&mut self) -> Value {
        loop {
            let told = self.next("a result").await;
            if told["op"] != "action_feedback" {
                assert_eq!(told["op"], "action_result", "{told}");
                return told;
            }
        }
    }

    /// Returns the next frame except pings and pongs.
    pub(super) async fn next_frame(&mut self, awaited: &str) -> Message {
        let next = timeout(LONG, async {
            loop {
                match self.socket.next().await.expect("a session") {
                    Ok(Message::Ping(_) | Message::Pong(_)) => {}
                    message => return message.expect("a session"),
                }
            }
        });
        next.await.unwrap_or_else(|_| panic!("{awaited} should come"))
    }

    async fn next(&mut self, awaited: &str) -> Value {
        let (spoken, heard) = match self.next_frame(awaited).await {
            Message::Text(text) => (RosbridgeFormat::Json, serde_json::from_str(&text).expect("JSON")),
            Message::Binary(bytes) => (RosbridgeFormat::Cbor, from_cbor(&bytes)),
            other => panic!("{other:?} instead of {awaited}"),
        };
        assert_eq!(spoken, self.speaks, "{heard}");
        heard
    }

    /// Returns the text of an error.
    async fn refusal(&mut self) -> String {
        let status = self.receive("status").await;
        assert_eq!(status["level"], "error", "{status}");
        status["msg"].as_str().expect("a text").to_owned()
    }

    /// Calls a service; returns the response.
    async fn call(&mut self, service: &str, args: Value) -> Value {
        self.send(json!({"op": "call_service", "service": service, "args": args})).await;
        let answer = self.receive("service_response").await;
        assert_eq!(answer["result"], true, "{answer}");
        answer["values"].clone()
    }

    async fn send_goal(&mut self, id: &str, order: i32) {
        self.send(json!({"op": "send_action_goal", "id": id, "action": "/fib", "feedback": true,
            "action_type": "test_msgs/Fibonacci", "args": {"order": order}}))
            .await;
    }
}

/// Converts CBOR to JSON with typed arrays as lists of numbers.
fn from_cbor(bytes: &[u8]) -> Value {
    fn plain(value: ciborium::Value) -> ciborium::Value {
        use ciborium::Value::{Array, Map, Tag};
        match value {
            Map(entries) => {
                let entries = entries.into_iter();
                Map(entries.map(|(key, value)| (key, plain(value))).collect())
            }
            Array(items) => Array(items.into_iter().map(plain).collect()),
            // RFC 8746: `int32[]`, little-endian.
            Tag(78, numbers) => {
                let numbers = numbers.into_bytes().expect("bytes");
                let numbers = numbers.chunks_exact(4).map(|number| {
                    let number = number.try_into().expect("four bytes");
                    ciborium::Value::from(i32::from_le_bytes(number))
                });
                Array(numbers.collect())
            }
            other => other,
        }
    }
    let value = ciborium::from_reader(bytes).expect("CBOR");
    plain(value).deserialized().expect("what JSON has, too")
}

fn has_peer(graph: &Graph) -> bool {
    let topics = ["/ping", "/pong", "/map", "/scan", "/strict"];
    topics.iter().all(|topic| graph.topics.contains_key(*topic)) && graph.services.contains_key("/set")
}

fn serves_fib(graph: &Graph) -> bool {
    let action = graph.actions.get("/fib");
    action.is_some_and(|action| !action.servers.is_empty())
}

#[tokio::test]
async fn messages_go_both_ways_in_the_quality_that_is_said() {
    let lab = Lab::new();
    let mut peer = lab.peer().await;
    let servant = BridgedServant::start(&lab).await;
    servant.wait_graph(has_peer).await;
    for speaks in BOTH {
        let mut robot = servant.robot(speaks).await;
        let qos = json!({"reliability": "reliable", "durability": "volatile", "depth": 5});
        robot.subscribe(json!({"topic": "/pong", "type": "std_msgs/msg/String", "qos": qos})).await;
        robot.send(json!({"op": "advertise", "topic": "/ping", "type": "std_msgs/String", "qos": qos})).await;
        for data in ["one", "two", "three"] {
            robot.send(json!({"op": "publish", "topic": "/ping", "msg": {"data": data}})).await;
            let heard = robot.receive("publish").await;
            assert_eq!(heard["msg"]["data"], data, "{heard}");
        }
        robot.send(json!({"op": "unsubscribe", "topic": "/pong"})).await;
        // What was kept, without specifying its type.
        robot.subscribe(json!({"topic": "/map"})).await;
        assert_eq!(robot.receive("publish").await["msg"]["data"], "kept");
        let kept = json!({"durability": "transient_local", "depth": 1});
        robot.send(json!({"op": "advertise", "topic": "/late", "type": "std_msgs/String", "qos": kept})).await;
        robot.send(json!({"op": "publish", "topic": "/late", "msg": {"data": "later"}})).await;
        assert_eq!(peer.wait_for("late").await, [json!("later")]);
        // It requests more than is offered, and is told.
        robot.subscribe(json!({"topic": "/scan", "qos": {"reliability": "reliable"}})).await;
        assert_eq!(robot.receive("publish").await["msg"]["data"], "seen");
    }
}

#[tokio::test]
async fn a_node_that_demands_more_is_named_with_both_profiles() {
    let lab = Lab::new();
    let _peer = lab.peer().await;
    let servant = BridgedServant::start(&lab).await;
    servant.wait_graph(has_peer).await;
    for speaks in BOTH {
        let mut robot = servant.robot(speaks).await;
        robot
            .send(json!({"op": "advertise", "topic": "/strict", "type": "std_msgs/String",
                "qos": {"reliability": "best_effort"}}))
            .await;
        assert_eq!(
            robot.refusal().await,
            "advertise: topic /strict: no messages pass between /lab/peer and this client: reliability: the publisher \
                offers best_effort, the subscriber asks for reliable (publisher: best_effort, volatile; subscriber: \
                reliable, volatile)"
        );
    }
}

#[tokio::test]
async fn whoever_says_another_type_is_told_both_at_once() {
    let lab = Lab::new();
    let servant = BridgedServant::start(&lab).await;
    let mut early = servant.robot(RosbridgeFormat::Json).await;
    early.subscribe(json!({"topic": "/pong", "type": "std_msgs/Int32"})).await;
    early
        .send(json!({"op": "send_action_goal", "id": "early", "action": "/fib",
            "action_type": "x_msgs/Count", "args": {"order": 1}}))
        .await;
    let _peer = lab.peer().await;
    let told = early.refusal().await;
    assert!(
        told.starts_with(
            "subscribe: topic /pong: no messages pass between /lab/peer and this client: its type is \
                std_msgs/msg/String RIHS01_"
        ) && told.contains(" there and std_msgs/msg/Int32 "),
        "{told}"
    );
    let _server = lab.node("fibonacci.py", &["server"]).await;
    let other_action = "action /fib has type test_msgs/action/Fibonacci, not x_msgs/action/Count; use the type that it \
                        has";
    assert_eq!(early.receive("action_result").await["values"], other_action);

    servant.wait_graph(|graph| has_peer(graph) && serves_fib(graph)).await;
    for speaks in BOTH {
        let mut robot = servant.robot(speaks).await;
        for (op, topic) in [("subscribe", "/pong"), ("advertise", "/ping")] {
            robot.send(json!({"op": op, "topic": topic, "type": "std_msgs/Int32"})).await;
            assert_eq!(
                robot.refusal().await,
                format!(
                    "{op}: topic {topic} has type std_msgs/msg/String, not std_msgs/msg/Int32; use the type that it \
                        has"
                )
            );
        }
        robot
            .send(json!({"op": "call_service", "service": "/set", "type": "std_srvs/Trigger", "args": {"go": 1}}))
            .await;
        assert_eq!(
            robot.receive("service_response").await["values"],
            "service /set has type std_srvs/srv/SetBool, not std_srvs/srv/Trigger; use the type that it has"
        );
        robot
            .send(json!({"op": "send_action_goal", "id": "goal", "action": "/fib",
                "action_type": "x_msgs/action/Count", "args": {"order": 3}}))
            .await;
        let told = robot.receive("action_result").await;
        assert_eq!(
            (&told["values"], &told["result"], &told["status"]),
            (&json!(other_action), &json!(false), &json!(0))
        );
        // A wrong type is not remembered.
        robot.send_goal("right", 1).await;
        assert_eq!(robot.receive("action_result").await["status"], 4);
    }
}

#[tokio::test]
async fn services_are_called_both_ways() {
    let lab = Lab::new();
    let mut peer = lab.peer().await;
    let servant = BridgedServant::start(&lab).await;
    servant.wait_graph(has_peer).await;
    for speaks in BOTH {
        let mut robot = servant.robot(speaks).await;
        let answer = robot.call("/set", json!({"data": true})).await;
        assert_eq!(answer, json!({"success": true, "message": "set"}));
        // Hidden from tools, but callable by its name.
        let answer = robot.call("/lab/_box/set", json!([false])).await;
        assert_eq!(answer, json!({"success": false, "message": "set"}));

        robot.send_first("advertise_service", json!({"service": "/ask", "type": "std_srvs/SetBool"})).await;
        peer.tell("call true").await;
        let asked = robot.receive("call_service").await;
        assert_eq!((&asked["service"], &asked["args"]), (&json!("/ask"), &json!({"data": true})));
        robot
            .send(json!({"op": "service_response", "id": asked["id"], "service": "/ask",
                "values": {"success": true, "message": "by a robot"}, "result": true}))
            .await;
        assert_eq!(peer.wait_for("call").await, [json!(true), json!("by a robot")]);
        robot.send(json!({"op": "unadvertise_service", "service": "/ask"})).await;
        servant.wait_graph(|graph| !graph.services.contains_key("/ask")).await;
    }
}

#[tokio::test]
async fn goals_are_sent_to_a_node() {
    let lab = Lab::new();
    let _server = lab.node("fibonacci.py", &["server"]).await;
    let servant = BridgedServant::start(&lab).await;
    for speaks in BOTH {
        let mut robot = servant.robot(speaks).await;
        robot.send_goal("five", 5).await;
        for sequence in [json!([0, 1, 1]), json!([0, 1, 1, 2]), json!([0, 1, 1, 2, 3]), json!([0, 1, 1, 2, 3, 5])] {
            let told = robot.receive("action_feedback").await;
            assert_eq!(told["values"]["sequence"], sequence, "{told}");
        }
        let ended = robot.receive("action_result").await;
        assert_eq!(
            (&ended["values"]["sequence"], &ended["status"], &ended["id"]),
            (&json!([0, 1, 1, 2, 3, 5]), &json!(4), &json!("five"))
        );

        robot.send_goal("long", 100_000).await;
        robot.receive("action_feedback").await;
        robot.send(json!({"op": "cancel_action_goal", "id": "long", "action": "/fib"})).await;
        assert_eq!(robot.receive_goal_end().await["status"], 5);
        robot.send_goal("aborted", 7).await;
        assert_eq!(robot.receive_goal_end().await["status"], 6);
        robot.send_goal("refused", -1).await;
        let refused = robot.receive("action_result").await;
        assert_eq!((&refused["values"], &refused["result"]), (&json!("the goal was rejected"), &json!(false)));
    }
}

#[tokio::test]
async fn goals_of_a_node_come_to_a_robot() {
    let lab = Lab::new();
    let servant = BridgedServant::start(&lab).await;
    for speaks in BOTH {
        let mut robot = servant.robot(speaks).await;
        robot.send_first("advertise_action", json!({"action": "/fib", "type": "test_msgs/action/Fibonacci"})).await;
        let mut node = lab.node("fibonacci.py", &["client"]).await;
        assert_eq!(node.obey("there").await, [json!(true)]);
        for (status, sequence) in [(4, json!([0, 1, 1])), (5, json!([0]))] {
            node.tell("goal 2").await;
            let goal = robot.receive("send_action_goal").await;
            assert_eq!(
                (&goal["args"], &goal["action_type"]),
                (&json!({"order": 2}), &json!("test_msgs/action/Fibonacci"))
            );
            assert_eq!(node.wait_for("goal").await[0], true);
            let about = |op: &str| json!({"op": op, "id": goal["id"], "action": "/fib"});
            let mut feedback = about("action_feedback");
            feedback["values"] = json!({"sequence": [0]});
            robot.send(feedback).await;
            assert_eq!(node.wait_for("feedback").await, [json!([0])]);
            if status == 5 {
                node.tell("cancel").await;
                let cancel = robot.receive("cancel_action_goal").await;
                assert_eq!(cancel["id"], goal["id"]);
            }
            let mut result = about("action_result");
            result["values"] = json!({"sequence": sequence});
            result["status"] = status.into();
            result["result"] = true.into();
            robot.send(result).await;
            assert_eq!(node.wait_for("ended").await, [json!(status), sequence]);
        }
        node.kill_and_wait().await;
    }
}

#[tokio::test]
async fn rosapi_tells_of_nodes_and_their_parameters() {
    let lab = Lab::new();
    let (_peer, _tuned) = (lab.peer().await, lab.node("tuned.py", &[]).await);
    let _server = lab.node("fibonacci.py", &["server"]).await;
    let servant = BridgedServant::start(&lab).await;
    servant
        .wait_graph(|graph| {
            let parameters = ["get", "set", "list", "describe"];
            let mut parameters = parameters.iter();
            has_peer(graph)
                && serves_fib(graph)
                && parameters.all(|what| {
                    let service = format!("/lab/tuned/{what}_parameters");
                    graph.services.contains_key(&service)
                })
        })
        .await;
    for speaks in BOTH {
        let mut robot = servant.robot(speaks).await;
        let mut asks = async |what: &str, args: Value| robot.call(&format!("/rosapi/{what}"), args).await;
        let version = asks("get_ros_version", json!({})).await;
        assert_eq!(version, json!({"version": 2, "distro": "jazzy"}));

        let topics = asks("topics", json!({})).await;
        let named = topics["topics"].as_array().expect("names").iter();
        let typed = named.zip(topics["types"].as_array().expect("types"));
        let of_ping = typed.filter(|(name, _)| **name == "/ping").collect::<Vec<_>>();
        assert_eq!(of_ping, [(&json!("/ping"), &json!("std_msgs/msg/String"))]);
        for type_name in ["std_msgs/String", "std_msgs/msg/String"] {
            let of_type = asks("topics_for_type", json!({"type": type_name})).await;
            let of_type = of_type["topics"].as_array().expect("names");
            assert!(of_type.contains(&json!("/pong")), "{of_type:?}");
        }
        assert_eq!(asks("subscribers", json!({"topic": "/ping"})).await, json!({"subscribers": ["/lab/peer"]}));

        let services = asks("services", json!({})).await;
        let services = services["services"].as_array().expect("names");
        assert!(services.contains(&json!("/set")), "{services:?}");
        let hidden = |name: &Value| name.as_str().is_some_and(|name| name.contains("/_"));
        assert!(!services.iter().any(hidden), "{services:?}");
        let set = json!({"service": "/set"});
        assert_eq!(asks("service_type", set.clone()).await, json!({"type": "std_srvs/srv/SetBool"}));
        assert_eq!(asks("service_node", set).await, json!({"node": "/lab/peer"}));
        let actions = asks("action_servers", json!({})).await;
        let actions = actions["action_servers"].as_array().expect("names");
        assert!(actions.contains(&json!("/fib")), "{actions:?}");
        assert_eq!(asks("action_type", json!({"action": "/fib"})).await, json!({"type": "test_msgs/action/Fibonacci"}));

        let nodes = asks("nodes", json!({})).await;
        let nodes = nodes["nodes"].as_array().expect("names");
        for node in ["/lab/peer", "/lab/tuned", "/lab/staged", "/lab/fibonacci"] {
            assert!(nodes.contains(&json!(node)), "{nodes:?}");
        }
        let peer = asks("node_details", json!({"node": "/lab/peer"})).await;
        let publishing = peer["publishing"].as_array().expect("names");
        assert!(publishing.contains(&json!("/pong")), "{peer}");

        let speed = json!({"name": "/lab/tuned:speed"});
        let got = asks("get_param", speed.clone()).await;
        assert_eq!((&got["value"], &got["successful"]), (&json!("1.5"), &json!(true)));
        let set = json!({"name": "/lab/tuned:speed", "value": "2.5"});
        assert_eq!(asks("set_param", set).await["successful"], true);
        assert_eq!(asks("get_param", speed.clone()).await["value"], "2.5");
        let set = json!({"name": "/lab/tuned:speed", "value": "1.5"});
        asks("set_param", set).await;
        assert_eq!(asks("has_param", speed).await, json!({"exists": true}));
        let names = asks("get_param_names", json!({})).await;
        let names = names["names"].as_array().expect("names");
        assert!(names.contains(&json!("/lab/tuned:arm.joint.gain")), "{names:?}");

        // The node's own message.
        robot
            .send(json!({"op": "call_service", "service": "/rosapi/set_param",
                "args": {"name": "/lab/tuned:speed", "value": "11.0"}}))
            .await;
        let refused = robot.receive("service_response").await;
        assert_eq!(
            (&refused["result"], &refused["values"]),
            (&json!(false), &json!("node /lab/tuned refuses speed: too fast"))
        );
    }
}
