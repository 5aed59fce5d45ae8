//! One socket: moves frames between it and its client, in one task, so that nothing is handed over between threads
//! on the way.

use std::collections::VecDeque;
use std::future::{Future, poll_fn};
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, ready};
use std::time::Instant;

use bytes::Bytes;
use rosbridge::{Compression, Format, Level};
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::time::{Sleep, timeout};

use crate::SessionEnd;
use crate::client::{Client, Inbox};
use crate::cut::Cuts;
use crate::outbox::{Control, Goodbye, Outgoing, TopicKey};
use crate::sample::{Frame, Sample};
use crate::ws::{Message, WebSocket, WsError, frame};

/// Bytes in the socket's queue beyond which nothing is added: so at most one big message stands before a small one.
const SOCKET_FULL: usize = 64 * 1024;
/// Frames taken from a client before its answers are sent.
const READ_BATCH: usize = 64;
/// Rounds before other tasks have their turn.
const ROUNDS: usize = 16;
/// While so many answers wait nothing more is read from the client.
const CONTROL_HIGH: usize = 256;
/// Answers kept until the client is known to have them.
const MAX_UNACKNOWLEDGED: usize = 1024;

/// The socket, its client and what lies between.
pub(crate) struct Session<S> {
    socket: WebSocket<S>,
    client: Arc<Client>,
    /// Which of the client's sockets this is.
    number: u64,
    inbox: Inbox,
    cuts: Cuts,
    heard: Instant,
    ping_at: Option<Instant>,
    pings: u64,
    /// Answers sent, by the ping that followed them.
    unacknowledged: VecDeque<(u64, Control)>,
    /// Reading was put off because answers wait.
    held_back: bool,
    timer: Pin<Box<Sleep>>,
    timer_at: Option<Instant>,
}

/// Why a session stops.
enum Stop {
    /// The client sent a close frame.
    Client { code: u16, reason: String },
    /// It is to be closed; `readable` unless the client's bytes can no longer be told apart.
    Close { code: u16, reason: String, readable: bool },
    /// The socket is of no more use.
    Lost(String),
}

impl<S: AsyncRead + AsyncWrite + Unpin> Session<S> {
    pub(crate) fn new(socket: WebSocket<S>, client: Arc<Client>, number: u64) -> Self {
        let now = Instant::now();
        let options = &client.shared.options;
        Self {
            socket,
            number,
            inbox: Inbox::new(&client.shared),
            cuts: Cuts::default(),
            heard: now,
            ping_at: (!options.ping_interval.is_zero()).then(|| now + options.ping_interval),
            pings: 0,
            unacknowledged: VecDeque::new(),
            held_back: false,
            timer: Box::pin(tokio::time::sleep_until(now.into())),
            timer_at: None,
            client,
        }
    }

    /// Moves what waits into the socket. Ready when there is nothing left, pending when the socket takes no more.
    fn write(&mut self, cx: &mut Context<'_>, now: Instant) -> Poll<std::io::Result<()>> {
        loop {
            while self.socket.queued() < SOCKET_FULL {
                let Some((opcode, bytes)) = self.next_frame(now) else { break };
                let metrics = &self.client.shared.metrics;
                metrics.frames_out.add(1);
                metrics.bytes_out.add(bytes.len() as u64);
                self.socket.queue(opcode, bytes);
            }
            if self.socket.queued() == 0 {
                return Poll::Ready(Ok(()));
            }
            self.request_acknowledgement();
            ready!(self.socket.poll_flush(cx))?;
        }
    }

    fn next_frame(&mut self, now: Instant) -> Option<(u8, Bytes)> {
        if self.cuts.is_due()
            && let Some(fragment) = self.next_fragment()
        {
            return Some(fragment);
        }
        loop {
            let next = if self.cuts.is_full() {
                self.client.outbox.next_control().map(Outgoing::Control)
            } else {
                self.client.outbox.next(now)
            };
            let frame = match next {
                None => return self.next_fragment(),
                Some(Outgoing::Control(control)) => {
                    self.remember(&control);
                    let cut = self.cuts.cut(&control.frame, control.fragment_size, None);
                    (!cut).then_some(control.frame)
                }
                Some(Outgoing::Sample { key, sample, topic, compression, fragment_size }) => {
                    let frame = self.encode(key, &sample, &topic, compression, now);
                    let cut = frame.as_ref().is_some_and(|frame| self.cuts.cut(frame, fragment_size, Some(key)));
                    if cut {
                        self.client.outbox.sending_fragments(key);
                    }
                    frame.filter(|_| !cut)
                }
            };
            if let Some(frame) = frame {
                self.cuts.make_due();
                return Some((frame.opcode(), frame.bytes));
            }
        }
    }

    fn next_fragment(&mut self) -> Option<(u8, Bytes)> {
        let (bytes, done) = self.cuts.next()?;
        if let Some(key) = done {
            self.client.outbox.fragments_sent(key);
        }
        Some((frame::TEXT, bytes))
    }

    fn encode(
        &self,
        key: TopicKey,
        sample: &Sample,
        topic: &Arc<str>,
        compression: Compression,
        now: Instant,
    ) -> Option<Frame> {
        let shared = &self.client.shared;
        match sample.frame(compression, topic, shared.options.non_finite, &shared.metrics) {
            Ok(frame) => Some(frame),
            Err(reason) => {
                if self.client.outbox.may_complain(key, now) {
                    let text = format!("subscribe: topic {topic}: {reason}");
                    self.client.status(Level::Error, None, Format::Json, &text);
                }
                None
            }
        }
    }

    /// Keeps an answer until a pong shows that the client has it.
    fn remember(&mut self, control: &Control) {
        if control.answer && self.client.is_resumable() {
            if self.unacknowledged.len() >= MAX_UNACKNOWLEDGED {
                self.unacknowledged.pop_front();
            }
            self.unacknowledged.push_back((self.pings + 1, control.clone()));
        }
    }

    fn request_acknowledgement(&mut self) {
        if self.unacknowledged.back().is_some_and(|(ping, _)| *ping > self.pings) {
            self.ping();
        }
    }

    fn ping(&mut self) {
        self.pings += 1;
        self.socket.queue(frame::PING, Bytes::copy_from_slice(&self.pings.to_be_bytes()));
    }

    fn pong(&mut self, payload: &[u8]) {
        if let Ok(number) = payload.try_into().map(u64::from_be_bytes) {
            while self.unacknowledged.front().is_some_and(|(ping, _)| *ping <= number) {
                self.unacknowledged.pop_front();
            }
        }
    }

    /// Takes frames from the client. Ready when a batch was taken, pending when none is there.
    fn read(&mut self, cx: &mut Context<'_>, now: Instant) -> Poll<Result<(), Stop>> {
        for _ in 0..READ_BATCH {
            // Who does not read what we answer has nothing more to say.
            if self.client.outbox.control_waiting() >= CONTROL_HIGH {
                self.held_back = true;
                return Poll::Pending;
            }
            let message = match ready!(self.socket.poll_next(cx)) {
                Ok(message) => message,
                Err(WsError::Refused { code, reason }) => {
                    return Poll::Ready(Err(Stop::Close { code, reason, readable: false }));
                }
                Err(error) => return Poll::Ready(Err(Stop::Lost(error.to_string()))),
            };
            self.heard = now;
            self.take(message)?;
        }
        Poll::Ready(Ok(()))
    }

    fn take(&mut self, message: Message) -> Result<(), Stop> {
        let metrics = &self.client.shared.metrics;
        match message {
            Message::Text(bytes) => {
                metrics.frames_in.add(1);
                metrics.bytes_in.add(bytes.len() as u64);
                match std::str::from_utf8(&bytes) {
                    Ok(text) => self.client.text(&mut self.inbox, text),
                    Err(_) => {
                        let reason = "a text frame is not UTF-8".to_owned();
                        return Err(Stop::Close { code: 1007, reason, readable: true });
                    }
                }
            }
            Message::Binary(bytes) => {
                metrics.frames_in.add(1);
                metrics.bytes_in.add(bytes.len() as u64);
                self.client.binary(&mut self.inbox, &bytes);
            }
            // Pongs that a client does not read pile up no higher than this.
            Message::Ping(payload) if self.socket.queued() < SOCKET_FULL => self.socket.queue(frame::PONG, payload),
            Message::Ping(_) => {}
            Message::Pong(payload) => self.pong(&payload),
            Message::Close(code, reason) => return Err(Stop::Client { code, reason }),
        }
        Ok(())
    }

    /// What the clock demands: a ping, a goodbye. Gives when to look again.
    fn mind_the_clock(&mut self, now: Instant) -> Result<Option<Instant>, Stop> {
        let options = &self.client.shared.options;
        let (idle, interval) = (options.idle_timeout, options.ping_interval);
        let silent = now.saturating_duration_since(self.heard);
        if !idle.is_zero() && silent >= idle {
            let reason = format!("nothing was heard for {} s, not even a pong", silent.as_secs());
            return Err(Stop::Close { code: 1001, reason, readable: true });
        }
        if self.ping_at.is_some_and(|at| at <= now) {
            // Behind a blocked message a ping would only pile up.
            if self.socket.queued() < SOCKET_FULL {
                self.ping();
            }
            self.ping_at = Some(now + interval);
        }
        let idle_at = (!idle.is_zero()).then(|| self.heard + idle);
        Ok([self.ping_at, idle_at, self.client.outbox.next_due()].into_iter().flatten().min())
    }

    /// Ready when it is time.
    fn arm(&mut self, cx: &mut Context<'_>, at: Option<Instant>) -> Poll<()> {
        let Some(at) = at else { return Poll::Pending };
        // A deadline that moved away is left to fire early; then it is looked at again.
        if self.timer_at.is_none_or(|armed| at < armed) {
            self.timer.as_mut().reset(at.into());
            self.timer_at = Some(at);
        }
        ready!(self.timer.as_mut().poll(cx));
        self.timer_at = None;
        Poll::Ready(())
    }

    fn step(&mut self, cx: &mut Context<'_>) -> Poll<Stop> {
        if !self.client.outbox.register(self.number, cx.waker()) {
            let reason = "a newer connection has taken this session over".to_owned();
            return Poll::Ready(Stop::Close { code: 4001, reason, readable: true });
        }
        for _ in 0..ROUNDS {
            if let Some(Goodbye { code, reason }) = self.client.outbox.goodbye() {
                return Poll::Ready(Stop::Close { code, reason, readable: true });
            }
            let now = Instant::now();
            let read = match self.read(cx, now) {
                Poll::Ready(Err(stop)) => return Poll::Ready(stop),
                read => read,
            };
            let at = match self.mind_the_clock(now) {
                Ok(at) => at,
                Err(stop) => return Poll::Ready(stop),
            };
            let written = match self.write(cx, now) {
                Poll::Ready(Err(error)) => return Poll::Ready(Stop::Lost(error.to_string())),
                written => written,
            };
            let more = read.is_ready() || (std::mem::take(&mut self.held_back) && written.is_ready());
            if !more && self.arm(cx, at).is_pending() {
                return Poll::Pending;
            }
        }
        cx.waker().wake_by_ref();
        Poll::Pending
    }

    /// Serves the socket until it ends.
    pub(crate) async fn run(mut self) -> SessionEnd {
        let stop = poll_fn(|cx| self.step(cx)).await;
        let patience = self.client.shared.options.close_timeout;
        let end = match stop {
            Stop::Lost(reason) => SessionEnd::Lost(reason),
            Stop::Client { code, reason } => {
                self.socket.queue_close(code, "");
                let answered = poll_fn(|cx| self.socket.poll_flush(cx));
                // A client that does not wait for the answer is gone all the same.
                let _ = timeout(patience, answered).await;
                SessionEnd::Client { code, reason }
            }
            Stop::Close { code, reason, readable } => {
                self.last_words(code, &reason);
                // A client that does not take its leave in time is left alone.
                let _ = timeout(patience, self.socket.leave(readable)).await;
                SessionEnd::Closed { code, reason }
            }
        };
        if self.client.is_resumable() {
            let unacknowledged = std::mem::take(&mut self.unacknowledged);
            self.client.outbox.again(unacknowledged.into_iter().map(|(_, control)| control));
        }
        end
    }

    /// Queues what still waits in the control queue, and a close frame.
    fn last_words(&mut self, code: u16, reason: &str) {
        if matches!(code, 1002 | 1007 | 1009) {
            self.client.status(Level::Error, None, Format::Json, reason);
        }
        // A client that reads nothing need not be told more, one that has another socket hears it there.
        if code != 1008 && code != 4001 {
            while let Some(control) = self.client.outbox.next_control() {
                self.remember(&control);
                self.socket.queue(control.frame.opcode(), control.frame.bytes);
            }
        }
        self.socket.queue_close(code, reason);
    }
}
