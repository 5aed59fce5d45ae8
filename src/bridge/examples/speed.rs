//! How fast messages pass the bridge, beside a relay that only moves bytes over the same hops:
//! `cargo run --release -p bridge --example speed [PART OF A TITLE]`.
//!
//! Node, bridge and client have a runtime each, all on loopback. Sender and receiver keep a window of messages under
//! way, so nothing is dropped and the slowest hop decides.

use std::future::Future;
use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use bridge::{Bridge, BridgeOptions, SessionOptions};
use bytes::Bytes;
use ros::bus::{AdvertiseOptions, Bus, SubscribeOptions, WireType};
use ros::codec::{self, CborOptions, JsonOptions};
use ros::net::HostSockets;
use ros::ros1::Ros1Bus;
use ros::ros1::master::{Master, MasterOptions};
use ros::schema::Registry;
use rosbridge::{Format, Publish, Writer};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio::runtime::{Builder, Runtime};
use tokio::sync::Notify;

const ROUND: Duration = Duration::from_secs(2);

type Failure = Box<dyn std::error::Error + Send + Sync>;

struct World {
    node: Arc<Ros1Bus>,
    portal: SocketAddr,
    relay: SocketAddr,
    registry: Arc<Registry>,
    ours: Runtime,
    theirs: Runtime,
    _bridge: Runtime,
}

fn main() -> Result<(), Failure> {
    let only = std::env::args().nth(1).unwrap_or_default();
    let world = world()?;
    for (title, type_name, size, window) in [
        ("string", "std_msgs/String", 20, 64),
        ("image", "sensor_msgs/Image", 921_600, 8),
    ] {
        let message = message(&world, type_name, size)?;
        let floor = world
            .theirs
            .block_on(relayed(&world, message.len(), window))?;
        println!(
            "\n{title}, {} bytes of ROS; byte relay {floor:.0}/s",
            message.len()
        );
        let show = |what: &str, rate: f64| {
            println!("  {what:<24}{rate:>10.0}/s {:>6.1} %", rate / floor * 100.0)
        };
        for encoding in ["none", "cbor", "cbor-raw"] {
            let what = format!("{title} out {encoding}");
            if what.contains(&only) {
                show(&what, out(&world, type_name, &message, encoding, window)?);
            }
        }
        for encoding in ["none", "cbor", "cbor-raw"] {
            let what = format!("{title} in {encoding}");
            if what.contains(&only) {
                show(
                    &what,
                    inward(&world, type_name, &message, encoding, window)?,
                );
            }
        }
    }
    Ok(())
}

fn world() -> Result<World, Failure> {
    let runtime = |workers| {
        Builder::new_multi_thread()
            .worker_threads(workers)
            .enable_all()
            .build()
    };
    let (ours, theirs, bridge) = (runtime(1)?, runtime(1)?, runtime(2)?);
    let registry = Arc::new(Registry::new());
    registry.insert("std_msgs/String", "string data\n")?;
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

fn message(world: &World, type_name: &str, size: usize) -> Result<Bytes, Failure> {
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

/// What the receiver tells the sender.
#[derive(Default)]
struct Progress {
    received: AtomicU64,
    changed: Notify,
}

impl Progress {
    fn set(&self, received: u64) {
        if self.received.swap(received, Ordering::Relaxed) != received {
            self.changed.notify_one();
        }
    }

    fn add(&self) {
        self.received.fetch_add(1, Ordering::Relaxed);
        self.changed.notify_one();
    }
}

/// Messages per second that `send` manages while `received` follows within the window.
async fn rate<F: Future<Output = Result<(), Failure>>>(
    progress: &Progress,
    window: u64,
    mut send: impl FnMut() -> F,
) -> Result<f64, Failure> {
    let base = progress.received.load(Ordering::Relaxed);
    let (mut sent, mut counted) = (0, None);
    let begun = Instant::now();
    loop {
        let got = progress.received.load(Ordering::Relaxed) - base;
        if sent - got < window {
            send().await?;
            sent += 1;
            continue;
        }
        // The first tenth warms caches and windows up.
        if counted.is_none() && begun.elapsed() > ROUND / 10 {
            counted = Some((got, Instant::now()));
        }
        if begun.elapsed() > ROUND {
            let (first, since) = counted.unwrap_or((0, begun));
            return Ok((got - first) as f64 / since.elapsed().as_secs_f64());
        }
        progress.changed.notified().await;
    }
}

async fn relayed(world: &World, size: usize, window: u64) -> Result<f64, Failure> {
    let mut from = TcpStream::connect(world.relay).await?;
    let mut to = TcpStream::connect(world.relay).await?;
    from.set_nodelay(true)?;
    let received = Arc::new(Progress::default());
    let count = received.clone();
    let reader = world.ours.spawn(async move {
        let (mut buffer, mut bytes) = (vec![0; 1 << 20], 0);
        while let Ok(read @ 1..) = to.read(&mut buffer).await {
            bytes += read as u64;
            count.set(bytes / size as u64);
        }
    });
    let message = vec![7; size];
    let writer = Arc::new(tokio::sync::Mutex::new((&mut from, message)));
    let found = rate(&received, window, || {
        let writer = writer.clone();
        async move {
            let (from, message) = &mut *writer.lock().await;
            Ok(from.write_all(message).await?)
        }
    })
    .await;
    reader.abort();
    found
}

fn wire_type(world: &World, type_name: &str) -> Result<WireType, Failure> {
    let found = world.registry.message(type_name)?;
    Ok(WireType {
        name: type_name.to_owned(),
        md5: found.md5().to_owned(),
        definition: found.full_text().to_owned(),
    })
}

/// A masked text or binary frame; the mask is zero, which costs the server the same.
fn frame(opcode: u8, payload: &[u8]) -> Vec<u8> {
    let mut out = vec![0x80 | opcode, 0x80 | 127];
    out.extend_from_slice(&(payload.len() as u64).to_be_bytes());
    out.extend_from_slice(&[0; 4]);
    out.extend_from_slice(payload);
    out
}

/// Node to client.
fn out(
    world: &World,
    type_name: &str,
    message: &Bytes,
    encoding: &str,
    window: u64,
) -> Result<f64, Failure> {
    let topic = format!(
        "/out/{}/{}",
        type_name.replace('/', "_"),
        encoding.replace('-', "_")
    );
    let received = Arc::new(Progress::default());
    let options = AdvertiseOptions {
        wire_type: wire_type(world, type_name)?,
        latch: false,
        queue: 1000,
    };
    let publisher = world
        .theirs
        .block_on(world.node.advertise(&topic, options))?;
    let subscribe = format!(
        r#"{{"op":"subscribe","topic":"{topic}","type":"{type_name}","compression":"{encoding}"}}"#
    );
    let (count, portal) = (received.clone(), world.portal);
    let reader = world.ours.spawn(async move {
        let mut stream = TcpStream::connect(portal).await?;
        stream.write_all(&frame(1, subscribe.as_bytes())).await?;
        count_frames(stream, &count).await
    });
    let found = world.theirs.block_on(async {
        publisher.subscribers().wait_for(|count| *count > 0).await?;
        rate(&received, window, || {
            publisher.publish(message.clone());
            async { Ok(()) }
        })
        .await
    });
    reader.abort();
    found
}

async fn count_frames(mut stream: TcpStream, count: &Progress) -> Result<(), Failure> {
    let mut buffer = vec![0; 1 << 20];
    let (mut header, mut left) = (Vec::new(), 0usize);
    loop {
        let read = stream.read(&mut buffer).await?;
        if read == 0 {
            return Ok(());
        }
        let mut rest = &buffer[..read];
        while !rest.is_empty() {
            if left > 0 {
                let taken = left.min(rest.len());
                left -= taken;
                rest = &rest[taken..];
                if left == 0 {
                    count.add();
                }
                continue;
            }
            header.push(rest[0]);
            rest = &rest[1..];
            let short = usize::from(header.get(1).copied().unwrap_or(0));
            let width = [0, 2, 8][usize::from(short == 126) + 2 * usize::from(short == 127)];
            if header.len() == 2 + width && header.len() > 1 {
                left = match width {
                    0 => short,
                    _ => header[2..]
                        .iter()
                        .fold(0, |sum, byte| sum << 8 | usize::from(*byte)),
                };
                header.clear();
            }
        }
    }
}

/// Client to node.
fn inward(
    world: &World,
    type_name: &str,
    message: &Bytes,
    encoding: &str,
    window: u64,
) -> Result<f64, Failure> {
    let topic = format!(
        "/in/{}/{}",
        type_name.replace('/', "_"),
        encoding.replace('-', "_")
    );
    let found = world.registry.message(type_name)?;
    let mut payload = Vec::new();
    let opcode = match encoding {
        "none" => {
            Publish::print_with(&mut payload, Format::Json, &topic, |out| {
                codec::to_json(&found, message, out, &JsonOptions::default())
            })?;
            1
        }
        "cbor" => {
            Publish::print_with(&mut payload, Format::Cbor, &topic, |out| {
                codec::to_cbor(&found, message, out, &CborOptions::default())
            })?;
            2
        }
        _ => {
            let mut writer = Writer::op(&mut payload, Format::Cbor, "publish", None);
            writer.text("topic", &topic);
            writer.text("compression", "cbor-raw");
            writer.raw("msg", None, message);
            writer.end();
            2
        }
    };
    let payload = frame(opcode, &payload);
    let options = SubscribeOptions {
        wire_type: Some(wire_type(world, type_name)?),
        queue: 1000,
    };
    let mut subscription = world
        .theirs
        .block_on(world.node.subscribe(&topic, options))?;
    let received = Arc::new(Progress::default());
    let count = received.clone();
    let reader = world.theirs.spawn(async move {
        while subscription.messages.recv().await.is_some() {
            count.add();
        }
    });
    let rate = world.ours.block_on(async {
        let mut stream = TcpStream::connect(world.portal).await?;
        stream.set_nodelay(true)?;
        let advertise = format!(r#"{{"op":"advertise","topic":"{topic}","type":"{type_name}"}}"#);
        stream.write_all(&frame(1, advertise.as_bytes())).await?;
        stream.write_all(&payload).await?;
        received.changed.notified().await;
        let writer = Arc::new(tokio::sync::Mutex::new((stream, payload)));
        rate(&received, window, || {
            let writer = writer.clone();
            async move {
                let (stream, payload) = &mut *writer.lock().await;
                Ok(stream.write_all(payload).await?)
            }
        })
        .await
    });
    reader.abort();
    rate
}
