//! A network namespace with nodes in it, and a bus that reaches them.

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
use ros::{Interface, JoinOptions, Network};
use serde_json::Value;
use servant::netns::NetNs;
use tokio::io::{AsyncBufReadExt as _, AsyncWriteExt as _, BufReader, Lines};
use tokio::net::{TcpListener, TcpStream, UdpSocket};
use tokio::process::{Child, ChildStdin, ChildStdout, Command};
use tokio::runtime::Handle;
use tokio::time::timeout;

/// Only bounds how long a failing test takes.
pub const LONG: Duration = Duration::from_secs(60);

/// Nodes of one servant have shared memory of their own.
const WITHIN: &str = r#"mount -t tmpfs shm /dev/shm && exec "$@""#;

struct Inside(Arc<NetNs>);

#[async_trait]
impl Sockets for Inside {
    async fn connect(&self, address: SocketAddr) -> io::Result<TcpStream> {
        self.0.connect(address).await
    }

    async fn listen(&self, address: SocketAddr) -> io::Result<TcpListener> {
        self.0.listen(address).await
    }

    async fn datagrams(&self, address: SocketAddr, shared: bool) -> io::Result<UdpSocket> {
        self.0.datagrams(address, shared).await
    }

    async fn interfaces(&self) -> io::Result<Vec<Interface>> {
        self.0.run(ros::net::interfaces).map_err(io::Error::other)?
    }

    async fn diagnostics(&self) -> io::Result<Option<OwnedFd>> {
        self.0.diagnostics().await.map(Some)
    }
}

/// A network with nothing but `lo`.
pub struct Lab {
    pub network: Arc<NetNs>,
}

impl Lab {
    pub fn new() -> Self {
        let network = NetNs::create().expect("a network namespace");
        Self {
            network: Arc::new(network),
        }
    }

    /// Our node of this name.
    pub async fn join(&self, node: &str) -> Arc<Ros2Bus> {
        self.join_network(node, Network::default()).await
    }

    /// The same, where more than `lo` is meant.
    pub async fn join_network(&self, node: &str, network: Network) -> Arc<Ros2Bus> {
        let options = JoinOptions {
            network,
            ..JoinOptions::in_domain(0, node)
        };
        self.join_with(options).await
    }

    /// The same, by these options.
    pub async fn join_with(&self, options: JoinOptions) -> Arc<Ros2Bus> {
        let sockets = Arc::new(Inside(Arc::clone(&self.network)));
        let joined = Ros2Bus::connect(sockets, options).await;
        joined.expect("a bus")
    }

    /// The node of `peer.py`, once it is ready.
    pub async fn peer(&self) -> Peer {
        self.node("peer.py", &[]).await
    }

    /// A node of a program beside this file, once it is ready.
    pub async fn node(&self, program: &str, arguments: &[&str]) -> Peer {
        self.node_with(program, arguments, &[]).await
    }

    /// The same, with these variables in its environment.
    pub async fn node_with(
        &self,
        program: &str,
        arguments: &[&str],
        environment: &[(&str, &str)],
    ) -> Peer {
        let prefix = std::env::var_os("CLOUDROID_ROS2_PREFIX");
        let prefix = prefix.expect(
            "CLOUDROID_ROS2_PREFIX names the environment with ROS 2; run the tests by make test",
        );
        let script = Path::new(env!("CARGO_MANIFEST_DIR"))
            .join("tests/ros2")
            .join(program);
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
        let mut peer = Peer {
            orders: child.stdin.take().expect("its input"),
            lines: BufReader::new(lines).lines(),
            child,
        };
        peer.says("ready").await;
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
    /// Waits until it says something of this kind, and gives the rest of it.
    pub async fn says(&mut self, kind: &str) -> Vec<Value> {
        let [said] = self.says_each([kind]).await;
        said
    }

    /// The same of several kinds, in whichever order it says them: of each the first.
    pub async fn says_each<const N: usize>(&mut self, kinds: [&str; N]) -> [Vec<Value>; N] {
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

    /// Tells it to do something, and waits until it says that it has.
    pub async fn obey(&mut self, order: &str) -> Vec<Value> {
        self.tell(order).await;
        let kind = order.split(' ').next().unwrap_or_default().to_owned();
        self.says(&kind).await
    }

    /// Tells it to do something.
    pub async fn tell(&mut self, order: &str) {
        let line = format!("{order}\n");
        let written = self.orders.write_all(line.as_bytes()).await;
        written.expect("its input");
    }

    /// As by `kill -9`.
    pub fn kill(&mut self) {
        self.child.start_kill().expect("it can be killed");
    }

    /// The same; returns when it is no more.
    pub async fn ends(&mut self) {
        self.child.kill().await.expect("it can be killed");
    }
}

pub fn string() -> Arc<MessageType> {
    let text = "string data";
    MessageType::of_full_text(RosVersion::Two, "std_msgs/msg/String", text).expect("a message")
}

pub fn set_bool() -> Arc<ServiceDef> {
    let registry = Registry::of(RosVersion::Two);
    let text = "bool data\n---\nbool success\nstring message\n";
    let inserted = registry.insert("std_srvs/srv/SetBool", text);
    inserted.expect("a definition");
    registry.service("std_srvs/srv/SetBool").expect("a service")
}

pub fn of_string() -> WireType {
    WireType::of(&string())
}

pub fn of_set_bool() -> ServiceType {
    ServiceType::of(&set_bool())
}

/// A message by its JSON.
pub fn cdr(of: &MessageType, json: &str) -> Bytes {
    let mut bytes = Vec::new();
    from_json(of, json.as_bytes(), &mut bytes, &FillOptions::default()).expect("a message");
    bytes.into()
}

/// The JSON of a message.
pub fn json(of: &MessageType, bytes: &[u8]) -> String {
    let mut text = Vec::new();
    to_json(of, bytes, &mut text, &JsonOptions::default()).expect("a message");
    String::from_utf8(text).expect("text")
}

/// A `std_msgs/msg/String`.
pub fn said(text: &str) -> Bytes {
    cdr(&string(), &format!(r#"{{"data":"{text}"}}"#))
}

/// Waits until the graph shows this.
pub async fn shows(bus: &Ros2Bus, wanted: impl Fn(&ros::bus::Graph) -> bool) {
    let mut graph = bus.graph();
    let found = timeout(LONG, graph.wait_for(|graph| wanted(graph)));
    if found.await.is_err() {
        panic!("{:#?}", bus.graph().borrow());
    }
}
