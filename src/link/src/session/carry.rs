//! One connection of a session, from its opening frames to its end.

use std::future::{Future, poll_fn};
use std::pin::{Pin, pin};
use std::sync::atomic::Ordering;
use std::task::{Context, Poll};
use std::time::Duration;

use bytes::Bytes;
use ros::bus::FailureReason;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::sync::watch;
use tokio::task::JoinHandle;
use tokio::time::{Instant, Sleep, sleep_until, timeout};
use ws::{WebSocket, WsError, WsMessage, frame as opcode};

use super::{DisconnectReason, Session, SessionHandler, SessionOptions};
use crate::Error;
use crate::clock::{ClockSample, now};
use crate::control::ControlMessage;
use crate::frame::{Frame, ReceiveProgress};
use crate::packing::EncodedMessage;
use crate::record::Record;

/// Number of records and bytes after which an acknowledgement is sent.
const ACK_AFTER: (u32, u64) = (64, 64 * 1024);
/// Number of messages in a row after which other tasks get a turn, or the queues of those that forward them would
/// overflow.
const IN_A_ROW: u32 = 32;
/// Number of bytes written in a row after which the socket is read, however much it accepts: the peer's signs of life
/// and acknowledgements must not wait for the end of an image.
const WRITTEN_IN_A_ROW: usize = 256 * 1024;
/// Interval at which the peer is shown that a long message is being received. It is shorter than the minimum silence
/// timeout.
const SIGN: Duration = Duration::from_millis(20);
/// Memory overhead of a call in bytes, until it is answered.
const CALL: usize = 1024;
/// Time for the peer to receive what is queued when this end closes the session: without a sign of the peer, and in
/// total.
const TAKES: (Duration, Duration) = (Duration::from_secs(2), Duration::from_secs(10));
/// Time for the peer's close frame after that.
const FAREWELL: Duration = Duration::from_secs(1);
/// Number of pings sent immediately on a new connection to measure the peer's clock.
const FIRST_PINGS: u32 = 6;

impl<O: ControlMessage> Session<O> {
    /// Carries the session over an opened connection until the connection ends.
    pub async fn run<S, H>(&self, socket: &mut WebSocket<S>, handler: &H) -> DisconnectReason
    where
        S: AsyncRead + AsyncWrite + Unpin,
        H: SessionHandler<O::FromPeer> + ?Sized,
    {
        let lost = {
            // The session is also no longer carried when this future is dropped.
            let _down = DownGuard(&self.up);
            match self.run_connection(socket, handler).await {
                Ok(never) => match never {},
                Err(lost) => lost,
            }
        };
        let goodbye = match &lost {
            DisconnectReason::Ended => {
                let ending = &self.state.lock().ending;
                ending.as_ref().map(|ending| (ending.code, ending.reason.clone()))
            }
            DisconnectReason::Closed { code, .. } => Some((*code, String::new())),
            lost => lost.close_frame(),
        };
        if let Some((code, reason)) = goodbye {
            socket.queue_close(code, &reason);
            let is_closed = matches!(lost, DisconnectReason::Closed { .. });
            let _ = timeout(FAREWELL, socket.shutdown(!is_closed)).await;
        }
        lost
    }

    async fn run_connection<S, H>(
        &self,
        socket: &mut WebSocket<S>,
        handler: &H,
    ) -> Result<std::convert::Infallible, DisconnectReason>
    where
        S: AsyncRead + AsyncWrite + Unpin,
        H: SessionHandler<O::FromPeer> + ?Sized,
    {
        let mut connection = SessionConnection::new();
        let mut job: Option<JoinHandle<EncodedMessage>> = None;
        let mut tick = pin!(sleep_until(connection.next_tick(&self.options)));
        connection.ping(self, socket);
        self.up.send_if_modified(|up| !std::mem::replace(up, true));
        loop {
            let mut woken = pin!(self.wake.notified());
            let event = poll_fn(|cx| {
                loop {
                    let may_write_more = match self.poll_write(socket, &mut job, cx) {
                        Ok(more) => more,
                        Err(error) => return Poll::Ready(ConnectionEvent::Message(Err(error))),
                    };
                    if self.is_finished(&connection, socket.bytes_queued()) {
                        return Poll::Ready(ConnectionEvent::Ended);
                    }
                    if let Poll::Ready(message) = socket.poll_next(cx) {
                        return Poll::Ready(ConnectionEvent::Message(message));
                    }
                    if self.note_received_bytes(socket, &mut connection) {
                        continue;
                    }
                    if woken.as_mut().poll(cx).is_ready() {
                        return Poll::Ready(ConnectionEvent::Woken);
                    }
                    if tick.as_mut().poll(cx).is_ready() {
                        return Poll::Ready(ConnectionEvent::Tick);
                    }
                    if !may_write_more {
                        return Poll::Pending;
                    }
                }
            })
            .await;
            match event {
                ConnectionEvent::Message(message) => {
                    connection.heard = Instant::now();
                    connection.in_a_row += 1;
                    if connection.in_a_row == IN_A_ROW {
                        connection.in_a_row = 0;
                        tokio::task::yield_now().await;
                    }
                    self.up.send_if_modified(|up| !std::mem::replace(up, true));
                    match message.map_err(disconnect_reason)? {
                        WsMessage::Binary(bytes) => {
                            self.handle_frame(socket, &mut connection, bytes, handler)?;
                        }
                        WsMessage::Ping(payload) => socket.queue(opcode::PONG, payload),
                        WsMessage::Pong(_) => {}
                        WsMessage::Text(_) => {
                            return Err(Error::Protocol("text, where frames are binary").into());
                        }
                        WsMessage::Close(code, reason) => {
                            return Err(DisconnectReason::Closed { code, reason });
                        }
                    }
                }
                ConnectionEvent::Woken => {
                    if let Some(reason) = self.state.lock().out.overflow_reason() {
                        return Err(DisconnectReason::Full(reason.to_owned()));
                    }
                    if self.asked.swap(false, Ordering::Relaxed) {
                        connection.ping(self, socket);
                    }
                    if let Some(by) = self.close_deadline(&connection) {
                        let first = by.min(tick.deadline());
                        Sleep::reset(tick.as_mut(), first);
                    }
                }
                ConnectionEvent::Ended => return Err(DisconnectReason::Ended),
                ConnectionEvent::Tick => {
                    let silence = connection.heard.elapsed();
                    if silence >= self.options.lost {
                        return Err(DisconnectReason::Silent(silence));
                    }
                    if silence >= self.options.silent {
                        self.up.send_if_modified(|up| std::mem::replace(up, false));
                    }
                    if connection.pinged.elapsed() >= self.options.ping {
                        connection.ping(self, socket);
                    }
                    let next = connection.next_tick(&self.options);
                    let by = self.close_deadline(&connection).unwrap_or(next);
                    Sleep::reset(tick.as_mut(), next.min(by));
                }
            }
        }
    }

    /// Encodes and writes what is queued, until the socket accepts no more, nothing is left or enough was written in a
    /// row. Returns whether the latter is why it stopped.
    fn poll_write<S: AsyncRead + AsyncWrite + Unpin>(
        &self,
        socket: &mut WebSocket<S>,
        job: &mut Option<JoinHandle<EncodedMessage>>,
        cx: &mut Context<'_>,
    ) -> Result<bool, WsError> {
        let mut written = 0;
        while written < WRITTEN_IN_A_ROW {
            self.fill_socket(socket);
            if job.is_none() {
                *job = self.start_encoding();
            }
            let polled = job.as_mut().map(|job| Pin::new(job).poll(cx));
            if let Some(Poll::Ready(packed)) = polled {
                *job = None;
                self.finish_encoding(packed.ok());
                continue;
            }
            let queued = socket.bytes_queued();
            if queued == 0 {
                return Ok(false);
            }
            match socket.poll_flush(cx) {
                Poll::Ready(flushed) => flushed?,
                Poll::Pending => return Ok(false),
            }
            written += queued;
        }
        Ok(true)
    }

    /// Counts bytes of an unfinished message as a sign of the peer, and gives it one: it may have sent a message that
    /// takes longer than its silence timeout. That the kernel accepted bytes is no such sign, since it accepts
    /// megabytes for a peer that is gone. Returns whether something was queued for the peer.
    fn note_received_bytes<S: AsyncRead + AsyncWrite + Unpin>(
        &self,
        socket: &mut WebSocket<S>,
        connection: &mut SessionConnection,
    ) -> bool {
        let received = socket.bytes_received();
        if received == std::mem::replace(&mut connection.bytes_received, received) {
            return false;
        }
        connection.heard = Instant::now();
        self.up.send_if_modified(|up| !std::mem::replace(up, true));
        // What is queued already is as good a sign. A peer that sends and never reads would make more and more of them.
        let is_due = connection.signed.elapsed() >= SIGN && socket.bytes_queued() == 0;
        if !is_due || !(socket.is_receiving() || self.state.lock().incoming.is_receiving()) {
            return false;
        }
        connection.signed = Instant::now();
        // A pong that nobody asked for (RFC 6455, section 5.5.3). An acknowledgement without progress would disturb the
        // peer's estimate of the throughput.
        socket.queue(opcode::PONG, Bytes::new());
        true
    }

    /// Returns whether this end has closed the session and the peer has received everything queued, or had enough time.
    fn is_finished(&self, connection: &SessionConnection, queued: usize) -> bool {
        let by = self.close_deadline(connection);
        let is_through = || queued == 0 && self.state.lock().out.is_empty();
        by.is_some_and(|by| by <= Instant::now() || is_through())
    }

    /// Returns the time at which undelivered records are given up, if this end has closed the session.
    fn close_deadline(&self, connection: &SessionConnection) -> Option<Instant> {
        let ended = self.state.lock().ending.as_ref()?.at.max(connection.begun);
        let (unheard, most) = TAKES;
        Some((connection.heard.max(ended) + unheard).min(ended + most))
    }

    fn fill_socket<S: AsyncRead + AsyncWrite + Unpin>(&self, socket: &mut WebSocket<S>) {
        let mut state = self.state.lock();
        let low_water = state.out.low_water();
        while socket.bytes_queued() < low_water {
            let Some(frame) = state.out.next(now()) else {
                return;
            };
            socket.queue(opcode::BINARY, frame.encode());
        }
    }

    fn handle_frame<S, H>(
        &self,
        socket: &mut WebSocket<S>,
        connection: &mut SessionConnection,
        bytes: Bytes,
        handler: &H,
    ) -> Result<(), Error>
    where
        S: AsyncRead + AsyncWrite + Unpin,
        H: SessionHandler<O::FromPeer> + ?Sized,
    {
        let arrived = now();
        let record = match Frame::decode(bytes)? {
            Frame::Whole { number, record } => {
                connection.unacknowledged += u32::from(number != 0);
                self.state.lock().incoming.receive_whole(number, record)?
            }
            Frame::Begin { stream, number, total, bytes } => {
                connection.unacknowledged += u32::from(number != 0);
                let incoming = &mut self.state.lock().incoming;
                incoming.receive_begin(stream, number, total, &bytes)?
            }
            Frame::More { stream, bytes } => {
                let whole = self.state.lock().incoming.receive_more(stream, &bytes)?;
                // The end of a big record shows how fast the link is.
                connection.big_came = whole.is_some();
                whole
            }
            Frame::Ping { sent, received } => {
                self.on_acknowledged(received);
                let received = self.take_progress(connection);
                let pong = Frame::Pong { sent, arrived, left: now(), received };
                socket.queue(opcode::BINARY, pong.encode());
                None
            }
            Frame::Pong { sent, arrived: there, left, received } => {
                self.on_acknowledged(received);
                let sample = ClockSample::new(sent, there, left, arrived);
                let best = {
                    let clock = &mut self.state.lock().clock;
                    clock.add(sample);
                    clock.best()
                };
                if let Some(best) = best {
                    handler.on_clock_sample(best);
                }
                connection.pongs += 1;
                self.pongs.send_modify(|pongs| *pongs += 1);
                if connection.pongs < FIRST_PINGS {
                    connection.ping(self, socket);
                }
                None
            }
            Frame::Ack(received) => {
                self.on_acknowledged(received);
                None
            }
            Frame::Damaged { channel, born } => {
                self.on_damaged(channel, born);
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
                    match self.decode_message(data) {
                        Ok(data) => Some(Record::Data(data)),
                        Err(told) => {
                            handler.on_undecodable(channel);
                            // Sent before an acknowledgement can make the peer discard the message.
                            if let Some(frame) = told {
                                socket.queue(opcode::BINARY, frame.encode());
                            }
                            None
                        }
                    }
                }
                Record::Call { id, ref request, .. } => match self.called.take(CALL + request.len()) {
                    Ok(permit) => {
                        held = permit;
                        record.try_map_control(|_| Ok::<_, Error>(None))?
                    }
                    Err(full) => {
                        self.answer(id, arrived, Err(FailureReason::new(full.to_string())));
                        None
                    }
                },
                record => record.try_map_control(|json| self.parse_control(&json, &mut held))?,
            };
            if let Some(record) = understood {
                handler.on_record(record, held, arrived);
            }
        }
        let come = self.state.lock().incoming.progress().bytes;
        if std::mem::take(&mut connection.big_came)
            || connection.unacknowledged >= ACK_AFTER.0
            || come - connection.acknowledged_bytes >= ACK_AFTER.1
        {
            let ack = Frame::Ack(self.take_progress(connection));
            socket.queue(opcode::BINARY, ack.encode());
        }
        Ok(())
    }

    /// Returns the receive progress, which the caller sends to the peer.
    fn take_progress(&self, connection: &mut SessionConnection) -> ReceiveProgress {
        let received = self.state.lock().incoming.progress();
        connection.signed = Instant::now();
        connection.unacknowledged = 0;
        connection.acknowledged_bytes = received.bytes;
        received
    }
}

/// Marks the session as disconnected when dropped.
struct DownGuard<'a>(&'a watch::Sender<bool>);

impl Drop for DownGuard<'_> {
    fn drop(&mut self) {
        self.0.send_replace(false);
    }
}

enum ConnectionEvent {
    Message(Result<WsMessage, WsError>),
    Woken,
    Ended,
    Tick,
}

/// State of one connection.
struct SessionConnection {
    begun: Instant,
    /// Time at which the last bytes of the peer were read.
    heard: Instant,
    bytes_received: u64,
    /// Time at which the peer was last told that something was received.
    signed: Instant,
    pinged: Instant,
    pongs: u32,
    unacknowledged: u32,
    acknowledged_bytes: u64,
    big_came: bool,
    in_a_row: u32,
}

impl SessionConnection {
    fn new() -> Self {
        Self {
            begun: Instant::now(),
            heard: Instant::now(),
            bytes_received: 0,
            signed: Instant::now(),
            pinged: Instant::now(),
            pongs: 0,
            unacknowledged: 0,
            acknowledged_bytes: 0,
            big_came: false,
            in_a_row: 0,
        }
    }

    /// Returns the time of the next ping, or the time at which the peer will have been silent for too long, if that is
    /// earlier.
    fn next_tick(&self, options: &SessionOptions) -> Instant {
        let limits = [options.silent, options.lost].map(|limit| self.heard + limit);
        let now = Instant::now();
        let ahead = limits.into_iter().filter(|limit| *limit > now);
        ahead.fold(self.pinged + options.ping, Instant::min)
    }

    fn ping<S: AsyncRead + AsyncWrite + Unpin>(
        &mut self,
        session: &Session<impl ControlMessage>,
        socket: &mut WebSocket<S>,
    ) {
        self.pinged = Instant::now();
        let received = session.take_progress(self);
        let ping = Frame::Ping { sent: now(), received };
        socket.queue(opcode::BINARY, ping.encode());
    }
}

pub(super) fn disconnect_reason(error: WsError) -> DisconnectReason {
    match error {
        WsError::Refused { code, reason } => DisconnectReason::Protocol(Error::Refused { code, reason }),
        error => DisconnectReason::Socket(error.to_string()),
    }
}
