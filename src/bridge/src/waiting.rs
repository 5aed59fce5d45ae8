//! Reads a connection while its servant starts. Pings and close frames are answered at once; other messages are kept,
//! up to a limit, and handled in order when the servant is ready.

use std::future::{Future, poll_fn};
use std::pin::{Pin, pin};
use std::task::{Context, Poll};
use std::time::{Duration, Instant};

use budget::Budget;
use bytes::Bytes;
use rosbridge::{Format, Op, Status, StatusLevel};
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::sync::mpsc;
use tokio::time::{Sleep, timeout};
use ws::{WebSocket, WsError, WsMessage, frame};

use crate::early_messages::{EarlyMessageOutcome, EarlyMessages};
use crate::{BridgeOptions, SessionEnd};

/// Number of messages read before yielding to other tasks.
const READ_BATCH: usize = 64;
/// Maximum bytes of queued answers to pings.
const ANSWERS: usize = 64 * 1024;

/// A connection after its WebSocket upgrade, before a bridge serves it.
pub struct WaitingConnection<S> {
    socket: WebSocket<S>,
    kept: EarlyMessages,
    unfinished: Duration,
    ping_interval: Duration,
    idle_timeout: Duration,
    close_timeout: Duration,
    heard: Instant,
    heard_bytes: u64,
    /// Fires at the next ping, or when the connection has been silent for too long.
    timer: Pin<Box<Sleep>>,
    ping_at: Option<Instant>,
}

/// Reason why waiting has ended.
enum WaitEnd {
    Client { code: u16, reason: String },
    Refused { code: u16, reason: String },
    Silent(Duration),
    Lost(String),
}

impl<S: AsyncRead + AsyncWrite + Unpin> WaitingConnection<S> {
    /// Creates a waiting connection; `read_ahead` contains the bytes already read after its upgrade.
    pub fn new(io: S, read_ahead: &[u8], options: &BridgeOptions) -> Self {
        let now = Instant::now();
        let interval = options.ping_interval;
        Self {
            socket: WebSocket::new(io, read_ahead, options.max_frame, options.max_message),
            kept: EarlyMessages::with_budget(&Budget::without_limit()),
            unfinished: options.unfinished,
            ping_interval: interval,
            idle_timeout: options.idle_timeout,
            close_timeout: options.close_timeout,
            heard: now,
            heard_bytes: 0,
            timer: Box::pin(tokio::time::sleep_until(now.into())),
            ping_at: (!interval.is_zero()).then(|| now + interval),
        }
    }

    /// Counts the client's messages in `budget`, now and in the session.
    pub fn with_budget(mut self, budget: &Budget) -> Self {
        self.socket = self.socket.with_budget(budget, self.unfinished);
        self.kept = EarlyMessages::with_budget(budget);
        self
    }

    /// Serves the connection until `ready` completes, and returns its output.
    ///
    /// # Errors
    /// Fails if the client left before; returns the end of the session. `ready` has been dropped by then.
    pub async fn wait_for<T>(&mut self, ready: impl Future<Output = T>) -> Result<T, SessionEnd> {
        self.wait_for_with_news(ready, mpsc::channel(1).1).await
    }

    /// Waits like [`WaitingConnection::wait_for`], and sends the texts received from `news` meanwhile as status
    /// messages at level warning.
    ///
    /// # Errors
    /// The same as those of [`WaitingConnection::wait_for`].
    pub async fn wait_for_with_news<T>(
        &mut self,
        ready: impl Future<Output = T>,
        mut news: mpsc::Receiver<String>,
    ) -> Result<T, SessionEnd> {
        let left = {
            let mut ready = pin!(ready);
            let either = poll_fn(|cx| {
                if let Poll::Ready(value) = ready.as_mut().poll(cx) {
                    return Poll::Ready(Ok(value));
                }
                while self.socket.bytes_queued() < ANSWERS
                    && let Poll::Ready(Some(words)) = news.poll_recv(cx)
                {
                    self.send_status(StatusLevel::Warning, &words);
                }
                self.step(cx).map(Err)
            });
            match either.await {
                Ok(value) => return Ok(value),
                Err(left) => left,
            }
        };
        Err(self.close(left).await)
    }

    /// Refuses the connection: a status message at level error, then a close frame.
    pub async fn refuse(mut self, code: u16, reason: &str) {
        self.close_with_reason(code, reason, true).await;
    }

    pub(crate) fn into_parts(self) -> (WebSocket<S>, EarlyMessages) {
        (self.socket, self.kept)
    }

    async fn close(&mut self, left: WaitEnd) -> SessionEnd {
        match left {
            WaitEnd::Lost(reason) => SessionEnd::Lost(reason),
            WaitEnd::Client { code, reason } => {
                self.socket.queue_close(code, "");
                let answered = poll_fn(|cx| self.socket.poll_flush(cx));
                // A client that does not wait for the answer is gone all the same.
                let _ = timeout(self.close_timeout, answered).await;
                SessionEnd::Client { code, reason }
            }
            WaitEnd::Refused { code, reason } => {
                self.close_with_reason(code, &reason, false).await;
                SessionEnd::Closed { code, reason }
            }
            WaitEnd::Silent(silence) => {
                let reason = format!("nothing was received for {} s, not even a pong", silence.as_secs());
                self.close_with_reason(1001, &reason, true).await;
                SessionEnd::Closed { code: 1001, reason }
            }
        }
    }

    fn send_status(&mut self, level: StatusLevel, text: &str) {
        let mut out = Vec::new();
        let status = Status { id: None, level, msg: text.into() };
        Op::from(status).print(&mut out, Format::Json);
        self.socket.queue(frame::TEXT, Bytes::from(out));
    }

    async fn close_with_reason(&mut self, code: u16, reason: &str, readable: bool) {
        self.send_status(StatusLevel::Error, reason);
        self.socket.queue_close(code, reason);
        // A client that does not complete the close handshake in time, or is gone already, is dropped.
        let _ = timeout(self.close_timeout, self.socket.shutdown(readable)).await;
    }

    fn step(&mut self, cx: &mut Context<'_>) -> Poll<WaitEnd> {
        loop {
            let read = match self.read(cx) {
                Poll::Ready(Err(left)) => return Poll::Ready(left),
                read => read,
            };
            let now = Instant::now();
            if let Err(left) = self.check_timers(now) {
                return Poll::Ready(left);
            }
            if let Poll::Ready(Err(error)) = self.socket.poll_flush(cx) {
                return Poll::Ready(WaitEnd::Lost(error.to_string()));
            }
            if read.is_ready() {
                cx.waker().wake_by_ref();
                return Poll::Pending;
            }
            let silent_at = self.idle_deadline();
            let Some(at) = self.ping_at.into_iter().chain(silent_at).min() else {
                return Poll::Pending;
            };
            self.timer.as_mut().reset(at.into());
            if self.timer.as_mut().poll(cx).is_pending() {
                return Poll::Pending;
            }
        }
    }

    /// Returns when the connection counts as silent.
    fn idle_deadline(&self) -> Option<Instant> {
        let counts = !self.idle_timeout.is_zero();
        counts.then(|| self.heard + self.idle_timeout)
    }

    fn check_timers(&mut self, now: Instant) -> Result<(), WaitEnd> {
        if self.idle_deadline().is_some_and(|at| at <= now) {
            return Err(WaitEnd::Silent(now.saturating_duration_since(self.heard)));
        }
        if self.ping_at.is_some_and(|at| at <= now) {
            if self.socket.bytes_queued() < ANSWERS {
                self.socket.queue(frame::PING, Bytes::new());
            }
            self.ping_at = Some(now + self.ping_interval);
        }
        Ok(())
    }

    /// Reads what the client has sent. Pending when there is no more; ready without an error when other tasks are to
    /// have their turn.
    fn read(&mut self, cx: &mut Context<'_>) -> Poll<Result<(), WaitEnd>> {
        for _ in 0..READ_BATCH {
            let next = self.socket.poll_next(cx);
            if self.heard_bytes != self.socket.bytes_received() {
                self.heard_bytes = self.socket.bytes_received();
                self.heard = Instant::now();
            }
            let message = match next {
                Poll::Pending => return Poll::Pending,
                Poll::Ready(Ok(message)) => message,
                Poll::Ready(Err(WsError::Refused { code, reason })) => {
                    return Poll::Ready(Err(WaitEnd::Refused { code, reason }));
                }
                Poll::Ready(Err(error)) => {
                    return Poll::Ready(Err(WaitEnd::Lost(error.to_string())));
                }
            };
            match message {
                WsMessage::Text(_) | WsMessage::Binary(_) => match self.kept.push(message) {
                    EarlyMessageOutcome::Kept | EarlyMessageOutcome::LeftOut { first: false } => {}
                    EarlyMessageOutcome::LeftOut { first: true } => self.send_status(
                        StatusLevel::Error,
                        "publish: too many messages wait for the servant to start; further ones are dropped until then",
                    ),
                    EarlyMessageOutcome::Refused(reason) => {
                        return Poll::Ready(Err(WaitEnd::Refused { code: 1013, reason }));
                    }
                },
                WsMessage::Ping(payload) if self.socket.bytes_queued() < ANSWERS => {
                    self.socket.queue(frame::PONG, payload);
                }
                WsMessage::Ping(_) | WsMessage::Pong(_) => {}
                WsMessage::Close(code, reason) => {
                    return Poll::Ready(Err(WaitEnd::Client { code, reason }));
                }
            }
        }
        Poll::Ready(Ok(()))
    }
}
