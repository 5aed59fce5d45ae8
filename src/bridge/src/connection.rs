//! One socket: moves frames between it and its client, in one task, so that nothing is passed between threads on the
//! way.

mod sending;

use std::future::{Future, poll_fn};
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, ready};
use std::time::Instant;

use budget::Budget;
use bytes::Bytes;
use rosbridge::{Format, StatusLevel};
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::time::{Sleep, timeout};

use crate::SessionEnd;
use crate::acks::Acks;
use crate::client::{BridgeClient, Inbox};
use crate::cut::Fragmenter;
use crate::early_messages::EarlyMessages;
use crate::outbox::{CloseReason, ControlMessage};
use ws::{WebSocket, WsError, WsMessage, frame};

/// Bytes in the socket's queue above which nothing is added, so that at most one large message delays a small one.
const SOCKET_FULL: usize = 64 * 1024;
/// Number of frames read from a client before its answers are sent.
const READ_BATCH: usize = 64;
/// Number of rounds before yielding to other tasks.
const ROUNDS: usize = 16;
/// Bytes moved before yielding to other tasks. The work caused by a large message (a node's connection that writes it)
/// often waits for this very thread; reading the next message first would stall both.
const TURN_BYTES: usize = 128 * 1024;
/// Number of queued answers above which nothing more is read from the client.
const CONTROL_HIGH: usize = 256;

/// The socket, its client and the state in between.
pub(crate) struct BridgeConnection<S> {
    socket: WebSocket<S>,
    client: Arc<BridgeClient>,
    /// Number of this socket among the client's.
    number: u64,
    inbox: Inbox,
    /// Messages received before the servant was ready.
    kept: EarlyMessages,
    cuts: Fragmenter,
    heard: Instant,
    /// Bytes received by then.
    heard_bytes: u64,
    ping_at: Option<Instant>,
    acks: Acks,
    /// Reading was suspended because answers are queued.
    held_back: bool,
    /// Bytes read and written since other tasks had their turn.
    moved: usize,
    timer: Pin<Box<Sleep>>,
    timer_at: Option<Instant>,
}

/// Reason why a connection stops.
enum StopReason {
    /// The client sent a close frame.
    Client { code: u16, reason: String },
    /// It is to be closed; `readable` unless the client's byte stream can no longer be parsed.
    Close { code: u16, reason: String, readable: bool },
    /// The socket is unusable. `heard_all`: the client ended it cleanly, having read everything that was sent.
    Lost { reason: String, heard_all: bool },
}

impl<S: AsyncRead + AsyncWrite + Unpin> BridgeConnection<S> {
    /// Creates a connection on `socket`, which first handles the messages in `kept`.
    pub(crate) fn new(
        socket: WebSocket<S>,
        kept: EarlyMessages,
        client: Arc<BridgeClient>,
        number: u64,
        budget: &Budget,
    ) -> Self {
        let now = Instant::now();
        let options = &client.shared.options;
        Self {
            socket,
            number,
            inbox: Inbox::new(&client.shared, budget),
            kept,
            cuts: Fragmenter::default(),
            heard: now,
            heard_bytes: 0,
            ping_at: (!options.ping_interval.is_zero()).then(|| now + options.ping_interval),
            acks: Acks::new(&client.budget),
            held_back: false,
            moved: 0,
            timer: Box::pin(tokio::time::sleep_until(now.into())),
            timer_at: None,
            client,
        }
    }

    /// Keeps an answer until the client is known to have it.
    fn retain_answer(&mut self, control: &ControlMessage, now: Instant) {
        if control.answer && self.client.is_resumable() {
            self.acks.record_sent(control.clone(), now);
        }
    }

    fn ping(&mut self) {
        let payload = self.acks.next_ping();
        self.socket.queue(frame::PING, Bytes::copy_from_slice(&payload));
    }

    /// Reads frames from the client. Ready when a batch was handled, pending when none is available.
    fn read(&mut self, cx: &mut Context<'_>, now: Instant) -> Poll<Result<(), StopReason>> {
        for _ in 0..READ_BATCH {
            if self.moved >= TURN_BYTES {
                break;
            }
            // A client that does not read our answers has nothing more to say.
            if self.client.outbox.control_len() >= CONTROL_HIGH {
                self.held_back = true;
                return Poll::Pending;
            }
            let next = match self.kept.pop() {
                Some(message) => Poll::Ready(Ok(message)),
                None => self.socket.poll_next(cx),
            };
            // A large message on a slow line counts as activity from its first byte on.
            if self.heard_bytes != self.socket.bytes_received() {
                self.heard_bytes = self.socket.bytes_received();
                self.heard = now;
            }
            let message = match ready!(next) {
                Ok(message) => message,
                Err(WsError::Refused { code, reason }) => {
                    return Poll::Ready(Err(StopReason::Close { code, reason, readable: false }));
                }
                Err(error) => {
                    let heard_all = matches!(error, WsError::Eof);
                    return Poll::Ready(Err(StopReason::Lost { reason: error.to_string(), heard_all }));
                }
            };
            self.handle_message(message)?;
        }
        Poll::Ready(Ok(()))
    }

    fn handle_message(&mut self, message: WsMessage) -> Result<(), StopReason> {
        let metrics = &self.client.shared.metrics;
        match message {
            WsMessage::Text(bytes) => {
                metrics.frames_in.add(1);
                metrics.bytes_in.add(bytes.len() as u64);
                self.moved += bytes.len();
                match std::str::from_utf8(&bytes) {
                    Ok(text) => self.client.on_text(&mut self.inbox, text),
                    Err(_) => {
                        let reason = "a text frame is not UTF-8".to_owned();
                        return Err(StopReason::Close { code: 1007, reason, readable: true });
                    }
                }
            }
            WsMessage::Binary(bytes) => {
                metrics.frames_in.add(1);
                metrics.bytes_in.add(bytes.len() as u64);
                self.moved += bytes.len();
                self.client.on_binary(&mut self.inbox, &bytes);
            }
            // Limits the pongs queued for a client that does not read.
            WsMessage::Ping(payload) if self.socket.bytes_queued() < SOCKET_FULL => {
                self.socket.queue(frame::PONG, payload)
            }
            WsMessage::Ping(_) => {}
            WsMessage::Pong(payload) => self.acks.on_pong(&payload),
            WsMessage::Close(code, reason) => return Err(StopReason::Client { code, reason }),
        }
        self.inbox.count().map_err(|full| StopReason::Close {
            code: 1013,
            reason: format!("fragments cannot be kept: {full}"),
            readable: true,
        })
    }

    /// Handles timeouts: sends pings, and closes idle connections.
    fn check_timers(&mut self, now: Instant) -> Result<(), StopReason> {
        let options = &self.client.shared.options;
        let (idle, interval) = (options.idle_timeout, options.ping_interval);
        let silent = now.saturating_duration_since(self.heard);
        if !idle.is_zero() && silent >= idle {
            let reason = format!("nothing was received for {} s, not even a pong", silent.as_secs());
            return Err(StopReason::Close { code: 1001, reason, readable: true });
        }
        let regular = self.ping_at.is_some_and(|at| at <= now);
        // Behind a blocked message pings would only pile up.
        if self.socket.bytes_queued() < SOCKET_FULL && (regular || self.acks.ping_due().is_some_and(|at| at <= now)) {
            self.ping();
        }
        if regular {
            self.ping_at = Some(now + interval);
        }
        Ok(())
    }

    /// Returns the time of the next timeout. Must be called after writing: what was written may need a ping after it,
    /// and its topic's next message may have to wait for its throttle rate.
    fn next_deadline(&self) -> Option<Instant> {
        let idle = self.client.shared.options.idle_timeout;
        let idle_at = (!idle.is_zero()).then(|| self.heard + idle);
        // While the socket is blocked there is nothing to send in time; it wakes this task itself.
        let blocked = self.socket.bytes_queued() >= SOCKET_FULL;
        let ack_at = self.acks.ping_due().filter(|_| !blocked);
        let sample_at = self.client.outbox.next_due().filter(|_| !blocked);
        [self.ping_at, idle_at, ack_at, sample_at].into_iter().flatten().min()
    }

    /// Ready when the time has come.
    fn poll_timer(&mut self, cx: &mut Context<'_>, at: Option<Instant>) -> Poll<()> {
        let Some(at) = at else { return Poll::Pending };
        // If the deadline has moved later, the timer fires early and is set again.
        if self.timer_at.is_none_or(|armed| at < armed) {
            self.timer.as_mut().reset(at.into());
            self.timer_at = Some(at);
        }
        ready!(self.timer.as_mut().poll(cx));
        self.timer_at = None;
        Poll::Ready(())
    }

    fn step(&mut self, cx: &mut Context<'_>) -> Poll<StopReason> {
        if !self.client.outbox.register(self.number, cx.waker()) {
            let reason = "a newer connection has taken this session over".to_owned();
            return Poll::Ready(StopReason::Close { code: 4001, reason, readable: true });
        }
        self.moved = 0;
        for _ in 0..ROUNDS {
            if let Some(CloseReason { code, reason }) = self.client.outbox.close_reason() {
                return Poll::Ready(StopReason::Close { code, reason, readable: true });
            }
            let now = Instant::now();
            let read = match self.read(cx, now) {
                Poll::Ready(Err(stop)) => return Poll::Ready(stop),
                read => read,
            };
            if let Err(stop) = self.check_timers(now) {
                return Poll::Ready(stop);
            }
            let written = match self.write(cx, now) {
                Poll::Ready(Err(stop)) => return Poll::Ready(stop),
                written => written,
            };
            let more = read.is_ready() || (std::mem::take(&mut self.held_back) && written.is_ready());
            if self.moved >= TURN_BYTES {
                break;
            }
            if !more && self.poll_timer(cx, self.next_deadline()).is_pending() {
                return Poll::Pending;
            }
        }
        cx.waker().wake_by_ref();
        Poll::Pending
    }

    /// Serves the socket until it stops; revokes what is no longer granted whenever the grants change.
    async fn serve(&mut self) -> StopReason {
        let mut granted = self.client.client_grants();
        loop {
            if let Some(reason) = granted.end_reason() {
                return StopReason::Close { code: 1008, reason, readable: true };
            }
            self.client.revoke_ungranted();
            tokio::select! {
                biased;
                () = granted.wait_changed() => {}
                stop = poll_fn(|cx| self.step(cx)) => return stop,
            }
        }
    }

    /// Serves the socket until it ends.
    pub(crate) async fn run(mut self) -> SessionEnd {
        let stop = self.serve().await;
        let patience = self.client.shared.options.close_timeout;
        // Data still in our own buffer has certainly not arrived.
        let arrived = self.socket.bytes_queued() == 0;
        let (end, heard_all) = match stop {
            StopReason::Lost { reason, heard_all } => (SessionEnd::Lost(reason), heard_all && arrived),
            StopReason::Client { code, reason } => {
                self.socket.queue_close(code, "");
                let answered = poll_fn(|cx| self.socket.poll_flush(cx));
                // A client that does not wait for the answer is gone all the same.
                let _ = timeout(patience, answered).await;
                (SessionEnd::Client { code, reason }, arrived)
            }
            StopReason::Close { code, reason, readable } => {
                self.queue_remaining_control(code, &reason);
                // A client that does not complete the close handshake in time is dropped.
                let left = timeout(patience, self.socket.shutdown(readable)).await;
                (SessionEnd::Closed { code, reason }, matches!(left, Ok(Ok(()))))
            }
        };
        if !heard_all {
            self.client.outbox.requeue(self.acks.take_unacked());
        }
        end
    }

    /// Queues the rest of the control queue, and a close frame.
    fn queue_remaining_control(&mut self, code: u16, reason: &str) {
        if matches!(code, 1002 | 1007 | 1009 | 1013) {
            self.client.send_status(StatusLevel::Error, None, Format::Json, reason);
        }
        // A client that reads nothing need not be told more; one that has another socket is told there.
        if code != 1008 && code != 4001 {
            while let Some(control) = self.client.outbox.next_control() {
                self.retain_answer(&control, Instant::now());
                self.socket.queue(control.frame.opcode(), control.frame.bytes);
            }
        }
        self.socket.queue_close(code, reason);
    }
}

#[cfg(test)]
#[path = "connection_tests.rs"]
mod tests;
