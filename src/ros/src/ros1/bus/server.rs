//! The TCPROS server: subscribers of our topics and callers of our services connect here.

use std::sync::Arc;
use std::time::Duration;

use bytes::BytesMut;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::{TcpListener, TcpStream};
use tokio::time::{Instant, timeout, timeout_at};

use super::publications::{Subscriber, TopicOut};
use super::{FAREWELL, HANDSHAKE, Inner, services};
use crate::bus::WireType;
use crate::net;
use crate::ros1::tcpros::{Error, Header};

/// Connections at a time; further ones wait in the backlog.
const MAX_CONNECTIONS: usize = 4000;
/// How long a subscriber of a topic that is not advertised is kept waiting. rospy does not connect again to a publisher
/// that it is still connected to: were it sent away, and the topic advertised before it has seen that, it would never
/// come back. Longer than subscribers are asked what they want, which a publication of ours often follows.
const READVERTISED: Duration = Duration::from_secs(4);

/// Serves until dropped, which also ends every connection.
pub(super) async fn serve(bus: Arc<Inner>, listener: TcpListener) {
    let connected = |stream| {
        let bus = bus.clone();
        async move { connection(&bus, stream).await }
    };
    net::serve_each(listener, MAX_CONNECTIONS, "TCPROS", connected).await;
}

async fn connection(bus: &Arc<Inner>, mut stream: TcpStream) -> Result<(), Error> {
    let mut buffer = BytesMut::new();
    let header = match timeout(HANDSHAKE, Header::read(&mut stream, &mut buffer)).await {
        Ok(header) => header?,
        Err(_) => return Err(Error::Header("it did not come in time".to_owned())),
    };
    if let Some(service) = header.get("service") {
        return services::answer(bus, service, &header, stream, buffer).await;
    }
    let Some(name) = header.get("topic") else {
        return refuse(stream, "the header names neither a topic nor a service").await;
    };
    subscriber(bus, name, &header, stream).await
}

/// Says why not, and hangs up.
pub(super) async fn refuse(mut stream: TcpStream, reason: &str) -> Result<(), Error> {
    Header::error(reason).write(&mut stream).await?;
    Ok(stream.shutdown().await?)
}

/// A subscriber that has said what it wants.
struct Waiting<'a> {
    bus: &'a Inner,
    name: &'a str,
    asked: &'a WireType,
    /// Who was told what it asks for, last.
    told: Option<i32>,
}

impl Waiting<'_> {
    /// The topic once it is advertised; none where that takes longer than [`READVERTISED`]. Whoever wants to know
    /// meanwhile what subscribers ask for is told, and begins that time anew.
    async fn advertised(&mut self) -> Option<(Arc<TopicOut>, WireType, bool)> {
        let mut latest = Instant::now() + READVERTISED;
        loop {
            let mut next = std::pin::pin!(self.bus.publishing.notified());
            next.as_mut().enable();
            let topic = self.bus.publications.lock().get(self.name).cloned();
            if let Some(topic) = topic {
                if let Some(told) = topic.overhear(self.asked, self.told) {
                    self.told = Some(told);
                    latest = Instant::now() + READVERTISED;
                }
                if let Some((advert, latching)) = topic.advert() {
                    return Some((topic, advert, latching));
                }
            }
            timeout_at(latest, next).await.ok()?;
        }
    }
}

async fn subscriber(
    bus: &Arc<Inner>,
    name: &str,
    header: &Header,
    mut stream: TcpStream,
) -> Result<(), Error> {
    let asked = &super::announced(header);
    let caller = header.get("callerid").unwrap_or("unknown");
    let mut waiting = Waiting {
        bus,
        name,
        asked,
        told: None,
    };
    let Some((topic, advert, latching)) = waiting.advertised().await else {
        if waiting.told.is_some() {
            // It was only asked what it wants: hang up without a word, or it would log an error.
            return Ok(());
        }
        let node = &bus.node;
        return refuse(stream, &format!("{node} does not publish {name}")).await;
    };
    if !asked.agrees(&advert) {
        let reason = format!(
            "{caller} wants topic {name} to have datatype/md5sum [{}/{}], but our version has [{}/{}]; \
             dropping connection",
            asked.name, asked.digest, advert.name, advert.digest
        );
        tracing::warn!(topic = name, reason, "a subscriber was refused");
        return refuse(stream, &reason).await;
    }
    let Some(subscriber) = topic.attach(bus.id(), caller) else {
        return Ok(());
    };
    let attached = Attached {
        topic: &topic,
        subscriber,
    };
    let answer = Header::new([
        ("callerid", bus.node.as_str()),
        ("topic", name),
        ("type", &advert.name),
        ("md5sum", advert.digest.as_str()),
        ("message_definition", &advert.definition),
        ("latching", if latching { "1" } else { "0" }),
    ]);
    answer.write(&mut stream).await?;
    attached.serve(stream).await
}

/// A subscriber in its topic's list, until dropped.
struct Attached<'a> {
    topic: &'a TopicOut,
    subscriber: Arc<Subscriber>,
}

impl Attached<'_> {
    async fn serve(&self, mut stream: TcpStream) -> Result<(), Error> {
        let (mut reading, mut writing) = stream.split();
        let mut closing = self.subscriber.closing.subscribe();
        let hung_up = async {
            let mut ignored = [0; 256];
            while matches!(reading.read(&mut ignored).await, Ok(count) if count > 0) {}
        };
        let too_slow = async {
            let _ = closing.wait_for(|closing| *closing).await;
            tokio::time::sleep(FAREWELL).await;
        };
        tokio::select! {
            result = self.subscriber.send_queue.drain(&mut writing) => result?,
            () = hung_up => return Ok(()),
            () = too_slow => return Ok(()),
        }
        Ok(writing.shutdown().await?)
    }
}

impl Drop for Attached<'_> {
    fn drop(&mut self) {
        self.topic.detach(&self.subscriber);
    }
}
