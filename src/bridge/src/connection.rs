//! One socket: moves frames between it and its client, in one task, so that nothing is handed over between threads
//! on the way.

mod sending;

use std::future::{Future, poll_fn};
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, ready};
use std::time::Instant;

use budget::Budget;
use bytes::Bytes;
use rosbridge::{Format, Level};
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::time::{Sleep, timeout};

use crate::SessionEnd;
use crate::acks::Acks;
use crate::client::{Client, Inbox};
use crate::cut::Cuts;
use crate::kept::Kept;
use crate::outbox::{Control, Goodbye};
use ws::{Message, WebSocket, WsError, frame};

/// Bytes in the socket's queue beyond which nothing is added: so at most one big message stands before a small one.
const SOCKET_FULL: usize = 64 * 1024;
/// Frames taken from a client before its answers are sent.
const READ_BATCH: usize = 64;
/// Rounds before other tasks have their turn.
const ROUNDS: usize = 16;
/// Bytes moved before other tasks have their turn. What a big message sets off (a node's connection that writes it)
/// often waits for this very thread; to read the next one first would stall both.
const MOVED: usize = 128 * 1024;
/// While so many answers wait nothing more is read from the client.
const CONTROL_HIGH: usize = 256;

/// The socket, its client and what lies between.
pub(crate) struct Connection<S> {
    socket: WebSocket<S>,
    client: Arc<Client>,
    /// Which of the client's sockets this is.
    number: u64,
    inbox: Inbox,
    /// What came before there was a servant to take it.
    kept: Kept,
    cuts: Cuts,
    heard: Instant,
    /// Bytes received by then.
    heard_bytes: u64,
    ping_at: Option<Instant>,
    acks: Acks,
    /// Reading was put off because answers wait.
    held_back: bool,
    /// Bytes read and written since other tasks had their turn.
    moved: usize,
    timer: Pin<Box<Sleep>>,
    timer_at: Option<Instant>,
}

/// Why a connection stops.
enum Stop {
    /// The client sent a close frame.
    Client { code: u16, reason: String },
    /// It is to be closed; `readable` unless the client's bytes can no longer be told apart.
    Close {
        code: u16,
        reason: String,
        readable: bool,
    },
    /// The socket is of no more use. `heard_all`: the client ended it in good order, having read what was sent.
    Lost { reason: String, heard_all: bool },
}

impl<S: AsyncRead + AsyncWrite + Unpin> Connection<S> {
    /// A connection on `socket`, which takes what was `kept` of it first.
    pub(crate) fn new(
        socket: WebSocket<S>,
        kept: Kept,
        client: Arc<Client>,
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
            cuts: Cuts::default(),
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
    fn remember(&mut self, control: &Control, now: Instant) {
        if control.answer && self.client.is_resumable() {
            self.acks.sent(control.clone(), now);
        }
    }

    fn ping(&mut self) {
        let payload = self.acks.ping();
        self.socket
            .queue(frame::PING, Bytes::copy_from_slice(&payload));
    }

    /// Takes frames from the client. Ready when a batch was taken, pending when none is there.
    fn read(&mut self, cx: &mut Context<'_>, now: Instant) -> Poll<Result<(), Stop>> {
        for _ in 0..READ_BATCH {
            if self.moved >= MOVED {
                break;
            }
            // Who does not read what we answer has nothing more to say.
            if self.client.outbox.control_waiting() >= CONTROL_HIGH {
                self.held_back = true;
                return Poll::Pending;
            }
            let next = match self.kept.pop() {
                Some(message) => Poll::Ready(Ok(message)),
                None => self.socket.poll_next(cx),
            };
            // A big message on a slow line is heard from its first byte on, not only at its end.
            if self.heard_bytes != self.socket.received() {
                self.heard_bytes = self.socket.received();
                self.heard = now;
            }
            let message = match ready!(next) {
                Ok(message) => message,
                Err(WsError::Refused { code, reason }) => {
                    return Poll::Ready(Err(Stop::Close {
                        code,
                        reason,
                        readable: false,
                    }));
                }
                Err(error) => {
                    let heard_all = matches!(error, WsError::Eof);
                    return Poll::Ready(Err(Stop::Lost {
                        reason: error.to_string(),
                        heard_all,
                    }));
                }
            };
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
                self.moved += bytes.len();
                match std::str::from_utf8(&bytes) {
                    Ok(text) => self.client.text(&mut self.inbox, text),
                    Err(_) => {
                        let reason = "a text frame is not UTF-8".to_owned();
                        return Err(Stop::Close {
                            code: 1007,
                            reason,
                            readable: true,
                        });
                    }
                }
            }
            Message::Binary(bytes) => {
                metrics.frames_in.add(1);
                metrics.bytes_in.add(bytes.len() as u64);
                self.moved += bytes.len();
                self.client.binary(&mut self.inbox, &bytes);
            }
            // Pongs that a client does not read pile up no higher than this.
            Message::Ping(payload) if self.socket.queued() < SOCKET_FULL => {
                self.socket.queue(frame::PONG, payload)
            }
            Message::Ping(_) => {}
            Message::Pong(payload) => self.acks.pong(&payload),
            Message::Close(code, reason) => return Err(Stop::Client { code, reason }),
        }
        self.inbox.count().map_err(|full| Stop::Close {
            code: 1013,
            reason: format!("fragments cannot be kept: {full}"),
            readable: true,
        })
    }

    /// What the clock demands: a ping, a goodbye.
    fn mind_the_clock(&mut self, now: Instant) -> Result<(), Stop> {
        let options = &self.client.shared.options;
        let (idle, interval) = (options.idle_timeout, options.ping_interval);
        let silent = now.saturating_duration_since(self.heard);
        if !idle.is_zero() && silent >= idle {
            let reason = format!(
                "nothing was heard for {} s, not even a pong",
                silent.as_secs()
            );
            return Err(Stop::Close {
                code: 1001,
                reason,
                readable: true,
            });
        }
        let regular = self.ping_at.is_some_and(|at| at <= now);
        // Behind a blocked message a ping would only pile up.
        if self.socket.queued() < SOCKET_FULL
            && (regular || self.acks.ping_due().is_some_and(|at| at <= now))
        {
            self.ping();
        }
        if regular {
            self.ping_at = Some(now + interval);
        }
        Ok(())
    }

    /// When to look at the clock again. To be asked after writing: what was written may need a ping behind it, and its
    /// topic's next message may have to wait for its throttle rate.
    fn next_look(&self) -> Option<Instant> {
        let idle = self.client.shared.options.idle_timeout;
        let idle_at = (!idle.is_zero()).then(|| self.heard + idle);
        // While the socket takes no more there is nothing to send in time; it wakes this task itself.
        let blocked = self.socket.queued() >= SOCKET_FULL;
        let ack_at = self.acks.ping_due().filter(|_| !blocked);
        let sample_at = self.client.outbox.next_due().filter(|_| !blocked);
        [self.ping_at, idle_at, ack_at, sample_at]
            .into_iter()
            .flatten()
            .min()
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
            return Poll::Ready(Stop::Close {
                code: 4001,
                reason,
                readable: true,
            });
        }
        self.moved = 0;
        for _ in 0..ROUNDS {
            if let Some(Goodbye { code, reason }) = self.client.outbox.goodbye() {
                return Poll::Ready(Stop::Close {
                    code,
                    reason,
                    readable: true,
                });
            }
            let now = Instant::now();
            let read = match self.read(cx, now) {
                Poll::Ready(Err(stop)) => return Poll::Ready(stop),
                read => read,
            };
            if let Err(stop) = self.mind_the_clock(now) {
                return Poll::Ready(stop);
            }
            let written = match self.write(cx, now) {
                Poll::Ready(Err(stop)) => return Poll::Ready(stop),
                written => written,
            };
            let more =
                read.is_ready() || (std::mem::take(&mut self.held_back) && written.is_ready());
            if self.moved >= MOVED {
                break;
            }
            if !more && self.arm(cx, self.next_look()).is_pending() {
                return Poll::Pending;
            }
        }
        cx.waker().wake_by_ref();
        Poll::Pending
    }

    /// Serves the socket until it is to be left; takes back what is not granted any more whenever that changes.
    async fn serve(&mut self) -> Stop {
        let mut granted = self.client.granted();
        loop {
            if let Some(reason) = granted.ended() {
                return Stop::Close {
                    code: 1008,
                    reason,
                    readable: true,
                };
            }
            self.client.withdraw();
            tokio::select! {
                biased;
                () = granted.changed() => {}
                stop = poll_fn(|cx| self.step(cx)) => return stop,
            }
        }
    }

    /// Serves the socket until it ends.
    pub(crate) async fn run(mut self) -> SessionEnd {
        let stop = self.serve().await;
        let patience = self.client.shared.options.close_timeout;
        // What is still in our own buffer has certainly not arrived.
        let arrived = self.socket.queued() == 0;
        let (end, heard_all) = match stop {
            Stop::Lost { reason, heard_all } => (SessionEnd::Lost(reason), heard_all && arrived),
            Stop::Client { code, reason } => {
                self.socket.queue_close(code, "");
                let answered = poll_fn(|cx| self.socket.poll_flush(cx));
                // A client that does not wait for the answer is gone all the same.
                let _ = timeout(patience, answered).await;
                (SessionEnd::Client { code, reason }, arrived)
            }
            Stop::Close {
                code,
                reason,
                readable,
            } => {
                self.last_words(code, &reason);
                // A client that does not take its leave in time is left alone.
                let left = timeout(patience, self.socket.leave(readable)).await;
                (
                    SessionEnd::Closed { code, reason },
                    matches!(left, Ok(Ok(()))),
                )
            }
        };
        if !heard_all {
            self.client.outbox.again(self.acks.take());
        }
        end
    }

    /// Queues what still waits in the control queue, and a close frame.
    fn last_words(&mut self, code: u16, reason: &str) {
        if matches!(code, 1002 | 1007 | 1009 | 1013) {
            self.client.status(Level::Error, None, Format::Json, reason);
        }
        // A client that reads nothing need not be told more, one that has another socket hears it there.
        if code != 1008 && code != 4001 {
            while let Some(control) = self.client.outbox.next_control() {
                self.remember(&control, Instant::now());
                self.socket
                    .queue(control.frame.opcode(), control.frame.bytes);
            }
        }
        self.socket.queue_close(code, reason);
    }
}

#[cfg(test)]
#[path = "connection_tests.rs"]
mod tests;
