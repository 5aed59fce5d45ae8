//! The meter: where it runs, and how it is given credit and asked for counts, past the daemon.

use std::io;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use async_trait::async_trait;
use bench_servant::Daemon;
use bytes::Bytes;
use ros::bus::{Bus, Publisher, Qos, WireType};
use ros::net::Sockets;
use ros::ros1::Ros1Bus;
use ros::ros1::xmlrpc::{Client, Value};
use servant::launch::{self, Runtime as Record};
use servant::netns::NetNs;
use tokio::net::{TcpListener, TcpStream};
use tokio::runtime::Runtime;

use crate::line::Line;

/// Where every servant's Master listens.
pub(crate) const MASTER: SocketAddr = SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), 11311);
/// How long anything may take that is waited for.
pub(crate) const PATIENCE: Duration = Duration::from_secs(30);

const NODE: &str = "/meter";

/// Sockets inside the servant.
#[derive(Clone)]
pub(crate) struct Inside(Arc<NetNs>);

impl Inside {
    /// Where that process is.
    pub(crate) fn of(pid: i32) -> Result<Self> {
        Ok(Self(Arc::new(NetNs::from_pid(pid)?)))
    }
}

#[async_trait]
impl Sockets for Inside {
    async fn connect(&self, address: SocketAddr) -> io::Result<TcpStream> {
        self.0.connect(address).await
    }

    async fn listen(&self, address: SocketAddr) -> io::Result<TcpListener> {
        self.0.listen(address).await
    }
}

/// The address of a node's own XML-RPC server.
pub(crate) async fn address_of(inside: &Inside, name: &str) -> Result<String> {
    let master = Client::new(Arc::new(inside.clone()), &format!("http://{MASTER}/"))?;
    let found = master
        .call("lookupNode", &["/bench".into(), name.into()], PATIENCE)
        .await?;
    let found = found.as_array().context("an answer")?;
    Ok(found
        .get(2)
        .and_then(Value::as_str)
        .with_context(|| format!("{name} in {found:?}"))?
        .to_owned())
}

/// The node.
pub(crate) struct Node {
    /// PID 1 of its servant.
    pub(crate) pid: i32,
    pub(crate) runtime: Runtime,
    slave: Client,
    bus: Arc<Ros1Bus>,
}

impl Node {
    /// Has a servant started, which stays for its grace time.
    pub(crate) fn find(daemon: &Daemon) -> Result<Self> {
        let mut robot = Line::robot(daemon)?;
        robot.ask(r#"{"op":"call_service","service":"/rosapi/nodes"}"#)?;
        let id = daemon.servants()?.into_iter().next().context("a servant")?;
        let path = daemon
            .home()
            .join("servants")
            .join(id)
            .join(launch::RUNTIME);
        let record: Record = launch::read(&path)?.context("its record")?;
        let shim = record.shim.pid;
        let children = std::fs::read_to_string(format!("/proc/{shim}/task/{shim}/children"))?;
        let pid = children
            .split_whitespace()
            .next()
            .context("init")?
            .parse()?;
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .enable_all()
            .build()?;
        let inside = Inside::of(pid)?;
        let (bus, slave) = runtime.block_on(async {
            let bus = Ros1Bus::connect(Arc::new(inside.clone()), MASTER, "/bench_control").await?;
            let slave = Client::new(Arc::new(inside.clone()), &address_of(&inside, NODE).await?)?;
            anyhow::Ok((bus, slave))
        })?;
        Ok(Self {
            pid,
            runtime,
            slave,
            bus,
        })
    }

    /// Waits until the node has so many connections for a topic.
    pub(crate) fn until_connected(&self, topic: &str, count: usize) -> Result<()> {
        let deadline = Instant::now() + PATIENCE;
        loop {
            let found = self.connections(topic)?;
            if found == count {
                return Ok(());
            }
            ensure!(
                Instant::now() < deadline,
                "{topic} has {found} connections and not {count}"
            );
            std::thread::sleep(Duration::from_millis(2));
        }
    }

    fn connections(&self, topic: &str) -> Result<usize> {
        let caller = ["/bench".into()];
        let call = self.slave.call("getBusInfo", &caller, PATIENCE);
        let answer = self.runtime.block_on(call)?;
        let rows = answer
            .as_array()
            .and_then(|answer| answer.get(2)?.as_array());
        let about = |row: &&Value| {
            row.as_array()
                .and_then(|row| row.get(4)?.as_str())
                .is_some_and(|found| found == topic)
        };
        Ok(rows.context("rows")?.iter().filter(about).count())
    }

    /// Credit for one of the node's sources: it publishes as many messages as it is told.
    pub(crate) fn credit(&self, topic: &str) -> Result<Credit> {
        let topic = format!("{topic}_credit");
        let publisher = self.runtime.block_on(self.bus.advertise(
            &topic,
            UINT32.into(),
            Qos::keep_last(1000),
        ))?;
        self.until_connected(&topic, 1)?;
        Ok(Credit(publisher))
    }

    /// How many messages one of the node's sinks has counted; the thread that asks is woken when there are more.
    pub(crate) fn count(&self, topic: &str) -> Result<Count> {
        let count = Arc::new(AtomicU64::new(0));
        let counted = count.clone();
        let asking = std::thread::current();
        let topic = format!("{topic}_count");
        let mut subscription = self.runtime.block_on(self.bus.subscribe(
            &topic,
            UINT32.into(),
            Qos::keep_last(1000),
        ))?;
        self.runtime.spawn(async move {
            let _subscribed = &subscription.guard;
            while let Some(message) = subscription.messages.recv().await {
                if let Ok(bytes) = message.bytes.as_ref().try_into() {
                    counted.store(u32::from_le_bytes(bytes).into(), Ordering::Relaxed);
                    asking.unpark();
                }
            }
        });
        self.until_connected(&topic, 1)?;
        Ok(Count { count })
    }
}

const UINT32: Type = Type {
    name: "std_msgs/UInt32",
    md5: "304a39449588c7f8ce2df6e8001c5fce",
    definition: "uint32 data\n",
};

/// A type, and what a header says of it.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Type {
    pub(crate) name: &'static str,
    pub(crate) md5: &'static str,
    pub(crate) definition: &'static str,
}

/// The small message.
pub(crate) const STRING: Type = Type {
    name: "std_msgs/String",
    md5: "992ce8a1687cec8c8bd883ec73ca41d1",
    definition: "string data\n",
};

/// The big one.
pub(crate) const IMAGE: Type = Type {
    name: "sensor_msgs/Image",
    md5: "060021388200f6f0f447d0fcd9c64743",
    definition: "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step\n\
        uint8[] data\n\
        ================================================================================\nMSG: std_msgs/Header\n\
        uint32 seq\ntime stamp\nstring frame_id\n",
};

impl From<Type> for WireType {
    fn from(from: Type) -> Self {
        Self::new(from.name, from.md5, from.definition)
    }
}

/// See [`Node::credit`].
pub(crate) struct Credit(Box<dyn Publisher>);

impl Credit {
    pub(crate) fn pay(&self, messages: u32) {
        self.0
            .publish(Bytes::copy_from_slice(&messages.to_le_bytes()));
    }
}

/// See [`Node::count`].
pub(crate) struct Count {
    count: Arc<AtomicU64>,
}

impl Count {
    pub(crate) fn get(&self) -> u64 {
        self.count.load(Ordering::Relaxed)
    }
}
