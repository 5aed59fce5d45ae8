//! A session and the connections that carry it, one at a time.

mod carry;
mod encoding;
mod opening;
mod throughput;

use std::collections::BTreeMap;
use std::marker::PhantomData;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::time::Duration;

use budget::{Budget, JsonWeight, Permit};
use bytes::Bytes;
use parking_lot::Mutex;
use ros::bus::FailureReason;
use serde::Serialize;
use tokio::sync::{Notify, watch};
use tokio::time::{Instant, timeout};
use ws::WsError;

use crate::clock::{ClockFilter, ClockSample, now};
use crate::control::{ControlMessage, FromCloud, FromRobot};
use crate::drops::{Tally, TopicDropCount};
use crate::frame::ReceiveProgress;
use crate::incoming::Incoming;
use crate::outgoing::{DeliveryMode, Outgoing};
use crate::packing::SessionCodecs;
use crate::record::{Call, Data, Record};
use crate::{Error, LinkLimits, MAX_RECORD, MAX_TOLD, control};

pub use opening::{receive_open, send_open};
use throughput::{Counters, ThroughputEstimator};

/// Minimum silence timeout.
const SHORTEST: Duration = Duration::from_millis(50);
/// Minimum and maximum silence after which a connection is closed.
const SILENCE_LIMITS: (Duration, Duration) = (Duration::from_secs(3), Duration::from_secs(20));

/// Name of the memory for control messages in errors.
const CONTROL_MEMORY: &str = "what the other end of a link tells";

/// Maximum length of a response that fits into a record.
const MAX_RESPONSE: usize = MAX_RECORD - 1024;

/// Name of the memory for calls in errors; it is half of a session's, which leaves room for records in flight.
const CALL_MEMORY: &str = "calls of the other end of a link";

/// Supervision of a session's connections.
#[derive(Debug, Clone)]
pub struct SessionOptions {
    /// Ping interval while nothing else is received.
    pub ping: Duration,
    /// Time without a sign of the peer after which the link counts as down.
    pub silent: Duration,
    /// Time without a sign of the peer after which the connection is closed.
    pub lost: Duration,
    /// Age above which a message is not sent if a newer one is queued.
    pub max_age: Option<Duration>,
}

impl SessionOptions {
    /// Creates options that detect a dead link within `silent`.
    pub fn for_silence(silent: Duration, max_age: Option<Duration>) -> Self {
        let silent = silent.max(SHORTEST);
        Self {
            // A ping is sent and its pong expected within that time.
            ping: (silent / 2).min(Duration::from_secs(2)),
            silent,
            lost: (silent * 10).clamp(SILENCE_LIMITS.0, SILENCE_LIMITS.1),
            max_age,
        }
    }
}

/// Reason why a connection ended.
#[derive(Debug, thiserror::Error)]
pub enum DisconnectReason {
    /// This end closed the session.
    #[error("this side ended the link")]
    Ended,
    /// The peer closed the connection.
    #[error("the other end closed the link ({code}: {reason})")]
    Closed {
        /// WebSocket close code.
        code: u16,
        /// Reason given by the peer.
        reason: String,
    },
    /// The socket failed.
    #[error("the connection was lost: {0}")]
    Socket(String),
    /// The peer was silent for this time.
    #[error("nothing was received from the other end for {0:?}")]
    Silent(Duration),
    /// The peer violated the protocol.
    #[error(transparent)]
    Protocol(#[from] Error),
    /// More is queued for the peer than allowed; says what.
    #[error("the other end reads too slowly: {0}")]
    Full(String),
}

impl DisconnectReason {
    /// Returns the WebSocket close code and reason to send to the peer, if the connection still works.
    pub fn close_frame(&self) -> Option<(u16, String)> {
        match self {
            DisconnectReason::Protocol(Error::Refused { code, reason }) => Some((*code, reason.clone())),
            DisconnectReason::Protocol(error @ Error::Exceeded(_)) => Some((1013, error.to_string())),
            DisconnectReason::Protocol(error) => Some((1002, error.to_string())),
            DisconnectReason::Full(_) => Some((1013, self.to_string())),
            _ => None,
        }
    }
}

impl From<WsError> for DisconnectReason {
    fn from(error: WsError) -> Self {
        match error {
            WsError::Refused { code, reason } => Self::Protocol(Error::Refused { code, reason }),
            error => Self::Socket(error.to_string()),
        }
    }
}

/// Receives what a peer sends whose control messages are of type `O`.
pub trait SessionHandler<O>: Sync {
    /// Handles a record that had been received completely at `arrived` (nanoseconds since the Unix epoch). A control
    /// message or call is charged to the session's budget until `held` is dropped, so `held` is kept until the message
    /// is processed or the call answered. Must not block.
    fn on_record(&self, record: Record<O>, held: Permit, arrived: i64);
    /// Handles a message of this channel that cannot be decoded.
    fn on_undecodable(&self, _channel: u32) {}
    /// Handles a new measurement of the peer's clock; `best` is the current estimate.
    fn on_clock_sample(&self, _best: ClockSample) {}
}

/// The robot's end of a session.
pub type RobotSession = Session<FromRobot>;
/// The cloud's end of a session.
pub type CloudSession = Session<FromCloud>;

/// State shared by two ends, independent of the connection that carries it. This end sends control messages of type
/// `O`.
pub struct Session<O> {
    options: SessionOptions,
    state: Mutex<State>,
    wake: Notify,
    up: watch::Sender<bool>,
    /// Set by [`probe`](Self::probe) to request a ping.
    asked: AtomicBool,
    /// Number of pongs received so far.
    pongs: watch::Sender<u64>,
    next_call: AtomicU32,
    /// Budget for the peer's control messages until they are processed.
    told: Budget,
    /// Budget for the peer's calls until they are answered.
    called: Budget,
    orders: PhantomData<fn(O)>,
}

#[derive(Default)]
struct State {
    out: Outgoing,
    incoming: Incoming,
    clock: ClockFilter,
    packing: SessionCodecs,
    throughput: ThroughputEstimator,
    ending: Option<RequestedClose>,
    /// Topics of this end's channels, until the peer knows that they are closed.
    topics: BTreeMap<u32, String>,
    /// Drop counts of channels that are closed.
    dropped: Tally<String>,
}

/// Close of the session that this end has requested.
struct RequestedClose {
    /// WebSocket close code.
    code: u16,
    reason: String,
    at: Instant,
}

impl State {
    /// Forgets channels that the peer knows to be closed, except for their drop counts.
    fn forget_closed(&mut self) {
        for channel in std::mem::take(&mut self.out.closed) {
            self.packing.remove(channel);
            let Some(topic) = self.topics.remove(&channel) else {
                continue;
            };
            for (cause, count) in self.out.dropped.take(&channel) {
                self.dropped.add(topic.clone(), cause, count);
            }
        }
    }
}

impl<O: ControlMessage> Session<O> {
    /// Creates a session without a connection.
    pub fn new(options: SessionOptions) -> Self {
        let age = options.max_age.map(|age| i64::try_from(age.as_nanos()).unwrap_or(i64::MAX));
        let packing = SessionCodecs::new(options.max_age);
        Self {
            options,
            state: Mutex::new(State { out: Outgoing::new(age), packing, ..State::default() }),
            wake: Notify::new(),
            up: watch::Sender::new(false),
            asked: AtomicBool::new(false),
            pongs: watch::Sender::new(0),
            next_call: AtomicU32::new(1),
            told: Budget::new(CONTROL_MEMORY, MAX_TOLD),
            called: Budget::without_limit(),
            orders: PhantomData,
        }
    }

    /// Charges memory to `budget`: incomplete records, where one that does not fit ends its connection; control
    /// messages until they are processed; calls until they are answered, where one that does not fit fails; and what is
    /// queued for the peer, where messages that do not fit are dropped and a call or response that does not fit ends
    /// the session.
    pub fn with_budget(mut self, budget: &Budget) -> Self {
        self.told = budget.child(CONTROL_MEMORY, MAX_TOLD);
        self.called = budget.child(CALL_MEMORY, budget.max_permit() / 2);
        let state = self.state.get_mut();
        state.incoming.budget = Some(budget.clone());
        state.out.permit = Some(budget.permit());
        self
    }

    /// Returns a watch on whether the peer is connected.
    pub fn watch_up(&self) -> watch::Receiver<bool> {
        self.up.subscribe()
    }

    /// Returns whether the peer is connected now. Does not keep the watch borrowed: a second access in the same
    /// expression, with a change waiting in between, would deadlock.
    pub fn is_up(&self) -> bool {
        *self.up.borrow()
    }

    /// Sends a ping and returns whether a pong arrives within `limit`, over any connection.
    pub async fn probe(&self, limit: Duration) -> bool {
        let mut pongs = self.pongs.subscribe();
        self.asked.store(true, Ordering::Relaxed);
        self.wake.notify_one();
        timeout(limit, pongs.changed()).await.is_ok()
    }

    /// Returns the estimate of the peer's clock.
    pub fn clock(&self) -> Option<ClockSample> {
        self.state.lock().clock.best()
    }

    /// Returns the last round-trip time in nanoseconds.
    pub fn round_trip(&self) -> Option<i64> {
        self.state.lock().clock.last_delay()
    }

    /// Returns the throughput of the link in bytes per second, measured while it was busy.
    pub fn throughput(&self) -> Option<f64> {
        self.state.lock().throughput.estimate()
    }

    /// Returns the numbers of messages that did not reach the peer.
    pub fn drops(&self) -> Vec<TopicDropCount> {
        let state = self.state.lock();
        let mut all = state.dropped.clone();
        for (channel, cause, count) in state.out.dropped.iter() {
            if let Some(topic) = state.topics.get(channel) {
                all.add(topic.clone(), cause, count);
            }
        }
        all.per_topic()
    }

    /// Sends a control message. It will be delivered, in order, over any number of connections. A line of a node is
    /// sent when there is spare capacity, or omitted, which the next line reports.
    pub fn send_control(&self, order: &O) {
        match self.control_record(order) {
            Some(line) if order.is_line() => self.state.lock().out.push_line(&line),
            Some(record) => self.state.lock().out.push(&record, DeliveryMode::Each),
            None => {}
        }
        self.wake.notify_one();
    }

    /// Serializes a control message; returns `None` if the peer would not accept it.
    fn control_record(&self, told: &impl Serialize) -> Option<Record> {
        let json = serde_json::to_vec(told).unwrap_or_default();
        let (bytes, limit) = (json.len(), control::max_control_length(&json));
        let (weight, room) = (JsonWeight::estimate(&json).bytes, self.state.lock().out.peer_limits().told);
        if bytes > limit || weight > room {
            tracing::warn!(bytes, limit, weight, room, "a message is too long for the link and was not sent");
            return None;
        }
        Some(Record::Control(json.into()))
    }

    /// Sends the last control message, behind the newest lines that wait.
    pub fn send_last(&self, order: &O) {
        if let Some(record) = self.control_record(order) {
            self.state.lock().out.push_last(&record);
            self.wake.notify_one();
        }
    }

    /// Sends a topic message.
    pub fn publish(&self, data: Data, quality: DeliveryMode) {
        self.push(&Record::Data(data), quality);
    }

    /// Calls a service. The response arrives as a record with the returned id.
    pub fn call(&self, service: u32, request: Bytes) -> u32 {
        let id = self.next_call.fetch_add(1, Ordering::Relaxed);
        self.push(&Record::Call(Call { id, service, request }), DeliveryMode::Each);
        id
    }

    /// Answers a call that was received at `taken` (nanoseconds since the Unix epoch).
    pub fn answer(&self, id: u32, taken: i64, response: Result<Bytes, FailureReason>) {
        let response = response.and_then(|response| match response.len() {
            0..MAX_RESPONSE => Ok(response),
            bytes => Err(FailureReason::new(format!(
                "the response has {bytes} bytes, more than a link carries ({MAX_RESPONSE})"
            ))),
        });
        self.push(&Record::Answer { id, taken, given: now(), response }, DeliveryMode::Each);
    }

    /// Opens a channel for sending messages of a topic, which was just announced to the peer. Messages may be
    /// compressed according to `schema`.
    pub fn open_channel(&self, channel: u32, topic: &str, schema: codec::Schema) {
        let mut state = self.state.lock();
        state.topics.insert(channel, topic.to_owned());
        state.packing.add(channel, schema);
        state.out.open_channel(channel);
    }

    /// Makes messages of an open channel that are not sent yet wait for the control messages sent before this call,
    /// which say how they are to be understood.
    pub fn order_after_control(&self, channel: u32) {
        self.state.lock().out.order_after_control(channel);
    }

    /// Sets the limits that the peer announced in its opening frame. To be called before
    /// [`reconnect`](Self::reconnect).
    pub fn set_peer_limits(&self, limits: LinkLimits) {
        self.state.lock().out.set_limits(limits);
    }

    /// Sets the codecs that the peer announced in its opening frame, and the quality of JPEG images, 1 to 100 (default:
    /// 80).
    pub fn set_peer_codecs(&self, codecs: &[String], quality: Option<u8>) {
        let mut state = self.state.lock();
        state.packing.set_peer_codecs(codecs, quality);
        state.out.encoding.pays = state.packing.is_worthwhile(state.throughput.estimate());
    }

    fn push(&self, record: &Record, quality: DeliveryMode) {
        self.state.lock().out.push(record, quality);
        self.wake.notify_one();
    }

    /// Handles the closing of a channel by the peer.
    pub fn on_peer_closed(&self, channel: u32) {
        self.state.lock().packing.on_peer_closed(channel);
    }

    /// Drops what is queued on a channel that is gone.
    pub fn forget_channel(&self, channel: u32) {
        let mut state = self.state.lock();
        state.out.forget_channel(channel);
        state.packing.remove(channel);
    }

    /// Closes the session once everything queued was sent, or the peer has received nothing for two seconds.
    pub fn close(&self, code: u16, reason: &str) {
        self.state.lock().ending = Some(RequestedClose { code, reason: reason.to_owned(), at: Instant::now() });
        self.wake.notify_one();
    }

    /// Returns what was received and the first number that this end will use, for the opening frame of a connection.
    pub fn position(&self) -> (u64, Vec<u64>, u64) {
        let state = self.state.lock();
        let (received, ahead) = state.incoming.received_numbers();
        (received, ahead, state.out.next_number())
    }

    /// Starts numbering at the number that was announced to the peer, for a session that replaces one that the peer has
    /// forgotten. To be called before anything is sent.
    pub fn begin_at(&self, number: u64) {
        self.state.lock().out.begin_at(number);
    }

    /// Begins a new connection: `received` and `ahead` are what the peer has received, `next` is the first number that
    /// it will use.
    pub fn reconnect(&self, received: u64, ahead: &[u64], next: u64) {
        let mut state = self.state.lock();
        state.out.reconnect(received, ahead);
        state.incoming.reconnect(next);
        state.packing.reconnect();
        state.throughput.reconnect();
    }

    /// Handles an acknowledgement of the peer.
    fn on_acknowledged(&self, received: ReceiveProgress) {
        let mut state = self.state.lock();
        state.out.acknowledge(received.number);
        state.forget_closed();
        let counters =
            Counters { at: Instant::now(), bytes: received.bytes, sent: state.out.sent, idle: state.out.is_idle() };
        if let Some(rate) = state.throughput.update(counters) {
            state.out.set_throughput(rate);
            state.out.encoding.pays = state.packing.is_worthwhile(Some(rate));
        }
    }
}

impl Session<FromRobot> {
    /// Closes a channel for sending; the peer is told after all messages queued on it.
    pub fn close_channel(&self, channel: u32) {
        let json = serde_json::to_vec(&FromRobot::Close { channel }).unwrap_or_default();
        self.state.lock().out.close_channel(channel, &Record::Control(json.into()));
        self.wake.notify_one();
    }
}

#[cfg(test)]
mod tests;
