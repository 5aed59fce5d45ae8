//! The connection to one publisher of one topic: located by `requestTopic`, re-established for as long as the publisher
//! is listed.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

use bytes::BytesMut;
use parking_lot::Mutex;
use ros_bus::{BusError, Offer, PeerId, SerializedMessage, WireType, net};
use tokio::net::TcpStream;
use tokio::sync::watch;
use tokio::time::{sleep, timeout};

use super::master_client::to_bus_error;
use super::state::{HANDSHAKE, Ros1BusState, wire_type_from_header};
use super::topic_in::{PublisherLink, TopicIn};
use crate::reply::ApiReply;
use crate::tcpros::{self, FrameReader, Header};
use crate::xmlrpc::Value;

/// Pause between attempts: initial and maximum.
const PAUSE: Duration = Duration::from_millis(50);
const LONGEST_PAUSE: Duration = Duration::from_secs(5);
/// Grace period for a publisher that is no longer listed; it may still have messages in transit.
const GRACE: Duration = Duration::from_secs(2);

impl PublisherLink {
    pub(super) fn uri(&self) -> &str {
        &self.uri
    }

    pub(super) fn is_listed(&self) -> bool {
        *self.listed.borrow()
    }

    pub(super) fn set_listed(&self, listed: bool) {
        self.listed.send_if_modified(|before| std::mem::replace(before, listed) != listed);
    }

    pub(super) fn abort(&self) {
        if let Some(task) = self.task.lock().take() {
            task.abort();
        }
    }

    /// Returns the type declared by the publisher, once it was connected.
    pub(super) fn wire_type(&self) -> Option<Arc<WireType>> {
        Some(self.offer.lock().as_ref()?.wire_type.clone())
    }

    /// Returns the publisher's offer, once it was connected.
    pub(super) fn offer(&self) -> Option<Offer> {
        self.offer.lock().clone()
    }
}

/// Starts to maintain a connection to the publisher at `uri`.
pub(super) fn start(bus: &Arc<Ros1BusState>, topic: &Arc<TopicIn>, uri: &str) -> Arc<PublisherLink> {
    let link = Arc::new(PublisherLink {
        id: bus.next_id(),
        uri: uri.to_owned(),
        listed: watch::Sender::new(true),
        task: Mutex::new(None),
        offer: Mutex::new(None),
        publisher: Mutex::new(None),
        connected: AtomicBool::new(false),
        messages: AtomicU64::new(0),
        bytes: AtomicU64::new(0),
    });
    let task = bus.spawn(maintain_connection(bus.clone(), topic.clone(), link.clone()));
    *link.task.lock() = Some(task);
    link
}

async fn maintain_connection(bus: Arc<Ros1BusState>, topic: Arc<TopicIn>, link: Arc<PublisherLink>) {
    let mut listed = link.listed.subscribe();
    let mut pause = PAUSE;
    let mut told = String::new();
    loop {
        let result = tokio::select! {
            result = connect_and_read(&bus, &topic, &link) => result,
            () = wait_until_unlisted(&mut listed, GRACE) => Ok(()),
        };
        if topic.on_disconnected(&link) {
            pause = PAUSE;
        } else {
            // Not even a connection: the previous one has ended for good.
            topic.on_publisher_gone(&link);
        }
        if let Err(error) = result {
            let text = error.to_string();
            if text != told {
                tracing::warn!(topic = topic.name, publisher = link.uri, %error, "cannot read from publisher");
                told = text;
            }
        }
        tokio::select! {
            () = sleep(pause) => {}
            () = wait_until_unlisted(&mut listed, Duration::ZERO) => {}
        }
        pause = (pause * 2).min(LONGEST_PAUSE);
        if !link.is_listed() && topic.release(&link) {
            return;
        }
    }
}

/// Returns when the publisher has not been listed for `grace`.
async fn wait_until_unlisted(listed: &mut watch::Receiver<bool>, grace: Duration) {
    loop {
        if listed.wait_for(|listed| !listed).await.is_err() {
            return;
        }
        match timeout(grace, listed.wait_for(|listed| *listed)).await {
            Ok(Ok(_)) => {}
            Ok(Err(_)) | Err(_) => return,
        }
    }
}

async fn connect_and_read(
    bus: &Arc<Ros1BusState>,
    topic: &Arc<TopicIn>,
    link: &Arc<PublisherLink>,
) -> Result<(), BusError> {
    let wanted = topic.requested_type();
    let connection = connect(bus, &topic.name, &link.uri, &wanted).await?;
    let PublisherConnection { mut stream, mut frames, publisher, latching, wire_type } = connection;
    let wire_type = Arc::new(wire_type);
    *link.offer.lock() = Some(Offer { wire_type: wire_type.clone(), latching, kept: None });
    topic.on_connected(link, &publisher);
    loop {
        let next = frames.next(&mut stream).await;
        let Some(bytes) = next.map_err(|error| from_tcpros_error(&link.uri, error))? else {
            return Ok(());
        };
        link.messages.fetch_add(1, Ordering::Relaxed);
        link.bytes.fetch_add(bytes.len() as u64, Ordering::Relaxed);
        topic.deliver(
            &link.uri,
            SerializedMessage { bytes, wire_type: wire_type.clone(), publisher: publisher.clone(), latching },
        );
    }
}

/// An established connection to a publisher that has answered our header.
pub(super) struct PublisherConnection {
    stream: TcpStream,
    frames: FrameReader,
    publisher: PeerId,
    latching: bool,
    pub(super) wire_type: WireType,
}

/// Requests the topic from the node at `uri`, connects and exchanges headers.
pub(super) async fn connect(
    bus: &Ros1BusState,
    topic: &str,
    uri: &str,
    wanted: &WireType,
) -> Result<PublisherConnection, BusError> {
    let (host, port) = request_topic(bus, topic, uri).await?;
    let what = || format!("publisher of {topic} at {host}:{port}");
    let header = Header::new([
        ("callerid", bus.node.as_str()),
        ("topic", topic),
        ("type", &wanted.name),
        ("md5sum", wanted.digest.as_str()),
        ("tcp_nodelay", "1"),
    ]);
    let mut buffer = BytesMut::new();
    let shake = async {
        let address = bus.sockets.resolve(&host, port).await?;
        let mut stream = bus.sockets.connect(address).await?;
        net::enable_keepalive(&stream);
        let answer = header.exchange(&mut stream, &mut buffer).await?;
        Ok((stream, answer))
    };
    let (stream, answer) = match timeout(HANDSHAKE, shake).await {
        Ok(shaken) => shaken.map_err(|error| from_tcpros_error(&what(), error))?,
        Err(_) => {
            return Err(BusError::Timeout { what: what(), after: HANDSHAKE });
        }
    };
    let wire_type = wire_type_from_header(&answer);
    if !wanted.is_compatible_with(&wire_type) {
        return Err(BusError::TypeMismatch {
            what: topic.to_owned(),
            theirs: wire_type.to_string(),
            ours: wanted.to_string(),
        });
    }
    Ok(PublisherConnection {
        stream,
        frames: FrameReader::new(buffer, bus.frames.clone()),
        publisher: PeerId::new(answer.get("callerid").unwrap_or(uri), 0),
        latching: answer.flag("latching"),
        wire_type,
    })
}

/// Returns host and port at which the node at `uri` serves the topic.
async fn request_topic(bus: &Ros1BusState, topic: &str, uri: &str) -> Result<(String, u16), BusError> {
    let client = bus.client(uri)?;
    let protocols = Value::Array(vec![Value::strings(["TCPROS"])]);
    let args = [bus.node.as_str().into(), topic.into(), protocols];
    let answer = client.call("requestTopic", &args, HANDSHAKE).await;
    let refused = |reason: String| BusError::Protocol { what: format!("requestTopic of {uri}"), reason };
    let reply = ApiReply::from_value(answer.map_err(to_bus_error)?)
        .ok_or_else(|| refused("its answer is not [code, message, value]".to_owned()))?;
    if reply.code != 1 {
        return Err(refused(format!("it declined: {}", reply.message)));
    }
    let place = match reply.value.as_array() {
        Some([Value::String(protocol), Value::String(host), Value::Int(port)]) if protocol == "TCPROS" => {
            u16::try_from(*port).ok().map(|port| (host.clone(), port))
        }
        _ => None,
    };
    place.ok_or_else(|| refused("it offers no TCPROS address".to_owned()))
}

/// Converts a TCPROS error to a bus error.
pub(super) fn from_tcpros_error(what: &str, error: tcpros::Error) -> BusError {
    let what = what.to_owned();
    match error {
        tcpros::Error::Io(source) => BusError::Io { what, source },
        other => BusError::Protocol { what, reason: other.to_string() },
    }
}
