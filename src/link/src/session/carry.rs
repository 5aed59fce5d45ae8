//! One connection of a session, from its opening frames to its end.

use std::future::{Future, poll_fn};
use std::pin::{Pin, pin};
use std::sync::atomic::Ordering;
use std::task::Poll;
use std::time::Duration;

use bytes::Bytes;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::sync::watch;
use tokio::task::JoinHandle;
use tokio::time::{Instant, Sleep, sleep_until, timeout};
use ws::{Message, WebSocket, WsError, frame as opcode};

use super::{Handler, Lost, Session, SessionOptions};
use crate::Error;
use crate::clock::{Sample, now};
use crate::control::Order;
use crate::frame::{Frame, Received};
use crate::packing::Packed;
use crate::record::Record;

/// Acknowledged at the latest after so many records, and bytes.
const ACK_AFTER: (u32, u64) = (64, 64 * 1024);
/// After so many messages in a row those who pass them on have their turn, or their queues would overflow.
const IN_A_ROW: u32 = 32;
/// Bytes that a call takes beside its request, until it is answered.
const CALL: usize = 1024;
/// For the peer to take what still waits when this side ends the session: without a sign of it, and at most.
const TAKES: (Duration, Duration) = (Duration::from_secs(2), Duration::from_secs(10));
/// For its close frame after that.
const FAREWELL: Duration = Duration::from_secs(1);
/// Exchanges made at once on a new connection, to know the peer's clock.
const FIRST_PINGS: u32 = 6;

impl<O: Order> Session<O> {
    /// Carries the session over a connection that was opened, until that ends.
    pub async fn run<S, H>(&self, socket: &mut WebSocket<S>, handler: &H) -> Lost
    where
        S: AsyncRead + AsyncWrite + Unpin,
        H: Handler<O::OfPeer> + ?Sized,
    {
        let lost = {
            // Nothing carries the session any more when this future is dropped, either.
            let _down = Down(&self.up);
            match self.carry(socket, handler).await {
                Ok(never) => match never {},
                Err(lost) => lost,
            }
        };
        let goodbye = match &lost {
            Lost::Ended => {
                let ending = &self.state.lock().ending;
                ending
                    .as_ref()
                    .map(|ending| (ending.code, ending.reason.clone()))
            }
            Lost::Closed { code, .. } => Some((*code, String::new())),
            lost => lost.goodbye(),
        };
        if let Some((code, reason)) = goodbye {
            socket.queue_close(code, &reason);
            let is_closed = matches!(lost, Lost::Closed { .. });
            let _ = timeout(FAREWELL, socket.leave(!is_closed)).await;
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
        H: Handler<O::OfPeer> + ?Sized,
    {
        let mut connection = Connection::new();
        let mut job: Option<JoinHandle<Packed>> = None;
        let mut tick = pin!(sleep_until(connection.next_tick(&self.options)));
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
                if self.has_ended(&connection, socket.queued()) {
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
                    connection.in_a_row += 1;
                    if connection.in_a_row == IN_A_ROW {
                        connection.in_a_row = 0;
                        tokio::task::yield_now().await;
                    }
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
                            return Err(Lost::Closed { code, reason });
                        }
                    }
                }
                Event::Woken => {
                    if let Some(reason) = self.state.lock().out.is_full() {
                        return Err(Lost::Full(reason.to_owned()));
                    }
                    if self.asked.swap(false, Ordering::Relaxed) {
                        connection.ping(self, socket);
                    }
                    if let Some(by) = self.ends_by(&connection) {
                        let first = by.min(tick.deadline());
                        Sleep::reset(tick.as_mut(), first);
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
                    if connection.pinged.elapsed() >= self.options.ping {
                        connection.ping(self, socket);
                    }
                    let next = connection.next_tick(&self.options);
                    let by = self.ends_by(&connection).unwrap_or(next);
                    Sleep::reset(tick.as_mut(), next.min(by));
                }
            }
        }
    }

    /// Whether this side has ended the session and the peer has all that waited, or had time enough.
    fn has_ended(&self, connection: &Connection, queued: usize) -> bool {
        let by = self.ends_by(connection);
        let is_through = || queued == 0 && self.state.lock().out.is_empty();
        by.is_some_and(|by| by <= Instant::now() || is_through())
    }

    /// When what the peer does not take is given up, where this side has ended the session.
    fn ends_by(&self, connection: &Connection) -> Option<Instant> {
        let ended = self.state.lock().ending.as_ref()?.at.max(connection.begun);
        let (unheard, most) = TAKES;
        Some((connection.heard.max(ended) + unheard).min(ended + most))
    }

    fn fill<S: AsyncRead + AsyncWrite + Unpin>(&self, socket: &mut WebSocket<S>) {
        let mut state = self.state.lock();
        let low_water = state.out.low_water();
        while socket.queued() < low_water {
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
        H: Handler<O::OfPeer> + ?Sized,
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
                self.pongs.send_modify(|pongs| *pongs += 1);
                if connection.pongs < FIRST_PINGS {
                    connection.ping(self, socket);
                }
                None
            }
            Frame::Ack(received) => {
                self.acknowledged(received);
                None
            }
            Frame::Damaged { channel, born } => {
                self.came_damaged(channel, born);
                None
            }
            Frame::Open(_) => return Err(Error::Protocol("a second opening frame")),
        };
        if let Some(record) = record {
            let mut held = self.told.permit();
            let record = Record::decode(record)?;
            let understood = match record {
                Record::Data(data) => {
                    let channel = data.channel;
                    match self.unpacked(data) {
                        Ok(data) => Some(Record::Data(data)),
                        Err(told) => {
                            handler.undecodable(channel);
                            // Before an acknowledgement can make the peer forget the message.
                            if let Some(frame) = told {
                                socket.queue(opcode::BINARY, frame.encode());
                            }
                            None
                        }
                    }
                }
                Record::Call {
                    id, ref request, ..
                } => match self.called.take(CALL + request.len()) {
                    Ok(permit) => {
                        held = permit;
                        record.read(|_| Ok::<_, Error>(None))?
                    }
                    Err(full) => {
                        self.answer(id, arrived, Err(full.to_string()));
                        None
                    }
                },
                record => record.read(|json| self.understood(&json, &mut held))?,
            };
            if let Some(record) = understood {
                handler.record(record, held, arrived);
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
}

/// Says that the session is not carried any more, once it is dropped.
struct Down<'a>(&'a watch::Sender<bool>);

impl Drop for Down<'_> {
    fn drop(&mut self) {
        self.0.send_replace(false);
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
    begun: Instant,
    heard: Instant,
    pinged: Instant,
    pongs: u32,
    unacknowledged: u32,
    acknowledged_bytes: u64,
    big_came: bool,
    in_a_row: u32,
}

impl Connection {
    fn new() -> Self {
        Self {
            begun: Instant::now(),
            heard: Instant::now(),
            pinged: Instant::now(),
            pongs: 0,
            unacknowledged: 0,
            acknowledged_bytes: 0,
            big_came: false,
            in_a_row: 0,
        }
    }

    /// The next ping, or the moment at which the peer will have been silent for too long: not a ping later.
    fn next_tick(&self, options: &SessionOptions) -> Instant {
        let limits = [options.silent, options.lost].map(|limit| self.heard + limit);
        let now = Instant::now();
        let ahead = limits.into_iter().filter(|limit| *limit > now);
        ahead.fold(self.pinged + options.ping, Instant::min)
    }

    fn ping<S: AsyncRead + AsyncWrite + Unpin>(
        &mut self,
        session: &Session<impl Order>,
        socket: &mut WebSocket<S>,
    ) {
        self.pinged = Instant::now();
        let received = session.received(self);
        let ping = Frame::Ping {
            sent: now(),
            received,
        };
        socket.queue(opcode::BINARY, ping.encode());
    }
}

pub(super) fn socket_lost(error: WsError) -> Lost {
    match error {
        WsError::Refused { code, reason } => Lost::Protocol(Error::Refused { code, reason }),
        error => Lost::Socket(error.to_string()),
    }
}
