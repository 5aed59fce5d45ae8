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
use serde::Serialize;
use tokio::sync::{Notify, watch};
use tokio::time::{Instant, timeout};

use crate::clock::{Clock, Sample, now};
use crate::control::{Between, FromCloud, FromRobot, Order};
use crate::drops::{Cause, Drop, Dropped, Tally};
use crate::frame::Received;
use crate::incoming::Incoming;
use crate::outgoing::{Outgoing, Quality};
use crate::packing::Packing;
use crate::record::{Data, Record};
use crate::{Error, Limits, MAX_RECORD, MAX_TOLD, control};

pub use opening::{receive_open, send_open};
use throughput::{Counters, Throughput};

/// No link is watched more closely.
const SHORTEST: Duration = Duration::from_millis(50);
/// A connection is given up after so much silence, at least and at most.
const LOST: (Duration, Duration) = (Duration::from_secs(3), Duration::from_secs(20));

/// What errors call the memory for orders.
const TOLD: &str = "what the other end of a link tells";

/// The longest response, for which there is room in a record.
const MAX_RESPONSE: usize = MAX_RECORD - 1024;

/// And the memory for calls, half of a session's: what is under way has room beside them.
const CALLED: &str = "calls of the other end of a link";

/// How a session's connections are watched.
#[derive(Debug, Clone)]
pub struct SessionOptions {
    /// Between pings while nothing else comes.
    pub ping: Duration,
    /// Without a sign of the peer for so long the link counts as down.
    pub silent: Duration,
    /// Without a sign of the peer for so long the connection is given up.
    pub lost: Duration,
    /// A message older than this is not sent when a newer one waits.
    pub max_age: Option<Duration>,
}

impl SessionOptions {
    /// Habits of a side that wants to know within `silent` that the link carries nothing any more.
    pub fn for_silence(silent: Duration, max_age: Option<Duration>) -> Self {
        let silent = silent.max(SHORTEST);
        Self {
            // A ping is out, and its pong awaited, within that time.
            ping: (silent / 2).min(Duration::from_secs(2)),
            silent,
            lost: (silent * 10).clamp(LOST.0, LOST.1),
            max_age,
        }
    }
}

/// How a connection ended.
#[derive(Debug, thiserror::Error)]
pub enum Lost {
    /// This side wanted it.
    #[error("this side ended the link")]
    Ended,
    /// The peer closed it in good order.
    #[error("the other end closed the link ({code}: {reason})")]
    Closed {
        /// WebSocket close code.
        code: u16,
        /// Its words.
        reason: String,
    },
    /// The socket failed.
    #[error("the connection was lost: {0}")]
    Socket(String),
    /// Nothing came.
    #[error("nothing came from the other end for {0:?}")]
    Silent(Duration),
    /// The peer makes no sense.
    #[error(transparent)]
    Protocol(#[from] Error),
    /// More waits for the peer than may; says what.
    #[error("the other end takes too little: {0}")]
    Full(String),
}

impl Lost {
    /// What the other end is told, where it can still be told something: a WebSocket close code and the reason.
    pub fn goodbye(&self) -> Option<(u16, String)> {
        match self {
            Lost::Protocol(Error::Refused { code, reason }) => Some((*code, reason.clone())),
            Lost::Protocol(error @ Error::Exceeded(_)) => Some((1013, error.to_string())),
            Lost::Protocol(error) => Some((1002, error.to_string())),
            Lost::Full(_) => Some((1013, self.to_string())),
            _ => None,
        }
    }
}

/// Takes what comes from an end that gives orders `O`.
pub trait Handler<O>: Sync {
    /// A record, and when it had come as a whole (nanoseconds since 1970). An order or call counts in the session's budget until `held` is
    /// dropped: it is kept until the order is obeyed, the call answered. Must not block.
    fn record(&self, record: Record<O>, held: Permit, arrived: i64);
    /// A message of this channel came that cannot be decoded.
    fn undecodable(&self, channel: u32) {
        let _ = channel;
    }
    /// The peer's clock was compared with ours once more; `best` is what is believed.
    fn clock(&self, best: Sample) {
        let _ = best;
    }
}

/// The robot's end of a session.
pub type RobotSession = Session<FromRobot>;
/// The cloud's end of a session.
pub type CloudSession = Session<FromCloud>;

/// What two ends know of each other, whichever connection carries it. This one gives orders `O`.
pub struct Session<O> {
    options: SessionOptions,
    state: Mutex<State>,
    wake: Notify,
    up: watch::Sender<bool>,
    /// Somebody wants to know whether the peer is there.
    asked: AtomicBool,
    /// Pongs so far.
    pongs: watch::Sender<u64>,
    next_call: AtomicU32,
    /// Where the peer's orders count until they are obeyed.
    told: Budget,
    /// Where its calls count until they are answered.
    called: Budget,
    orders: PhantomData<fn(O)>,
}

struct State {
    out: Outgoing,
    incoming: Incoming,
    clock: Clock,
    packing: Packing,
    throughput: Throughput,
    ending: Option<Ending>,
    /// What this side's channels stand for, until the peer knows that they are gone.
    topics: BTreeMap<u32, String>,
    /// What was dropped of those that are gone.
    dropped: Tally<String>,
}

/// How this side has ended the session.
struct Ending {
    /// WebSocket close code.
    code: u16,
    reason: String,
    at: Instant,
}

impl State {
    /// Forgets channels that the peer knows to be closed, but for what was dropped of them.
    fn let_go(&mut self) {
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

impl<O: Order> Session<O> {
    /// A session without a connection.
    pub fn new(options: SessionOptions) -> Self {
        let age = options
            .max_age
            .map(|age| i64::try_from(age.as_nanos()).unwrap_or(i64::MAX));
        let packing = Packing::new(options.max_age);
        Self {
            options,
            state: Mutex::new(State {
                out: Outgoing::new(age),
                incoming: Incoming::default(),
                clock: Clock::default(),
                packing,
                throughput: Throughput::default(),
                ending: None,
                topics: BTreeMap::new(),
                dropped: Tally::default(),
            }),
            wake: Notify::new(),
            up: watch::Sender::new(false),
            asked: AtomicBool::new(false),
            pongs: watch::Sender::new(0),
            next_call: AtomicU32::new(1),
            told: Budget::new(TOLD, MAX_TOLD),
            called: Budget::unlimited(),
            orders: PhantomData,
        }
    }

    /// Counts records that are arriving in `budget`, and orders until they are obeyed; one that does not fit ends its connection. Counts
    /// calls until they are answered; one that does not fit fails. Counts what waits for the peer,
    /// too: messages that do not fit are dropped, a call or answer that does not fit ends the session.
    pub fn within(mut self, budget: &Budget) -> Self {
        self.told = budget.within(TOLD, MAX_TOLD);
        self.called = budget.within(CALLED, budget.most() / 2);
        {
            let mut state = self.state.lock();
            state.incoming = Incoming::within(budget);
            state.out.within(budget);
        }
        self
    }

    /// Whether the peer is there, now and later.
    pub fn up(&self) -> watch::Receiver<bool> {
        self.up.subscribe()
    }

    /// Whether the peer is there now. Nothing stays borrowed: a second look in the same expression, with a change that waits
    /// between the two, would wait for ever.
    pub fn is_up(&self) -> bool {
        *self.up.borrow()
    }

    /// Asks the peer for a sign, and tells whether it gives one within `limit`, by whichever connection.
    pub async fn is_there(&self, limit: Duration) -> bool {
        let mut pongs = self.pongs.subscribe();
        self.asked.store(true, Ordering::Relaxed);
        self.wake.notify_one();
        timeout(limit, pongs.changed()).await.is_ok()
    }

    /// The peer's clock against ours.
    pub fn clock(&self) -> Option<Sample> {
        self.state.lock().clock.best()
    }

    /// The last round trip in nanoseconds.
    pub fn round_trip(&self) -> Option<i64> {
        self.state.lock().clock.last_delay()
    }

    /// Bytes per second that the link carried when it had to.
    pub fn throughput(&self) -> Option<f64> {
        self.state.lock().throughput.known()
    }

    /// Messages not sent so far, since newer ones had come or they were too old.
    pub fn dropped(&self) -> Dropped {
        let state = self.state.lock();
        let of = |cause| state.out.dropped.because_of(cause) + state.dropped.because_of(cause);
        Dropped {
            replaced: of(Cause::Replaced),
            stale: of(Cause::Stale),
        }
    }

    /// Messages that did not get to the peer so far.
    pub fn drops(&self) -> Vec<Drop> {
        let state = self.state.lock();
        let mut all = state.dropped.clone();
        for (channel, cause, count) in state.out.dropped.iter() {
            if let Some(topic) = state.topics.get(channel) {
                all.add(topic.clone(), cause, count);
            }
        }
        all.drops()
    }

    /// Bytes of records sent so far, and that came.
    pub fn traffic(&self) -> (u64, u64) {
        let state = self.state.lock();
        (state.out.sent, state.incoming.received().bytes)
    }

    /// Tells the peer something; it will come, in order, over however many connections. A line of a node comes when there is time, or is left
    /// out, which the next line tells.
    pub fn report(&self, order: &O) {
        let Some(record) = control_record(order) else {
            return;
        };
        let out = &mut self.state.lock().out;
        if order.is_line() {
            out.print(&record);
        } else {
            out.push(&record, Quality::Each);
        }
        self.wake.notify_one();
    }

    /// Has the peer's session send a frame that refers to none before it.
    fn ask_for_keyframe(&self, channel: u32) {
        if let Some(record) = control_record(&Between::Keyframe { channel }) {
            self.push(&record, Quality::Each);
        }
    }

    /// Sends a message of a topic.
    pub fn publish(&self, data: Data, quality: Quality) {
        self.push(&Record::Data(data), quality);
    }

    /// Calls a service; the answer comes as a record with the id that is returned.
    pub fn call(&self, service: u32, request: Bytes) -> u32 {
        let id = self.next_call.fetch_add(1, Ordering::Relaxed);
        let call = Record::Call {
            id,
            service,
            request,
        };
        self.push(&call, Quality::Each);
        id
    }

    /// Answers a call that had arrived at `taken` (nanoseconds since 1970).
    pub fn answer(&self, id: u32, taken: i64, response: Result<Bytes, String>) {
        let response = response.and_then(|response| match response.len() {
            0..MAX_RESPONSE => Ok(response),
            bytes => Err(format!(
                "the response has {bytes} bytes, more than a link carries ({MAX_RESPONSE})"
            )),
        });
        let answer = Record::Answer {
            id,
            taken,
            given: now(),
            response,
        };
        self.push(&answer, Quality::Each);
    }

    /// This side will send a topic's messages as this channel, of which the peer was told just now. They may be made smaller, by what is known of their
    /// type.
    pub fn opens(&self, channel: u32, topic: &str, schema: codec::Schema) {
        let mut state = self.state.lock();
        state.topics.insert(channel, topic.to_owned());
        state.packing.add(channel, schema);
        state.out.opens(channel);
    }

    /// Quality of JPEG pictures, 1 to 100; 80 where absent.
    pub fn set_quality(&self, quality: Option<u8>) {
        self.state.lock().packing.set_quality(quality);
    }

    /// The peer takes so much, as its opening frame says. Before [`reconnect`](Self::reconnect).
    pub fn peer_takes(&self, limits: Limits) {
        self.state.lock().out.set_limits(limits);
    }

    /// The peer decodes these, as its opening frame says.
    pub fn peer_decodes(&self, codecs: &[String]) {
        let mut state = self.state.lock();
        state.packing.peer_decodes(codecs);
        let pays = state.packing.pays(state.throughput.known());
        state.out.encoding.set_pays(pays);
    }

    fn push(&self, record: &Record, quality: Quality) {
        self.state.lock().out.push(record, quality);
        self.wake.notify_one();
    }

    /// Nothing more will come as this channel of the peer.
    pub fn peer_closed(&self, channel: u32) {
        self.state.lock().packing.peer_closed(channel);
    }

    /// Forgets what waits on a channel that is gone.
    pub fn forget(&self, channel: u32) {
        let mut state = self.state.lock();
        state.out.forget(channel);
        state.packing.remove(channel);
    }

    /// Ends the connection, once what waits was sent, or the peer takes none of it for two seconds.
    pub fn end(&self, code: u16, reason: &str) {
        self.state.lock().ending = Some(Ending {
            code,
            reason: reason.to_owned(),
            at: Instant::now(),
        });
        self.wake.notify_one();
    }

    /// For the opening of a connection: what has come, and the first number that this side will use.
    pub fn position(&self) -> (u64, Vec<u64>, u64) {
        let state = self.state.lock();
        let (received, ahead) = state.incoming.state();
        (received, ahead, state.out.next_number())
    }

    /// For a new session that takes the place of one the peer has forgotten: the first number that the peer was told
    /// to expect. Before anything is sent.
    pub fn begin_at(&self, number: u64) {
        self.state.lock().out.begin_at(number);
    }

    /// A new connection: what the peer has, and the first number that it will use.
    pub fn reconnect(&self, received: u64, ahead: &[u64], next: u64) {
        let mut state = self.state.lock();
        state.out.reconnect(received, ahead);
        state.incoming.reconnect(next);
        state.packing.reconnect();
        state.throughput.reconnect();
    }

    /// The peer has said what came.
    fn acknowledged(&self, received: Received) {
        let mut state = self.state.lock();
        state.out.acknowledge(received.number);
        state.let_go();
        let counters = Counters {
            at: Instant::now(),
            bytes: received.bytes,
            sent: state.out.sent,
            idle: state.out.is_idle(),
        };
        if let Some(rate) = state.throughput.report(counters) {
            state.out.set_throughput(rate);
            let pays = state.packing.pays(Some(rate));
            state.out.encoding.set_pays(pays);
        }
    }
}

/// What is told, as a record; none where the peer would not read it.
fn control_record(told: &impl Serialize) -> Option<Record> {
    let json = serde_json::to_vec(told).unwrap_or_default();
    let (bytes, limit) = (json.len(), control::longest(&json));
    let (weight, room) = (JsonWeight::of(&json).bytes, MAX_TOLD);
    if bytes > limit || weight > room {
        tracing::warn!(
            bytes,
            limit,
            weight,
            room,
            "something is too long to be told to the other end of the link"
        );
        return None;
    }
    Some(Record::Control(json.into()))
}

impl Session<FromRobot> {
    /// Closes a channel for sending; the peer is told after all messages that wait on it.
    pub fn closes(&self, channel: u32) {
        let json = serde_json::to_vec(&FromRobot::Close { channel }).unwrap_or_default();
        let mut state = self.state.lock();
        state.out.close(channel, &Record::Control(json.into()));
        drop(state);
        self.wake.notify_one();
    }
}

#[cfg(test)]
mod tests;
