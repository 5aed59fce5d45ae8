//! How many messages pass in a second.

use std::future::Future;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use bytes::Bytes;
use ros::bus::{Bus, Qos};
use ros::codec::{self, CborOptions, JsonOptions};
use rosbridge::{Format, Publish, Writer};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::sync::Notify;

use crate::Failure;
use crate::world::{World, frame, wire_type};

pub const ROUND: Duration = Duration::from_secs(2);

/// What the receiver tells the sender.
#[derive(Default)]
pub struct Progress {
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
pub async fn rate<F: Future<Output = Result<(), Failure>>>(
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

pub async fn relayed(world: &World, size: usize, window: u64) -> Result<f64, Failure> {
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

/// Node to client.
pub fn out(
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
    let publisher = world.theirs.block_on(world.node.advertise(
        &topic,
        wire_type(world, type_name)?,
        Qos::keep_last(1000),
    ))?;
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
        publisher
            .matched()
            .wait_for(|now| now.connected() > 0)
            .await?;
        rate(&received, window, || {
            publisher.publish(message.clone());
            async { Ok(()) }
        })
        .await
    });
    reader.abort();
    found
}

pub async fn count_frames(mut stream: TcpStream, count: &Progress) -> Result<(), Failure> {
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
pub fn inward(
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
    let mut subscription = world.theirs.block_on(world.node.subscribe(
        &topic,
        wire_type(world, type_name)?,
        Qos::keep_last(1000),
    ))?;
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
