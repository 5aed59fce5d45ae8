//! A session and the connections that carry it, one at a time.

use std::future::{Future, poll_fn};
use std::pin::{Pin, pin};
use std::sync::atomic::{AtomicU32, Ordering};
use std::task::Poll;
use std::time::Duration;

use bytes::Bytes;
use codec::Answer;
use parking_lot::Mutex;
use serde::Serialize;
use serde::de::DeserializeOwned;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::sync::{Notify, watch};
use tokio::task::JoinHandle;
use tokio::time::{Instant, Sleep, sleep_until};
use ws::{Message, WebSocket, WsError, frame as opcode};

use crate::Error;
use crate::clock::{Clock, Sample, now};
use crate::control::Control;
use crate::frame::{Frame, Received};
use crate::incoming::Incoming;
use crate::outgoing::{Dropped, Outgoing, Quality};
use crate::packing::{Packed, Packing};
use crate::record::{Data, Record};

/// The socket is given more only when it holds less than this: what is decided later is decided better.
const LOW_WATER: usize = 24 * 1024;
/// Acknowledged at the latest after so many records, and bytes.
const ACK_AFTER: (u32, u64) = (64, 64 * 1024);
/// Exchanges made at once on a new connection, to know the peer's clock.
const FIRST_PINGS: u32 = 6;
/// So many measurements make a first estimate.
const FIRST_RATES: usize = 3;
/// The weight of a new measurement of the link's throughput.
const NEWEST: f64 = 0.25;

/// How a session's connections are watched.
#[derive(Debug, Clone)]
pub struct SessionOptions {
    /// Between pings while nothing else comes.
    pub ping: Duration,
    /// Without a sign of the peer for so long the link counts as down …
    pub silent: Duration,
    /// … and for so long the connection is given up.
    pub lost: Duration,
    /// A message older than this is not sent when a newer one waits.
    pub max_age: Option<Duration>,
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
    /// More waits for the peer than may.
    #[error("the other end takes too little: too much waits for it")]
    Full,
}

/// Takes what comes.
pub trait Handler: Sync {
    /// A record, and when it had come as a whole (nanoseconds since 1970). Must not block.
    fn record(&self, record: Record, arrived: i64);
    /// The peer's clock was compared with ours once more; `best` is what is believed.
    fn clock(&self, best: Sample) {
        let _ = best;
    }
}

/// What two ends know of each other, whichever connection carries it.
pub struct Session {
    options: SessionOptions,
    state: Mutex<State>,
    wake: Notify,
    up: watch::Sender<bool>,
    next_call: AtomicU32,
}

struct State {
    out: Outgoing,
    incoming: Incoming,
    clock: Clock,
    packing: Packing,
    throughput: Option<f64>,
    first_rates: Vec<f64>,
    measured: Option<Told>,
    ending: Option<(u16, String)>,
}

impl Session {
    /// A session without a connection.
    pub fn new(options: SessionOptions) -> Self {
        let age = options
            .max_age
            .map(|age| i64::try_from(age.as_nanos()).unwrap_or(i64::MAX));
        Self {
            options,
            state: Mutex::new(State {
                out: Outgoing::new(age),
                incoming: Incoming::default(),
                clock: Clock::default(),
                packing: Packing::default(),
                throughput: None,
                first_rates: Vec::new(),
                measured: None,
                ending: None,
            }),
            wake: Notify::new(),
            up: watch::Sender::new(false),
            next_call: AtomicU32::new(1),
        }
    }

    /// Whether the peer is there, now and later.
    pub fn up(&self) -> watch::Receiver<bool> {
        self.up.subscribe()
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
        self.state.lock().throughput
    }

    /// Messages not sent so far.
    pub fn dropped(&self) -> Dropped {
        self.state.lock().out.dropped
    }

    /// Bytes of records sent so far, and that came.
    pub fn traffic(&self) -> (u64, u64) {
        let state = self.state.lock();
        (state.out.sent, state.incoming.received().bytes)
    }

    /// Tells the peer something; it will come, in order, over however many connections.
    pub fn tell(&self, control: &Control) {
        let json = serde_json::to_vec(control).unwrap_or_default();
        self.push(&Record::Control(json.into()), Quality::Each);
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
        let answer = Record::Answer {
            id,
            taken,
            given: now(),
            response,
        };
        self.push(&answer, Quality::Each);
    }

    /// Messages of this channel may be made smaller, by what is known of their type.
    pub fn packs(&self, channel: u32, schema: codec::Schema) {
        let mut state = self.state.lock();
        state.packing.add(channel, schema);
        state.out.set_packable(channel);
    }

    /// The peer decodes these, as its opening frame says.
    pub fn peer_decodes(&self, codecs: &[String]) {
        let mut state = self.state.lock();
        state.packing.peer_decodes(codecs);
        let pays = state.packing.pays(state.throughput);
        state.out.set_packs(pays);
    }

    fn push(&self, record: &Record, quality: Quality) {
        self.state.lock().out.push(record, quality);
        self.wake.notify_one();
    }

    /// Forgets what waits on a channel that is gone.
    pub fn forget(&self, channel: u32) {
        let mut state = self.state.lock();
        state.out.forget(channel);
        state.packing.remove(channel);
    }

    /// Ends the connection, once what waits was sent.
    pub fn end(&self, code: u16, reason: &str) {
        self.state.lock().ending = Some((code, reason.to_owned()));
        self.wake.notify_one();
    }

    /// For the opening of a connection: what has come, and the first number that this side will use.
    pub fn position(&self) -> (u32, Vec<u32>, u32) {
        let state = self.state.lock();
        let (received, ahead) = state.incoming.state();
        (received, ahead, state.out.next_number())
    }

    /// For a new session that takes the place of one the peer has forgotten: the first number that the peer was told
    /// to expect. Before anything is sent.
    pub fn begin_at(&self, number: u32) {
        self.state.lock().out.begin_at(number);
    }

    /// A new connection: what the peer has, and the first number that it will use.
    pub fn reconnect(&self, received: u32, ahead: &[u32], next: u32) {
        let mut state = self.state.lock();
        state.out.reconnect(received, ahead);
        state.incoming.reconnect(next);
        state.packing.reconnect();
        state.measured = None;
    }

    /// Carries the session over a connection that was opened, until that ends.
    pub async fn run<S, H>(&self, socket: &mut WebSocket<S>, handler: &H) -> Lost
    where
        S: AsyncRead + AsyncWrite + Unpin,
        H: Handler + ?Sized,
    {
        let lost = match self.carry(socket, handler).await {
            Ok(never) => match never {},
            Err(lost) => lost,
        };
        self.up.send_replace(false);
        let goodbye = match &lost {
            Lost::Ended => self.state.lock().ending.clone(),
            Lost::Protocol(error) => Some((1002, error.to_string())),
            Lost::Full => Some((1008, lost.to_string())),
            _ => None,
        };
        if let Some((code, reason)) = goodbye {
            socket.queue_close(code, &reason);
            let _ = tokio::time::timeout(Duration::from_secs(1), socket.leave(true)).await;
        }
        lost
    }

    async fn carry<S, H>(
        &self,
        socket: &mut WebSocket<S>,
        handler: &H,
    ) -> Result<std::convert::Infallible, Lost>
    where
        S: AsyncRead + AsyncWrite + Unpin,
        H: Handler + ?Sized,
    {
        let mut connection = Connection::new(&self.options);
        let mut job: Option<JoinHandle<Packed>> = None;
        let mut tick = pin!(sleep_until(connection.next_tick()));
        connection.ping(self, socket);
        self.up.send_if_modified(|up| !std::mem::replace(up, true));
        loop {
            let mut woken = pin!(self.wake.notified());
            let event = poll_fn(|cx| {
                loop {
                    self.fill(socket);
                    if job.is_none() {
                        job = self.pack();
                    }
                    let polled = job.as_mut().map(|job| Pin::new(job).poll(cx));
                    if let Some(Poll::Ready(packed)) = polled {
                        job = None;
                        self.packed(packed.ok());
                        continue;
                    }
                    if socket.queued() == 0 {
                        break;
                    }
                    match socket.poll_flush(cx) {
                        Poll::Ready(Ok(())) => {}
                        Poll::Ready(Err(error)) => {
                            return Poll::Ready(Event::Message(Err(error.into())));
                        }
                        Poll::Pending => break,
                    }
                }
                if socket.queued() == 0 && self.has_ended() {
                    return Poll::Ready(Event::Ended);
                }
                if let Poll::Ready(message) = socket.poll_next(cx) {
                    return Poll::Ready(Event::Message(message));
                }
                if woken.as_mut().poll(cx).is_ready() {
                    return Poll::Ready(Event::Woken);
                }
                tick.as_mut().poll(cx).map(|()| Event::Tick)
            })
            .await;
            match event {
                Event::Message(message) => {
                    connection.heard = Instant::now();
                    self.up.send_if_modified(|up| !std::mem::replace(up, true));
                    match message.map_err(socket_lost)? {
                        Message::Binary(bytes) => {
                            self.take(socket, &mut connection, bytes, handler)?;
                        }
                        Message::Ping(payload) => socket.queue(opcode::PONG, payload),
                        Message::Pong(_) => {}
                        Message::Text(_) => {
                            return Err(Error::Protocol("text, where frames are binary").into());
                        }
                        Message::Close(code, reason) => {
                            socket.queue_close(code, "");
                            let _ = poll_fn(|cx| socket.poll_flush(cx)).await;
                            return Err(Lost::Closed { code, reason });
                        }
                    }
                }
                Event::Woken => {
                    if self.state.lock().out.is_full() {
                        return Err(Lost::Full);
                    }
                }
                Event::Ended => return Err(Lost::Ended),
                Event::Tick => {
                    let silence = connection.heard.elapsed();
                    if silence >= self.options.lost {
                        return Err(Lost::Silent(silence));
                    }
                    if silence >= self.options.silent {
                        self.up.send_if_modified(|up| std::mem::replace(up, false));
                    }
                    connection.ping(self, socket);
                    let next = connection.next_tick();
                    Sleep::reset(tick.as_mut(), next);
                }
            }
        }
    }

    /// Begins to encode the next message that is to be, on another thread.
    fn pack(&self) -> Option<JoinHandle<Packed>> {
        let mut state = self.state.lock();
        let State {
            out,
            packing,
            throughput,
            ..
        } = &mut *state;
        let (channel, message, alone) = out.take_to_pack()?;
        let Some(job) = packing.job(channel, message, alone, *throughput) else {
            out.packed(None);
            self.wake.notify_one();
            return None;
        };
        Some(tokio::task::spawn_blocking(move || job.run()))
    }

    fn packed(&self, packed: Option<Packed>) {
        let state = &mut *self.state.lock();
        let frame = packed.map(|packed| {
            let took = packed.took;
            (state.packing.done(packed), took)
        });
        state.out.packed(frame);
    }

    /// A message as it was before it was encoded; none where that cannot be told.
    fn unpacked(&self, mut data: Data) -> Option<Data> {
        if !data.encoded {
            return Some(data);
        }
        let channel = data.channel;
        let (message, answer) = self.state.lock().packing.unpack(channel, &data.message);
        match answer {
            Some(Answer::Acknowledge(sequence)) => {
                self.tell(&Control::Decoded { channel, sequence })
            }
            Some(Answer::Keyframe) => self.tell(&Control::Keyframe { channel }),
            None => {}
        }
        match message {
            Ok(message) => {
                data.message = message;
                data.encoded = false;
                Some(data)
            }
            Err(error) => {
                tracing::debug!(channel, %error, "a message cannot be decoded");
                None
            }
        }
    }

    /// What the peer says of frames that it was sent; others are the handler's.
    fn is_answer(&self, json: &[u8]) -> bool {
        if !json.starts_with(b"{\"decoded\"") && !json.starts_with(b"{\"keyframe\"") {
            return false;
        }
        let (channel, answer) = match serde_json::from_slice(json) {
            Ok(Control::Decoded { channel, sequence }) => (channel, Answer::Acknowledge(sequence)),
            Ok(Control::Keyframe { channel }) => (channel, Answer::Keyframe),
            _ => return false,
        };
        self.state.lock().packing.answered(channel, answer);
        true
    }

    fn has_ended(&self) -> bool {
        let state = self.state.lock();
        state.ending.is_some() && state.out.is_empty()
    }

    fn fill<S: AsyncRead + AsyncWrite + Unpin>(&self, socket: &mut WebSocket<S>) {
        if socket.queued() >= LOW_WATER {
            return;
        }
        let mut state = self.state.lock();
        while socket.queued() < LOW_WATER {
            let Some(frame) = state.out.next(now()) else {
                return;
            };
            socket.queue(opcode::BINARY, frame.encode());
        }
    }

    fn take<S, H>(
        &self,
        socket: &mut WebSocket<S>,
        connection: &mut Connection,
        bytes: Bytes,
        handler: &H,
    ) -> Result<(), Error>
    where
        S: AsyncRead + AsyncWrite + Unpin,
        H: Handler + ?Sized,
    {
        let arrived = now();
        let record = match Frame::decode(bytes)? {
            Frame::Whole { number, record } => {
                connection.unacknowledged += u32::from(number != 0);
                self.state.lock().incoming.whole(number, record)?
            }
            Frame::Begin {
                stream,
                number,
                total,
                bytes,
            } => {
                connection.unacknowledged += u32::from(number != 0);
                let incoming = &mut self.state.lock().incoming;
                incoming.begin(stream, number, total, &bytes)?
            }
            Frame::More { stream, bytes } => {
                let whole = self.state.lock().incoming.more(stream, &bytes)?;
                // The end of a big one tells how fast the link is.
                connection.big_came = whole.is_some();
                whole
            }
            Frame::Ping { sent, received } => {
                self.acknowledged(received);
                let received = self.received(connection);
                let pong = Frame::Pong {
                    sent,
                    arrived,
                    left: now(),
                    received,
                };
                socket.queue(opcode::BINARY, pong.encode());
                None
            }
            Frame::Pong {
                sent,
                arrived: there,
                left,
                received,
            } => {
                self.acknowledged(received);
                let sample = Sample::new(sent, there, left, arrived);
                let best = {
                    let clock = &mut self.state.lock().clock;
                    clock.add(sample);
                    clock.best()
                };
                if let Some(best) = best {
                    handler.clock(best);
                }
                connection.pongs += 1;
                if connection.pongs < FIRST_PINGS {
                    connection.ping(self, socket);
                }
                None
            }
            Frame::Ack(received) => {
                self.acknowledged(received);
                None
            }
            Frame::Open(_) => return Err(Error::Protocol("a second opening frame")),
        };
        if let Some(record) = record {
            match Record::decode(record)? {
                Record::Data(data) => {
                    if let Some(data) = self.unpacked(data) {
                        handler.record(Record::Data(data), arrived);
                    }
                }
                Record::Control(json) if self.is_answer(&json) => {}
                record => handler.record(record, arrived),
            }
        }
        let come = self.state.lock().incoming.received().bytes;
        if std::mem::take(&mut connection.big_came)
            || connection.unacknowledged >= ACK_AFTER.0
            || come - connection.acknowledged_bytes >= ACK_AFTER.1
        {
            let ack = Frame::Ack(self.received(connection));
            socket.queue(opcode::BINARY, ack.encode());
        }
        Ok(())
    }

    /// What has come, about to be told.
    fn received(&self, connection: &mut Connection) -> Received {
        let received = self.state.lock().incoming.received();
        connection.unacknowledged = 0;
        connection.acknowledged_bytes = received.bytes;
        received
    }

    fn acknowledged(&self, received: Received) {
        let mut state = self.state.lock();
        state.out.acknowledge(received.number);
        let at = Instant::now();
        let idle = state.out.is_idle();
        let sent = state.out.sent;
        if let Some(before) = &state.measured {
            let seconds = at.duration_since(before.at).as_secs_f64();
            let rate = received.bytes.saturating_sub(before.bytes) as f64 / seconds.max(1e-6);
            // With nothing to send a link is not slow: all of it had been sent by then, or there was more all the time.
            let busy = before.sent >= received.bytes || (!idle && !before.idle);
            let counts = busy && seconds > 0.001 && received.bytes > before.bytes;
            if counts || state.throughput.is_some_and(|known| rate > known) {
                state.measure(rate);
            }
        }
        state.measured = Some(Told {
            at,
            bytes: received.bytes,
            sent,
            idle,
        });
    }
}

/// What the peer last said of how much had come.
#[derive(Debug, Clone, Copy)]
struct Told {
    at: Instant,
    bytes: u64,
    /// How much had been sent then.
    sent: u64,
    /// That was all there was.
    idle: bool,
}

impl State {
    /// The link carried so many bytes per second for a while. What disturbs a measurement makes it smaller, so the
    /// first ones count by the greatest among them.
    fn measure(&mut self, rate: f64) {
        let Some(known) = self.throughput else {
            self.first_rates.push(rate);
            if self.first_rates.len() == FIRST_RATES {
                let greatest = self.first_rates.drain(..).fold(0.0, f64::max);
                self.set_throughput(greatest);
            }
            return;
        };
        self.set_throughput(known + NEWEST * (rate - known));
    }

    fn set_throughput(&mut self, rate: f64) {
        self.throughput = Some(rate);
        self.out.set_throughput(rate);
        let pays = self.packing.pays(Some(rate));
        self.out.set_packs(pays);
    }
}

enum Event {
    Message(Result<Message, WsError>),
    Woken,
    Ended,
    Tick,
}

/// What belongs to one connection.
struct Connection {
    period: Duration,
    heard: Instant,
    pongs: u32,
    unacknowledged: u32,
    acknowledged_bytes: u64,
    big_came: bool,
}

impl Connection {
    fn new(options: &SessionOptions) -> Self {
        Self {
            period: options.ping,
            heard: Instant::now(),
            pongs: 0,
            unacknowledged: 0,
            acknowledged_bytes: 0,
            big_came: false,
        }
    }

    fn next_tick(&self) -> Instant {
        Instant::now() + self.period
    }

    fn ping<S: AsyncRead + AsyncWrite + Unpin>(
        &mut self,
        session: &Session,
        socket: &mut WebSocket<S>,
    ) {
        let received = session.received(self);
        let ping = Frame::Ping {
            sent: now(),
            received,
        };
        socket.queue(opcode::BINARY, ping.encode());
    }
}

fn socket_lost(error: WsError) -> Lost {
    match error {
        WsError::Refused { .. } => {
            Lost::Protocol(Error::Protocol("its WebSocket frames are broken"))
        }
        error => Lost::Socket(error.to_string()),
    }
}

/// Sends an opening frame.
pub async fn send_open<S, T>(socket: &mut WebSocket<S>, open: &T) -> Result<(), Lost>
where
    S: AsyncRead + AsyncWrite + Unpin,
    T: Serialize,
{
    let json = serde_json::to_vec(open).unwrap_or_default();
    socket.queue(opcode::BINARY, Frame::Open(json.into()).encode());
    poll_fn(|cx| socket.poll_flush(cx))
        .await
        .map_err(|error| Lost::Socket(error.to_string()))
}

/// Reads the peer's opening frame; `what` it should be is for messages.
pub async fn receive_open<S, T>(socket: &mut WebSocket<S>, what: &'static str) -> Result<T, Lost>
where
    S: AsyncRead + AsyncWrite + Unpin,
    T: DeserializeOwned,
{
    loop {
        match poll_fn(|cx| socket.poll_next(cx))
            .await
            .map_err(socket_lost)?
        {
            Message::Binary(bytes) => {
                let Frame::Open(json) = Frame::decode(bytes)? else {
                    return Err(Error::Protocol("no opening frame").into());
                };
                return serde_json::from_slice(&json).map_err(|error| {
                    let reason = error.to_string();
                    Error::Json { what, reason }.into()
                });
            }
            Message::Close(code, reason) => return Err(Lost::Closed { code, reason }),
            // A portal that speaks no link says why in a rosbridge status message.
            Message::Text(text) => {
                let reason = String::from_utf8_lossy(&text).into_owned();
                return Err(Lost::Closed { code: 1002, reason });
            }
            Message::Ping(payload) => socket.queue(opcode::PONG, payload),
            Message::Pong(_) => {}
        }
    }
}

#[cfg(test)]
mod tests;
