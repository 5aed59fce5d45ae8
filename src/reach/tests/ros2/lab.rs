//! A network namespace with nodes, and a bus that reaches them.

use std::io;
use std::net::SocketAddr;
use std::os::fd::OwnedFd;
use std::path::Path;
use std::process::Stdio;
use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use bytes::Bytes;
use ros::bus::{Bus, RosVersion, ServiceType, WireType};
use ros::codec::{FillOptions, JsonOptions, from_json, to_json};
use ros::net::Sockets;
use ros::ros2::Ros2Bus;
use ros::schema::{MessageType, Registry, ServiceDef};
use ros::{DiscoveryNetwork, InterfaceAddress, JoinOptions};
use serde_json::Value;
use servant::netns::NetNs;
use tokio::io::{AsyncBufReadExt as _, AsyncWriteExt as _, BufReader, Lines};
use tokio::net::{TcpListener, TcpStream, UdpSocket};
use tokio::process::{Child, ChildStdin, ChildStdout, Command};
use tokio::runtime::Handle;
use tokio::time::timeout;

/// Only limits the duration of a failing test.
pub const LONG: Duration = Duration::from_secs(60);

/// Definitions of the service by which a node is asked for its parameters.
pub const GET_PARAMETERS: [(&str, &str); 2] = [
    (
        "rcl_interfaces/msg/ParameterValue",
        "uint8 type\nbool bool_value\nint64 integer_value\nfloat64 double_value\nstring string_value\nbyte[] \
         byte_array_value\n\
         bool[] bool_array_value\nint64[] integer_array_value\nfloat64[] double_array_value\nstring[] \
         string_array_value\n",
    ),
    ("rcl_interfaces/srv/GetParameters", "string[] names\n---\nParameterValue[] values\n"),
];

/// Nodes of one servant have their own shared memory.
const WITHIN: &str = r#"mount -t tmpfs shm /dev/shm && exec "$@""#;

struct LabNamespace(Arc<NetNs>);

#[async_trait]
impl Sockets for LabNamespace {
    async fn connect(&self, address: SocketAddr) -> io::Result<TcpStream> {
        self.0.connect(address).await
    }

    async fn listen(&self, address: SocketAddr) -> io::Result<TcpListener> {
        self.0.listen(address).await
    }

    async fn bind_udp(&self, address: SocketAddr, shared: bool) -> io::Result<UdpSocket> {
        self.0.bind_udp(address, shared).await
    }

    async fn interfaces(&self) -> io::Result<Vec<InterfaceAddress>> {
        self.0.run(ros::net::list_interfaces).map_err(io::Error::other)?
    }

    async fn open_sock_diag(&self) -> io::Result<Option<OwnedFd>> {
        self.0.open_sock_diag().await.map(Some)
    }
}

/// A network with only `lo`.
pub struct Lab {
    pub network: Arc<NetNs>,
}

impl Lab {
    pub fn new() -> Self {
        let network = NetNs::create().expect("a network namespace");
        Self { network: Arc::new(network) }
    }

    /// Joins with a node of ours.
    pub async fn join(&self, node: &str) -> Arc<Ros2Bus> {
        self.join_network(node, DiscoveryNetwork::default()).await
    }

    /// Joins with interfaces other than `lo`.
    pub async fn join_network(&self, node: &str, network: DiscoveryNetwork) -> Arc<Ros2Bus> {
        let options = JoinOptions { network, ..JoinOptions::in_domain(0, node) };
        self.join_with(options).await
    }

    /// Joins with these options.
    pub async fn join_with(&self, options: JoinOptions) -> Arc<Ros2Bus> {
        let sockets = Arc::new(LabNamespace(Arc::clone(&self.network)));
        let joined = Ros2Bus::connect(sockets, options).await;
        joined.expect("a bus")
    }

    /// Starts the node of `peer.py` and waits until it is ready.
    pub async fn peer(&self) -> Peer {
        self.node("peer.py", &[]).await
    }

    /// Starts a node of a program beside this file and waits until it is ready.
    pub async fn node(&self, program: &str, arguments: &[&str]) -> Peer {
        self.node_with(program, arguments, &[]).await
    }

    /// Starts a node with these additional environment variables.
    pub async fn node_with(&self, program: &str, arguments: &[&str], environment: &[(&str, &str)]) -> Peer {
        let prefix = std::env::var_os("CLOUDROID_ROS2_PREFIX");
        let prefix =
            prefix.expect("CLOUDROID_ROS2_PREFIX names the environment with ROS 2; run the tests by make test");
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/ros2").join(program);
        let mut command = Command::new("unshare");
        command
            .args(["--mount", "sh", "-c", WITHIN, "sh"])
            .arg(Path::new(&prefix).join("bin/python"))
            .arg(script)
            .args(arguments)
            .env("ROS_DOMAIN_ID", "0")
            .envs(environment.iter().copied())
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .kill_on_drop(true);
        let runtime = Handle::current();
        let spawned = self.network.run(|| {
            let _entered = runtime.enter();
            command.spawn()
        });
        let mut child = spawned.expect("a namespace").expect("a node");
        let lines = child.stdout.take().expect("its output");
        let mut peer =
            Peer { orders: child.stdin.take().expect("its input"), lines: BufReader::new(lines).lines(), child };
        peer.wait_for("ready").await;
        peer
    }
}

/// A node of rclpy.
pub struct Peer {
    child: Child,
    orders: ChildStdin,
    lines: Lines<BufReader<ChildStdout>>,
}

impl Peer {
    /// Waits for a report of this kind and returns its arguments.
    pub async fn wait_for(&mut self, kind: &str) -> Vec<Value> {
        let [said] = self.wait_for_each([kind]).await;
        said
    }

    /// Waits for the first report of each of several kinds, in any order.
    pub async fn wait_for_each<const N: usize>(&mut self, kinds: [&str; N]) -> [Vec<Value>; N] {
        let mut said = [const { Vec::new() }; N];
        let mut missing = N;
        let all = async {
            while let Some(line) = self.lines.next_line().await.expect("its output") {
                let mut words: Vec<Value> = serde_json::from_str(&line).expect("JSON");
                let of = |kind: &&str| words.first().is_some_and(|first| first == kind);
                if let Some(at) = kinds.iter().position(of).filter(|at| said[*at].is_empty()) {
                    said[at] = words.split_off(0);
                    missing -= 1;
                }
                if missing == 0 {
                    return;
                }
            }
            panic!("the node has ended");
        };
        let come = timeout(LONG, all).await;
        come.unwrap_or_else(|_| panic!("it should say each of {kinds:?}"));
        said.map(|mut words| words.split_off(1))
    }

    /// Sends a command and waits for its completion.
    pub async fn obey(&mut self, order: &str) -> Vec<Value> {
        self.tell(order).await;
        let kind = order.split(' ').next().unwrap_or_default().to_owned();
        self.wait_for(&kind).await
    }

    /// Sends a command.
    pub async fn tell(&mut self, order: &str) {
        let line = format!("{order}\n");
        let written = self.orders.write_all(line.as_bytes()).await;
        written.expect("its input");
    }

    /// Kills it as `kill -9` does.
    pub fn kill(&mut self) {
        self.child.start_kill().expect("it can be killed");
    }

    /// Kills it and waits until it is gone.
    pub async fn kill_and_wait(&mut self) {
        self.child.kill().await.expect("it can be killed");
    }
}

pub fn string() -> Arc<MessageType> {
    let text = "string data";
    MessageType::parse_full_text(RosVersion::Two, "std_msgs/msg/String", text).expect("a message")
}

pub fn set_bool() -> Arc<ServiceDef> {
    let registry = Registry::for_version(RosVersion::Two);
    let text = "bool data\n---\nbool success\nstring message\n";
    let inserted = registry.insert("std_srvs/srv/SetBool", text);
    inserted.expect("a definition");
    registry.service("std_srvs/srv/SetBool").expect("a service")
}

pub fn string_type() -> WireType {
    WireType::from_message(&string())
}

pub fn set_bool_type() -> ServiceType {
    ServiceType::from_service(&set_bool())
}

/// Encodes a message from its JSON.
pub fn cdr(of: &MessageType, json: &str) -> Bytes {
    let mut bytes = Vec::new();
    from_json(of, json.as_bytes(), &mut bytes, &FillOptions::default()).expect("a message");
    bytes.into()
}

/// Returns the JSON of a message.
pub fn json(of: &MessageType, bytes: &[u8]) -> String {
    let mut text = Vec::new();
    to_json(of, bytes, &mut text, &JsonOptions::default()).expect("a message");
    String::from_utf8(text).expect("text")
}

/// Encodes a `std_msgs/msg/String`.
pub fn string_message(text: &str) -> Bytes {
    cdr(&string(), &format!(r#"{{"data":"{text}"}}"#))
}

/// Waits until the graph satisfies a condition.
pub async fn wait_graph(bus: &Ros2Bus, wanted: impl Fn(&ros::bus::Graph) -> bool) {
    let mut graph = bus.graph();
    let found = timeout(LONG, graph.wait_for(|graph| wanted(graph)));
    if found.await.is_err() {
        panic!("{:#?}", bus.graph().borrow());
    }
}
