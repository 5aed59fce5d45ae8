//! Environment of the tests.

use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use bridge::{Bridge, BridgeOptions, SessionEnd, SessionOptions};
use bytes::Bytes;
use futures_util::{SinkExt, StreamExt};
use ros::JoinOptions;
use ros::bus::{Bus, Graph, Publisher, QosProfile, RosVersion, ServiceType, Subscription, WireType};
use ros::codec::{self, FillOptions, JsonOptions};
use ros::net::HostSockets;
use ros::ros1::master::{Master, MasterOptions};
use ros::schema::Registry;
use serde_json::Value;
use tokio::io::DuplexStream;
use tokio::net::TcpListener;
use tokio::sync::watch;
use tokio::task::JoinHandle;
use tokio_tungstenite::WebSocketStream;
use tokio_tungstenite::tungstenite::protocol::{Message, Role, WebSocketConfig};

use crate::memory_bus::MemorySystem;

/// Bounds the duration of a failing test.
pub const PATIENCE: Duration = Duration::from_secs(120);

const DEFINITIONS: &[(&str, &str)] = &[
    ("std_msgs/msg/String", "string data\n"),
    ("std_msgs/msg/Int32", "int32 data\n"),
    ("std_msgs/msg/UInt8MultiArray", "uint8[] data\n"),
    ("x_msgs/msg/Place", "std_msgs/Header header\nfloat64 x\nfloat64[] near\nx_msgs/Tag[] tags\n"),
    ("x_msgs/msg/Tag", "string name\nuint8 number\n"),
    ("x_msgs/srv/Add", "int64 a\nint64 b\n---\nint64 sum\n"),
    ("x_msgs/srv/Nothing", "---\n"),
    ("x_msgs/srv/Say", "---\nstring words\n"),
    ("x_msgs/action/Count", "int32 to\n---\nint32[] all\n---\nint32 at\n"),
    ("x_msgs/action/Dig", "int32 to\n---\n---\n"),
];

/// Returns options with which nothing is given up on a busy machine.
pub fn patient() -> BridgeOptions {
    BridgeOptions {
        idle_timeout: PATIENCE,
        close_timeout: PATIENCE,
        action_timeout: PATIENCE,
        resume_grace: PATIENCE,
        warm_up: Duration::from_secs(10),
        ..BridgeOptions::default()
    }
}

/// A ROS system that nodes can join.
#[async_trait]
pub trait System: Sized + Send + Sync + 'static {
    /// ROS version of its nodes.
    const VERSION: RosVersion;
    /// Host that its nodes appear to run on.
    const HOST: &str;
    /// Starts a new system.
    async fn start() -> Self;
    /// Joins it as a node of this name.
    async fn join(&self, node: &str) -> Arc<dyn Bus>;
}

/// A real Master, and real TCPROS on loopback.
pub struct Ros1 {
    address: std::net::SocketAddr,
    master: JoinHandle<()>,
}

#[async_trait]
impl System for Ros1 {
    const VERSION: RosVersion = RosVersion::One;
    const HOST: &str = "127.0.0.1";

    async fn start() -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        let master = Master::new(MasterOptions { uri: format!("http://{address}/"), ..MasterOptions::default() });
        let master = tokio::spawn(async move { master.serve(listener, Arc::new(HostSockets)).await });
        Self { address, master }
    }

    async fn join(&self, node: &str) -> Arc<dyn Bus> {
        let options = JoinOptions::new(self.address, node);
        let joined = ros::connect(RosVersion::One, Arc::new(HostSockets), options);
        joined.await.unwrap()
    }
}

impl Drop for Ros1 {
    fn drop(&mut self) {
        self.master.abort();
    }
}

#[async_trait]
impl System for Arc<MemorySystem> {
    const VERSION: RosVersion = RosVersion::Two;
    const HOST: &str = "localhost";

    async fn start() -> Self {
        Arc::default()
    }

    async fn join(&self, node: &str) -> Arc<dyn Bus> {
        MemorySystem::join(self, node)
    }
}

/// A ROS system with a node in it, and a bridge.
pub struct World<S> {
    pub bridge: Arc<Bridge>,
    /// Node of the servant.
    pub node: Arc<dyn Bus>,
    pub registry: Arc<Registry>,
    pub system: S,
    /// The graph as the bridge sees it.
    seen: watch::Receiver<Arc<Graph>>,
}

impl<S: System> World<S> {
    pub async fn new() -> Self {
        Self::with_options(patient()).await
    }

    pub async fn with_options(options: BridgeOptions) -> Self {
        let system = S::start().await;
        let registry = Registry::for_version(S::VERSION);
        for (key, text) in DEFINITIONS {
            registry.insert(key, text).unwrap();
        }
        let registry = Arc::new(registry);
        let node = system.join("/node").await;
        let bus = system.join("/cloudroid_bridge").await;
        let seen = bus.graph();
        let bridge = Bridge::new(bus, registry.clone(), options);
        World { bridge, node, registry, system, seen }
    }

    /// Returns the host that nodes appear to run on.
    pub fn host(&self) -> &'static str {
        S::HOST
    }

    /// Returns the ROS version.
    pub fn version(&self) -> RosVersion {
        S::VERSION
    }

    /// Returns the first value in ROS 1, the second in ROS 2.
    pub fn by_version<T>(&self, one: T, two: T) -> T {
        match S::VERSION {
            RosVersion::One => one,
            RosVersion::Two => two,
        }
    }

    /// Returns the name of a message's type, `package/Type`, as spelled by its ROS.
    pub fn message_name(&self, name: &str) -> String {
        self.full_name(name, "msg")
    }

    /// Returns the name of a service's type (`srv`) or an action's (`action`), as spelled by its ROS.
    pub fn full_name(&self, name: &str, kind: &str) -> String {
        self.by_version(name.to_owned(), name.replacen('/', &format!("/{kind}/"), 1))
    }

    /// Returns the name of the request's type of a service `package/Type`.
    pub fn request_name(&self, service: &str) -> String {
        self.registry.service(service).unwrap().request.name().to_owned()
    }

    /// Returns the type of a service, `package/Type`.
    pub fn service_type(&self, service: &str) -> ServiceType {
        ServiceType::from_service(&self.registry.service(service).unwrap())
    }

    /// Returns the term for what identifies a definition.
    pub fn digest_word(&self) -> &'static str {
        self.by_version("MD5", "type hash")
    }

    /// Returns a stamp in JSON.
    pub fn time(&self, secs: u32, nsecs: u32) -> Value {
        self.by_version(
            serde_json::json!({"secs": secs, "nsecs": nsecs}),
            serde_json::json!({"sec": secs, "nanosec": nsecs}),
        )
    }

    /// Returns the seconds of a stamp in JSON.
    pub fn seconds(&self, stamp: &Value) -> u64 {
        stamp[self.by_version("secs", "sec")].as_u64().unwrap()
    }

    /// Returns values in sequence, little-endian and aligned, as a serialized message.
    pub fn serialize(&self, values: &[u8]) -> Bytes {
        let header = self.by_version(&b""[..], &b"\0\x01\0\0"[..]);
        [header, values].concat().into()
    }

    /// Returns the values of a serialized message.
    pub fn values<'b>(&self, bytes: &'b [u8]) -> &'b [u8] {
        &bytes[self.by_version(0, 4)..]
    }

    /// Joins another node.
    pub async fn another_node(&self, name: &str) -> Arc<dyn Bus> {
        self.system.join(name).await
    }

    /// Creates another bridge with the same Master.
    pub async fn another_bridge(&self) -> Arc<Bridge> {
        Bridge::new(self.another_node("/other_bridge").await, self.registry.clone(), patient())
    }

    pub async fn client(&self) -> Client {
        self.client_with(SessionOptions::default()).await
    }

    pub async fn client_with(&self, options: SessionOptions) -> Client {
        Client::connect(&self.bridge, options).await
    }

    /// Serializes a message from JSON.
    pub fn message(&self, type_name: &str, json: Value) -> Bytes {
        let message_type = self.registry.message(type_name).unwrap();
        let mut out = Vec::new();
        codec::from_json(&message_type, json.to_string().as_bytes(), &mut out, &FillOptions::default()).unwrap();
        out.into()
    }

    pub fn json(&self, type_name: &str, bytes: &[u8]) -> Value {
        let message_type = self.registry.message(type_name).unwrap();
        let mut out = Vec::new();
        codec::to_json(&message_type, bytes, &mut out, &JsonOptions::default()).unwrap();
        serde_json::from_slice(&out).unwrap()
    }

    pub fn wire_type(&self, type_name: &str) -> WireType {
        let message_type = self.registry.message(type_name).unwrap();
        WireType::from_message(&message_type)
    }

    pub async fn node_publishes(&self, topic: &str, type_name: &str, latch: bool) -> Box<dyn Publisher> {
        self.publishes(&*self.node, topic, type_name, latch).await
    }

    pub async fn publishes(&self, node: &dyn Bus, topic: &str, type_name: &str, latch: bool) -> Box<dyn Publisher> {
        let publisher = node
            .advertise(topic, self.wire_type(type_name), QosProfile::keep_last(10_000).latching(latch))
            .await
            .unwrap();
        self.wait_for_graph(|graph| graph.topics.contains_key(topic)).await;
        publisher
    }

    pub async fn node_subscribes(&self, topic: &str, type_name: &str) -> Subscription {
        self.node.subscribe(topic, self.wire_type(type_name), QosProfile::keep_last(10_000)).await.unwrap()
    }

    /// Waits until the graph satisfies the condition for both the node and the bridge.
    pub async fn wait_for_graph(&self, condition: impl Fn(&Graph) -> bool) {
        for mut graph in [self.node.graph(), self.seen.clone()] {
            let seen = with_timeout(graph.wait_for(|graph| condition(graph))).await;
            seen.unwrap();
        }
    }
}

/// Waits for something that must happen.
pub async fn with_timeout<F: Future>(future: F) -> F::Output {
    tokio::time::timeout(PATIENCE, future).await.expect("it did not happen in time")
}

/// Waits until `count` subscribers have connected to a publisher.
pub async fn wait_connected(publisher: &dyn Publisher, count: usize) {
    with_timeout(publisher.matched_subscribers().wait_for(|now| now.connected_count() >= count)).await.unwrap();
}

/// A client of the bridge.
pub struct Client {
    socket: WebSocketStream<DuplexStream>,
    pub session: JoinHandle<SessionEnd>,
}

impl Client {
    pub async fn connect(bridge: &Arc<Bridge>, options: SessionOptions) -> Client {
        let (ours, theirs) = tokio::io::duplex(64 * 1024);
        let bridge = bridge.clone();
        let session = tokio::spawn(async move { bridge.serve(theirs, options).await });
        let config = WebSocketConfig::default().max_frame_size(None).max_message_size(None);
        Client { socket: WebSocketStream::from_raw_socket(ours, Role::Client, Some(config)).await, session }
    }

    pub async fn send(&mut self, message: Value) {
        self.send_text(&message.to_string()).await;
    }

    pub async fn send_text(&mut self, text: &str) {
        with_timeout(self.socket.send(Message::text(text))).await.unwrap();
    }

    pub async fn send_binary(&mut self, bytes: Vec<u8>) {
        with_timeout(self.socket.send(Message::binary(bytes))).await.unwrap();
    }

    pub async fn send_raw(&mut self, message: Message) -> Result<(), tokio_tungstenite::tungstenite::Error> {
        with_timeout(self.socket.send(message)).await
    }

    /// Receives the next WebSocket message except pings and pongs.
    pub async fn next(&mut self) -> Message {
        loop {
            match with_timeout(self.socket.next()).await.expect("the connection ended").unwrap() {
                Message::Ping(_) | Message::Pong(_) => {}
                message => return message,
            }
        }
    }

    /// Receives the next text message.
    pub async fn text(&mut self) -> String {
        match self.next().await {
            Message::Text(text) => text.to_string(),
            other => panic!("{other:?} is no text"),
        }
    }

    /// Receives the next message, in JSON.
    pub async fn json(&mut self) -> Value {
        serde_json::from_str(&self.text().await).unwrap()
    }

    /// Receives the next binary message.
    pub async fn binary(&mut self) -> Bytes {
        match self.next().await {
            Message::Binary(bytes) => bytes,
            other => panic!("{other:?} is not binary"),
        }
    }

    /// Asserts that the next message is a status at level error, and returns its text.
    pub async fn refusal(&mut self) -> String {
        let status = self.json().await;
        assert_eq!((&status["op"], &status["level"]), (&"status".into(), &"error".into()), "{status}");
        status["msg"].as_str().unwrap().to_owned()
    }

    /// Asserts that the server has handled everything sent so far, and that the connection is open.
    pub async fn sync(&mut self) {
        self.send(serde_json::json!({"op": "call_service", "id": "settled",
            "service": "/rosapi/get_ros_version"}))
            .await;
        let answer = self.json().await;
        assert_eq!(answer["id"], "settled", "{answer}");
    }

    /// Waits for the close frame, and answers it.
    pub async fn expect_close(&mut self) -> (u16, String) {
        let close = loop {
            if let Message::Close(close) = self.next().await {
                break close;
            }
        };
        // The server may have gone without waiting for it.
        let _ = with_timeout(self.socket.flush()).await;
        close.map_or((1005, String::new()), |close| (close.code.into(), close.reason.to_string()))
    }

    /// Drops the connection without closing it.
    pub async fn abort(self) -> SessionEnd {
        drop(self.socket);
        with_timeout(self.session).await.unwrap()
    }
}
