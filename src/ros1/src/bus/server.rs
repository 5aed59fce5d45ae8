//! The TCPROS server: accepts subscribers of our topics and callers of our services.

use std::sync::Arc;
use std::time::Duration;

use bytes::BytesMut;
use ros_bus::{WireType, net};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::{TcpListener, TcpStream};
use tokio::time::{Instant, timeout, timeout_at};

use super::services;
use super::state::{FAREWELL, HANDSHAKE, Ros1BusState, wire_type_from_header};
use super::topic_out::{Subscriber, TopicOut};
use crate::tcpros::{Error, Header};

/// Maximum number of connections; further ones wait in the backlog.
const MAX_CONNECTIONS: usize = 4000;
/// Time for which a subscriber of a topic that is not advertised is kept waiting. rospy does not connect again to a
/// publisher to which it is still connected: if it were sent away and the topic advertised before it noticed, it would
/// never come back. Longer than a query for the subscribers' types takes, which is often followed by a publication of
/// ours.
const ADVERTISE_TIMEOUT: Duration = Duration::from_secs(4);

/// Serves until dropped, which also ends every connection.
pub(super) async fn serve(bus: Arc<Ros1BusState>, listener: TcpListener) {
    let connected = |stream| {
        let bus = bus.clone();
        async move { serve_connection(&bus, stream).await }
    };
    net::serve_connections(listener, MAX_CONNECTIONS, "TCPROS", connected).await;
}

async fn serve_connection(bus: &Arc<Ros1BusState>, mut stream: TcpStream) -> Result<(), Error> {
    let mut buffer = BytesMut::new();
    let header = match timeout(HANDSHAKE, Header::read(&mut stream, &mut buffer)).await {
        Ok(header) => header?,
        Err(_) => return Err(Error::Header("it did not come in time".to_owned())),
    };
    if let Some(service) = header.get("service") {
        return services::serve_caller(bus, service, &header, stream, buffer).await;
    }
    let Some(name) = header.get("topic") else {
        return refuse(stream, "the header names neither a topic nor a service").await;
    };
    serve_subscriber(bus, name, &header, stream).await
}

/// Sends the reason and closes the connection.
pub(super) async fn refuse(mut stream: TcpStream, reason: &str) -> Result<(), Error> {
    Header::error(reason).write(&mut stream).await?;
    Ok(stream.shutdown().await?)
}

/// A subscriber that has declared the type it requests.
struct PendingSubscriber<'a> {
    bus: &'a Ros1BusState,
    name: &'a str,
    asked: &'a WireType,
    /// Number of the last query that was told the requested type.
    told: Option<i32>,
}

impl PendingSubscriber<'_> {
    /// Waits until the topic is advertised; `None` if that takes longer than [`ADVERTISE_TIMEOUT`]. Queries that arrive
    /// meanwhile are told the requested type, and restart the time limit.
    async fn wait_until_advertised(&mut self) -> Option<(Arc<TopicOut>, WireType, bool)> {
        let mut latest = Instant::now() + ADVERTISE_TIMEOUT;
        loop {
            let mut next = std::pin::pin!(self.bus.publishing.notified());
            next.as_mut().enable();
            let topic = self.bus.publications.lock().get(self.name).cloned();
            if let Some(topic) = topic {
                if let Some(told) = topic.forward_requested_type(self.asked, self.told) {
                    self.told = Some(told);
                    latest = Instant::now() + ADVERTISE_TIMEOUT;
                }
                if let Some((advert, latching)) = topic.advert() {
                    return Some((topic, advert, latching));
                }
            }
            timeout_at(latest, next).await.ok()?;
        }
    }
}

async fn serve_subscriber(
    bus: &Arc<Ros1BusState>,
    name: &str,
    header: &Header,
    mut stream: TcpStream,
) -> Result<(), Error> {
    let asked = &wire_type_from_header(header);
    let caller = header.get("callerid").unwrap_or("unknown");
    let mut waiting = PendingSubscriber { bus, name, asked, told: None };
    let Some((topic, advert, latching)) = waiting.wait_until_advertised().await else {
        if waiting.told.is_some() {
            // It was only queried for its type: close without a reason, or it would log an error.
            return Ok(());
        }
        let node = &bus.node;
        return refuse(stream, &format!("{node} does not publish {name}")).await;
    };
    if !asked.is_compatible_with(&advert) {
        let reason = format!(
            "{caller} wants topic {name} to have datatype/md5sum [{}/{}], but our version has [{}/{}]; \
             dropping connection",
            asked.name, asked.digest, advert.name, advert.digest
        );
        tracing::warn!(topic = name, reason, "a subscriber was refused");
        return refuse(stream, &reason).await;
    }
    let Some(subscriber) = topic.attach(bus.next_id(), caller) else {
        return Ok(());
    };
    let attached = AttachedSubscriber { topic: &topic, subscriber };
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

/// A subscriber in its topic's list; removed when dropped.
struct AttachedSubscriber<'a> {
    topic: &'a TopicOut,
    subscriber: Arc<Subscriber>,
}

impl AttachedSubscriber<'_> {
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

impl Drop for AttachedSubscriber<'_> {
    fn drop(&mut self) {
        self.topic.detach(&self.subscriber);
    }
}
