//! Detection of silently vanished peers on every connection by kernel keepalive. The test runs in its own process,
//! because it checks all connections of the process.

use std::collections::BTreeSet;
use std::net::SocketAddr;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use bytes::Bytes;
use ros_bus::net::{HostSockets, Sockets};
use ros_bus::{Bus, FailureReason, ParamValue, QosProfile, ServiceHandler, ServiceType, WireType};
use ros1::Ros1Bus;
use ros1::master::{Master, MasterOptions};
use tokio::time::timeout;

/// Time limit of a failing test only.
const PATIENCE: Duration = Duration::from_secs(60);

struct Echo;

#[async_trait]
impl ServiceHandler for Echo {
    async fn call(&self, request: Bytes, _: &str) -> Result<Bytes, FailureReason> {
        Ok(request)
    }
}

/// Returns the inodes of this process's sockets.
fn own_sockets() -> BTreeSet<u64> {
    let inode = |link: &Path| {
        let name = link.to_str()?.strip_prefix("socket:[")?;
        name.strip_suffix(']')?.parse().ok()
    };
    let all = std::fs::read_dir("/proc/self/fd").unwrap();
    all.filter_map(|entry| inode(&std::fs::read_link(entry.ok()?.path()).ok()?)).collect()
}

/// Returns this process's established connections: local and remote port as formatted by the kernel, and whether a
/// keepalive timer is running (proc(5), net/tcp: state 01, timer 02).
fn connections() -> Vec<(String, bool)> {
    let own = own_sockets();
    let table = std::fs::read_to_string("/proc/self/net/tcp").unwrap();
    let row = |line: &str| {
        let fields: Vec<&str> = line.split_whitespace().collect();
        let established = fields[3] == "01" && own.contains(&fields[9].parse().ok()?);
        let asks = fields[5].starts_with("02:");
        established.then(|| (format!("{} {}", fields[1], fields[2]), asks))
    };
    table.lines().skip(1).filter_map(row).collect()
}

#[tokio::test]
async fn every_connection_notices_when_its_peer_is_gone() {
    let listener = HostSockets.listen(SocketAddr::from(([127, 0, 0, 1], 0))).await.unwrap();
    let address = listener.local_addr().unwrap();
    let master = Master::new(MasterOptions::default());
    tokio::spawn(async move { master.serve(listener, Arc::new(HostSockets)).await });
    let join = |name: &'static str| Ros1Bus::connect(Arc::new(HostSockets), address, name);
    let (one, two) = (join("/one").await.unwrap(), join("/two").await.unwrap());
    let wire_type = WireType::new("std_msgs/Empty", "d41d8cd98f00b204e9800998ecf8427e", "");
    let publisher = one.advertise("/said", wire_type.clone(), QosProfile::keep_last(1).latching(true)).await.unwrap();
    publisher.publish(Bytes::new());
    let mut subscription = two.subscribe("/said", wire_type, QosProfile::keep_last(1)).await.unwrap();
    let heard = timeout(PATIENCE, subscription.messages.recv()).await;
    heard.unwrap().unwrap();
    let of = ServiceType::new("tests/Echo", "0123456789abcdef0123456789abcdef");
    let _serving = one.serve("/echo", of, Arc::new(Echo)).await.unwrap();
    let answer = two.call("/echo", Bytes::from_static(b"hi"), PATIENCE).await;
    assert_eq!(answer.unwrap(), "hi");
    two.parameters().unwrap().set("/p", ParamValue::Int(1)).await.unwrap();
    // A connection with unacknowledged data has another timer until that is acknowledged.
    let quiet = async {
        loop {
            let all = connections();
            if all.len() >= 8 && all.iter().all(|(_, asks)| *asks) {
                return;
            }
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    };
    // The topic, the service and the Master, both ends of each, and the kept XML-RPC connections.
    if timeout(PATIENCE, quiet).await.is_err() {
        panic!("some are not asked after: {:?}", connections());
    }
}
