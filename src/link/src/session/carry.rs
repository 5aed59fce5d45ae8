//! One connection of a session, from its opening frames to its end.

use std::convert::Infallible;
use std::future::{Future, poll_fn};
use std::pin::{Pin, pin};
use std::sync::atomic::Ordering;
use std::task::{Context, Poll};
use std::time::Duration;

use bytes::Bytes;
use ros::bus::FailureReason;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::task::JoinHandle;
use tokio::time::{Instant, sleep_until, timeout};
use ws::{WebSocket, WsError, WsMessage, frame as opcode};

use super::{DisconnectReason, Session, SessionHandler};
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
        let Err(lost) = SessionConnection::new(self, socket, handler).run().await;
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
}

enum ConnectionEvent {
    Message(WsMessage),
    Woken,
    Tick,
}

/// A connection that carries a session.
struct SessionConnection<'a, O, S, H: ?Sized> {
    session: &'a Session<O>,
    socket: &'a mut WebSocket<S>,
    handler: &'a H,
    /// The encoder at work, on another thread.
    job: Option<JoinHandle<EncodedMessage>>,
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

impl<O, S, H: ?Sized> Drop for SessionConnection<'_, O, S, H> {
    /// Marks the session as disconnected, also when the future that carries it is dropped.
    fn drop(&mut self) {
        self.session.up.send_replace(false);
    }
}

impl<'a, O, S, H> SessionConnection<'a, O, S, H>
where
    O: ControlMessage,
    S: AsyncRead + AsyncWrite + Unpin,
    H: SessionHandler<O::FromPeer> + ?Sized,
{
    fn new(session: &'a Session<O>, socket: &'a mut WebSocket<S>, handler: &'a H) -> Self {
        let now = Instant::now();
        Self {
            session,
            socket,
            handler,
            job: None,
            begun: now,
            heard: now,
            bytes_received: 0,
            signed: now,
            pinged: now,
            pongs: 0,
            unacknowledged: 0,
            acknowledged_bytes: 0,
            big_came: false,
            in_a_row: 0,
        }
    }

    async fn run(mut self) -> Result<Infallible, DisconnectReason> {
        let session = self.session;
        let mut tick = pin!(sleep_until(self.next_tick()));
        self.ping();
        self.set_up(true);
        loop {
            let mut woken = pin!(session.wake.notified());
            let event = poll_fn(|cx| {
                loop {
                    let may_write_more = self.poll_write(cx)?;
                    if self.is_finished() {
                        return Poll::Ready(Err(DisconnectReason::Ended));
                    }
                    if let Poll::Ready(message) = self.socket.poll_next(cx)? {
                        return Poll::Ready(Ok(ConnectionEvent::Message(message)));
                    }
                    if self.note_received_bytes() {
                        continue;
                    }
                    if woken.as_mut().poll(cx).is_ready() {
                        return Poll::Ready(Ok(ConnectionEvent::Woken));
                    }
                    if tick.as_mut().poll(cx).is_ready() {
                        return Poll::Ready(Ok(ConnectionEvent::Tick));
                    }
                    if !may_write_more {
                        return Poll::Pending;
                    }
                }
            });
            match event.await? {
                ConnectionEvent::Message(message) => {
                    self.heard = Instant::now();
                    self.in_a_row += 1;
                    if self.in_a_row == IN_A_ROW {
                        self.in_a_row = 0;
                        tokio::task::yield_now().await;
                    }
                    self.set_up(true);
                    match message {
                        WsMessage::Binary(bytes) => self.handle_frame(bytes)?,
                        WsMessage::Ping(payload) => self.socket.queue(opcode::PONG, payload),
                        WsMessage::Pong(_) => {}
                        WsMessage::Text(_) => return Err(Error::Protocol("text, where frames are binary").into()),
                        WsMessage::Close(code, reason) => return Err(DisconnectReason::Closed { code, reason }),
                    }
                }
                ConnectionEvent::Woken => {
                    if let Some(reason) = &session.state.lock().out.overflow_reason {
                        return Err(DisconnectReason::Full(reason.clone()));
                    }
                    if session.asked.swap(false, Ordering::Relaxed) {
                        self.ping();
                    }
                    if self.close_deadline().is_some() {
                        tick.as_mut().reset(self.next_tick());
                    }
                }
                ConnectionEvent::Tick => {
                    let silence = self.heard.elapsed();
                    if silence >= session.options.lost {
                        return Err(DisconnectReason::Silent(silence));
                    }
                    if silence >= session.options.silent {
                        self.set_up(false);
                    }
                    if self.pinged.elapsed() >= session.options.ping {
                        self.ping();
                    }
                    tick.as_mut().reset(self.next_tick());
                }
            }
        }
    }

    fn set_up(&self, is_up: bool) {
        self.session.up.send_if_modified(|up| std::mem::replace(up, is_up) != is_up);
    }

    /// Encodes and writes what is queued, until the socket accepts no more, nothing is left or enough was written in a
    /// row. Returns whether the latter is why it stopped.
    fn poll_write(&mut self, cx: &mut Context<'_>) -> Result<bool, WsError> {
        let mut written = 0;
        while written < WRITTEN_IN_A_ROW {
            self.fill_socket();
            if self.job.is_none() {
                self.job = self.session.start_encoding();
            }
            let polled = self.job.as_mut().map(|job| Pin::new(job).poll(cx));
            if let Some(Poll::Ready(packed)) = polled {
                self.job = None;
                self.session.finish_encoding(packed.ok());
                continue;
            }
            let queued = self.socket.bytes_queued();
            if queued == 0 {
                return Ok(false);
            }
            match self.socket.poll_flush(cx) {
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
    fn note_received_bytes(&mut self) -> bool {
        let received = self.socket.bytes_received();
        if received == std::mem::replace(&mut self.bytes_received, received) {
            return false;
        }
        self.heard = Instant::now();
        self.set_up(true);
        // What is queued already is as good a sign. A peer that sends and never reads would make more and more of them.
        let is_due = self.signed.elapsed() >= SIGN && self.socket.bytes_queued() == 0;
        if !is_due || !(self.socket.is_receiving() || self.session.state.lock().incoming.is_receiving()) {
            return false;
        }
        self.signed = Instant::now();
        // A pong that nobody asked for (RFC 6455, section 5.5.3). An acknowledgement without progress would disturb the
        // peer's estimate of the throughput.
        self.socket.queue(opcode::PONG, Bytes::new());
        true
    }

    /// Returns whether this end has closed the session and the peer has received everything queued, or had enough time.
    fn is_finished(&self) -> bool {
        let is_through = || self.socket.bytes_queued() == 0 && self.session.state.lock().out.is_empty();
        self.close_deadline().is_some_and(|by| by <= Instant::now() || is_through())
    }

    /// Returns the time at which undelivered records are given up, if this end has closed the session.
    fn close_deadline(&self) -> Option<Instant> {
        let ended = self.session.state.lock().ending.as_ref()?.at.max(self.begun);
        let (unheard, most) = TAKES;
        Some((self.heard.max(ended) + unheard).min(ended + most))
    }

    fn fill_socket(&mut self) {
        let mut state = self.session.state.lock();
        let low_water = state.out.low_water();
        while self.socket.bytes_queued() < low_water {
            let Some(frame) = state.out.next(now()) else {
                return;
            };
            self.socket.queue(opcode::BINARY, frame.encode());
        }
    }

    fn handle_frame(&mut self, bytes: Bytes) -> Result<(), Error> {
        let (session, arrived) = (self.session, now());
        match Frame::decode(bytes)? {
            Frame::Whole { number, record } => {
                self.unacknowledged += u32::from(number != 0);
                let whole = session.state.lock().incoming.receive_whole(number, record)?;
                self.handle_record(whole, arrived)?;
            }
            Frame::Begin { stream, number, total, bytes } => {
                self.unacknowledged += u32::from(number != 0);
                let whole = session.state.lock().incoming.receive_begin(stream, number, total, &bytes)?;
                self.handle_record(whole, arrived)?;
            }
            Frame::More { stream, bytes } => {
                let whole = session.state.lock().incoming.receive_more(stream, &bytes)?;
                // The end of a big record shows how fast the link is.
                self.big_came = whole.is_some();
                self.handle_record(whole, arrived)?;
            }
            Frame::Ping { sent, received } => {
                session.on_acknowledged(received);
                let received = self.take_progress();
                self.queue(&Frame::Pong { sent, arrived, left: now(), received });
            }
            Frame::Pong { sent, arrived: there, left, received } => {
                session.on_acknowledged(received);
                let best = session.state.lock().clock.add(ClockSample::new(sent, there, left, arrived));
                self.handler.on_clock_sample(best);
                self.pongs += 1;
                session.pongs.send_modify(|pongs| *pongs += 1);
                if self.pongs < FIRST_PINGS {
                    self.ping();
                }
            }
            Frame::Ack(received) => session.on_acknowledged(received),
            Frame::Damaged { channel, born } => session.on_damaged(channel, born),
            Frame::Open(_) => return Err(Error::Protocol("a second opening frame")),
        }
        let come = session.state.lock().incoming.progress().bytes;
        if std::mem::take(&mut self.big_came)
            || self.unacknowledged >= ACK_AFTER.0
            || come - self.acknowledged_bytes >= ACK_AFTER.1
        {
            let received = self.take_progress();
            self.queue(&Frame::Ack(received));
        }
        Ok(())
    }

    /// Handles a record, if one is complete.
    fn handle_record(&mut self, record: Option<Bytes>, arrived: i64) -> Result<(), Error> {
        let Some(record) = record else {
            return Ok(());
        };
        let session = self.session;
        let mut held = session.told.permit();
        let understood = match Record::decode(record)? {
            Record::Control(json) => session.parse_control(&json, &mut held)?.map(Record::Control),
            Record::Data(data) => {
                let channel = data.channel;
                match session.decode_message(data) {
                    Ok(data) => Some(Record::Data(data)),
                    Err(told) => {
                        self.handler.on_undecodable(channel);
                        // Sent before an acknowledgement can make the peer discard the message.
                        told.iter().for_each(|frame| self.queue(frame));
                        None
                    }
                }
            }
            Record::Call(call) => match session.called.take(CALL + call.request.len()) {
                Ok(permit) => {
                    held = permit;
                    Some(Record::Call(call))
                }
                Err(full) => {
                    session.answer(call.id, arrived, Err(FailureReason::new(full.to_string())));
                    None
                }
            },
            Record::Answer { id, taken, given, response } => Some(Record::Answer { id, taken, given, response }),
        };
        if let Some(record) = understood {
            self.handler.on_record(record, held, arrived);
        }
        Ok(())
    }

    /// Returns the receive progress, which the caller sends to the peer.
    fn take_progress(&mut self) -> ReceiveProgress {
        let received = self.session.state.lock().incoming.progress();
        self.signed = Instant::now();
        self.unacknowledged = 0;
        self.acknowledged_bytes = received.bytes;
        received
    }

    /// Returns the time of the next ping, or the time at which the peer will have been silent for too long or the
    /// session is given up, if that is earlier.
    fn next_tick(&self) -> Instant {
        let options = &self.session.options;
        let limits = [options.silent, options.lost].map(|limit| self.heard + limit);
        let now = Instant::now();
        let ahead = limits.into_iter().filter(|limit| *limit > now).chain(self.close_deadline());
        ahead.fold(self.pinged + options.ping, Instant::min)
    }

    fn ping(&mut self) {
        self.pinged = Instant::now();
        let received = self.take_progress();
        self.queue(&Frame::Ping { sent: now(), received });
    }

    fn queue(&mut self, frame: &Frame) {
        self.socket.queue(opcode::BINARY, frame.encode());
    }
}
