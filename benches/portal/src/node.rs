//! The node `meter` in its servant, with which publishing credit and message counts are exchanged past the daemon.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use bench_report::{BenchDaemon, first_child};
use bytes::Bytes;
use reach::ServantSockets;
use ros::bus::{Bus, Publisher, QosProfile, WireType};
use ros::ros1::Ros1Bus;
use ros::ros1::process::MASTER;
use ros::ros1::xmlrpc::Value;
use servant::launch::{self, RuntimeRecord};
use servant::netns::NetNs;
use tokio::runtime::Runtime;

use crate::line::BenchConnection;
use crate::raw::RawNode;

/// Timeout of everything that is waited for.
pub(crate) const PATIENCE: Duration = Duration::from_secs(30);

const NODE: &str = "/meter";

/// Opens the network namespace of a process.
pub(crate) fn open_sockets(pid: i32) -> Result<ServantSockets> {
    Ok(ServantSockets::new(&Arc::new(NetNs::from_pid(pid)?)))
}

/// The node under measurement.
pub(crate) struct MeterNode {
    /// PID 1 of its servant.
    pub(crate) pid: i32,
    pub(crate) runtime: Runtime,
    /// A node beside it, for bare connections.
    pub(crate) raw: RawNode,
    bus: Arc<Ros1Bus>,
}

impl MeterNode {
    /// Has a servant started, which is kept for its grace time, and finds the node in it.
    pub(crate) fn find(daemon: &BenchDaemon) -> Result<Self> {
        let mut robot = BenchConnection::connect_robot(daemon)?;
        robot.request(r#"{"op":"call_service","service":"/rosapi/nodes"}"#)?;
        let id = daemon.servants()?.into_iter().next().context("a servant")?;
        let path = daemon.home.join("servants").join(id).join(launch::RUNTIME);
        let record: RuntimeRecord = launch::read_record(&path)?.context("its record")?;
        let pid = first_child(record.shim.pid)?;
        let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build()?;
        let inside = open_sockets(pid)?;
        let (bus, raw) = runtime.block_on(async {
            let bus = Ros1Bus::connect(Arc::new(inside.clone()), MASTER, "/bench_control").await?;
            anyhow::Ok((bus, RawNode::start(inside, NODE).await?))
        })?;
        Ok(Self { pid, runtime, raw, bus })
    }

    /// Waits until the node has `count` connections for a topic.
    pub(crate) fn wait_until_connected(&self, topic: &str, count: usize) -> Result<()> {
        let deadline = Instant::now() + PATIENCE;
        loop {
            let found = self.count_connections(topic)?;
            if found == count {
                return Ok(());
            }
            ensure!(Instant::now() < deadline, "{topic} has {found} connections and not {count}");
            std::thread::sleep(Duration::from_millis(2));
        }
    }

    fn count_connections(&self, topic: &str) -> Result<usize> {
        let caller = ["/bench".into()];
        let call = self.raw.other.call("getBusInfo", &caller, PATIENCE);
        let answer = self.runtime.block_on(call)?;
        let rows = answer.as_array().and_then(|answer| answer.get(2)?.as_array());
        let about =
            |row: &&Value| row.as_array().and_then(|row| row.get(4)?.as_str()).is_some_and(|found| found == topic);
        Ok(rows.context("rows")?.iter().filter(about).count())
    }

    /// Returns the credit of one of the node's sources: the source publishes as many messages as it is granted.
    pub(crate) fn credit(&self, topic: &str) -> Result<PublishCredit> {
        let topic = format!("{topic}_credit");
        let publisher =
            self.runtime.block_on(self.bus.advertise(&topic, UINT32.into(), QosProfile::keep_last(1000)))?;
        self.wait_until_connected(&topic, 1)?;
        Ok(PublishCredit(publisher))
    }

    /// Returns the message count of one of the node's sinks; the calling thread is unparked whenever it grows.
    pub(crate) fn message_count(&self, topic: &str) -> Result<MessageCount> {
        let count = Arc::new(AtomicU64::new(0));
        let counted = count.clone();
        let asking = std::thread::current();
        let topic = format!("{topic}_count");
        let mut subscription =
            self.runtime.block_on(self.bus.subscribe(&topic, UINT32.into(), QosProfile::keep_last(1000)))?;
        self.runtime.spawn(async move {
            let _subscribed = &subscription.guard;
            while let Some(message) = subscription.messages.recv().await {
                if let Ok(bytes) = message.bytes.as_ref().try_into() {
                    counted.store(u32::from_le_bytes(bytes).into(), Ordering::Relaxed);
                    asking.unpark();
                }
            }
        });
        self.wait_until_connected(&topic, 1)?;
        Ok(MessageCount(count))
    }
}

const UINT32: TypeDescription =
    TypeDescription { name: "std_msgs/UInt32", md5: "304a39449588c7f8ce2df6e8001c5fce", definition: "uint32 data\n" };

/// A message type, as connection headers describe it.
#[derive(Debug, Clone, Copy)]
pub(crate) struct TypeDescription {
    pub(crate) name: &'static str,
    pub(crate) md5: &'static str,
    pub(crate) definition: &'static str,
}

/// Type of the small message.
pub(crate) const STRING: TypeDescription =
    TypeDescription { name: "std_msgs/String", md5: "992ce8a1687cec8c8bd883ec73ca41d1", definition: "string data\n" };

/// Type of the large message.
pub(crate) const IMAGE: TypeDescription = TypeDescription {
    name: "sensor_msgs/Image",
    md5: "060021388200f6f0f447d0fcd9c64743",
    definition: "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 \
        step\n\
        uint8[] data\n\
        ================================================================================\nMSG: std_msgs/Header\n\
        uint32 seq\ntime stamp\nstring frame_id\n",
};

impl From<TypeDescription> for WireType {
    fn from(from: TypeDescription) -> Self {
        Self::new(from.name, from.md5, from.definition)
    }
}

/// See [`MeterNode::credit`].
pub(crate) struct PublishCredit(Box<dyn Publisher>);

impl PublishCredit {
    pub(crate) fn grant(&self, messages: u32) {
        self.0.publish(Bytes::copy_from_slice(&messages.to_le_bytes()));
    }
}

/// See [`MeterNode::message_count`].
pub(crate) struct MessageCount(Arc<AtomicU64>);

impl MessageCount {
    pub(crate) fn get(&self) -> u64 {
        self.0.load(Ordering::Relaxed)
    }
}
