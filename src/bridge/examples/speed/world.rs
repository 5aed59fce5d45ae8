//! Node, bridge and relay, each where it listens.

use std::net::SocketAddr;
use std::sync::Arc;

use bridge::{Bridge, BridgeOptions, SessionOptions};
use bytes::Bytes;
use ros::bus::WireType;
use ros::codec;
use ros::net::HostSockets;
use ros::ros1::Ros1Bus;
use ros::ros1::master::{Master, MasterOptions};
use ros::schema::Registry;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpListener;
use tokio::runtime::{Builder, Runtime};

use crate::Failure;

pub struct World {
    pub node: Arc<Ros1Bus>,
    pub portal: SocketAddr,
    pub relay: SocketAddr,
    pub registry: Arc<Registry>,
    pub ours: Runtime,
    pub theirs: Runtime,
    pub _bridge: Runtime,
}

pub fn world() -> Result<World, Failure> {
    let runtime = |workers| {
        Builder::new_multi_thread()
            .worker_threads(workers)
            .enable_all()
            .build()
    };
    let (ours, theirs, bridge) = (runtime(1)?, runtime(1)?, runtime(2)?);
    let registry = Arc::new(Registry::new());
    registry.insert("std_msgs/String", "string data\n")?;
    registry.insert("x/srv/Echo", "string data\n---\nstring data\n")?;
    let image = "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step\nuint8[] data\n";
    registry.insert("sensor_msgs/Image", image)?;
    let master = bridge.block_on(async {
        let listener = TcpListener::bind("127.0.0.1:0").await?;
        let address = listener.local_addr()?;
        let master = Master::new(MasterOptions {
            uri: format!("http://{address}/"),
            ..MasterOptions::default()
        });
        tokio::spawn(async move { master.serve(listener, Arc::new(HostSockets)).await });
        Ok::<_, Failure>(address)
    })?;
    let node = theirs.block_on(Ros1Bus::connect(Arc::new(HostSockets), master, "/node"))?;
    let definitions = registry.clone();
    let (portal, relay) = bridge.block_on(async {
        let bus = Ros1Bus::connect(Arc::new(HostSockets), master, "/cloudroid_bridge").await?;
        let bridge = Bridge::new(bus, definitions, BridgeOptions::default());
        let portal = TcpListener::bind("127.0.0.1:0").await?;
        let relay = TcpListener::bind("127.0.0.1:0").await?;
        let addresses = (portal.local_addr()?, relay.local_addr()?);
        tokio::spawn(async move {
            while let Ok((stream, _)) = portal.accept().await {
                let bridge = bridge.clone();
                let _ = stream.set_nodelay(true);
                tokio::spawn(async move { bridge.serve(stream, SessionOptions::default()).await });
            }
        });
        tokio::spawn(async move {
            while let (Ok((mut from, _)), Ok((mut to, _))) =
                (relay.accept().await, relay.accept().await)
            {
                let _ = to.set_nodelay(true);
                tokio::spawn(async move {
                    let mut buffer = vec![0; 256 * 1024];
                    while let Ok(count @ 1..) = from.read(&mut buffer).await {
                        if to.write_all(&buffer[..count]).await.is_err() {
                            return;
                        }
                    }
                });
            }
        });
        Ok::<_, Failure>(addresses)
    })?;
    Ok(World {
        node,
        portal,
        relay,
        registry,
        ours,
        theirs,
        _bridge: bridge,
    })
}

pub fn message(world: &World, type_name: &str, size: usize) -> Result<Bytes, Failure> {
    let mut bytes = Vec::new();
    if type_name == "sensor_msgs/Image" {
        bytes.extend_from_slice(&[0; 12]);
        bytes.extend_from_slice(b"\x03\0\0\0cam");
        bytes.extend_from_slice(&480u32.to_le_bytes());
        bytes.extend_from_slice(&640u32.to_le_bytes());
        bytes.extend_from_slice(b"\x04\0\0\0rgb8\0");
        bytes.extend_from_slice(&1920u32.to_le_bytes());
    }
    bytes.extend_from_slice(&(size as u32).to_le_bytes());
    bytes.extend((0..size).map(|at| b'a' + (at * 7 % 26) as u8));
    codec::validate(&*world.registry.message(type_name)?, &bytes)?;
    Ok(bytes.into())
}

pub fn wire_type(world: &World, type_name: &str) -> Result<WireType, Failure> {
    let found = world.registry.message(type_name)?;
    Ok(WireType::of(&found))
}

/// A masked text or binary frame; the mask is zero, which costs the server the same.
pub fn frame(opcode: u8, payload: &[u8]) -> Vec<u8> {
    let mut out = vec![0x80 | opcode, 0x80 | 127];
    out.extend_from_slice(&(payload.len() as u64).to_be_bytes());
    out.extend_from_slice(&[0; 4]);
    out.extend_from_slice(payload);
    out
}
