//! Reads a connection while its servant starts. Pings and close frames are answered at once; other messages are kept, up to
//! a limit, and handled in order when the servant is ready.

use std::future::{Future, poll_fn};
use std::pin::{Pin, pin};
use std::task::{Context, Poll};
use std::time::{Duration, Instant};

use budget::Budget;
use bytes::Bytes;
use rosbridge::{Format, Level, Op, Status};
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::sync::mpsc;
use tokio::time::{Sleep, timeout};
use ws::{Message, WebSocket, WsError, frame};

use crate::kept::{Kept, Taken};
use crate::{BridgeOptions, SessionEnd};

/// Messages taken before other tasks have their turn.
const READ_BATCH: usize = 64;
/// Bytes of answers to pings that may wait to be sent.
const ANSWERS: usize = 64 * 1024;

/// A connection behind its WebSocket upgrade, before a bridge serves it.
pub struct Waiting<S> {
    socket: WebSocket<S>,
    kept: Kept,
    unfinished: Duration,
    ping_interval: Duration,
    idle_timeout: Duration,
    close_timeout: Duration,
    heard: Instant,
    heard_bytes: u64,
    /// Fires at the next ping, or when the silence has become too long.
    timer: Pin<Box<Sleep>>,
    ping_at: Option<Instant>,
}

/// Why waiting has ended.
enum Left {
    Client { code: u16, reason: String },
    Refused { code: u16, reason: String },
    Silent(Duration),
    Lost(String),
}

impl<S: AsyncRead + AsyncWrite + Unpin> Waiting<S> {
    /// A connection that waits; `read_ahead` is what was already read behind its upgrade.
    pub fn new(io: S, read_ahead: &[u8], options: &BridgeOptions) -> Self {
        let now = Instant::now();
        let interval = options.ping_interval;
        Self {
            socket: WebSocket::new(io, read_ahead, options.max_frame, options.max_message),
            kept: Kept::within(&Budget::unlimited()),
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
    pub fn within(mut self, budget: &Budget) -> Self {
        self.socket = self.socket.within(budget, self.unfinished);
        self.kept = Kept::within(budget);
        self
    }

    /// Serves the connection until `ready` completes, and returns its output.
    ///
    /// # Errors
    /// The client left before; says how. `ready` has been dropped by then.
    pub async fn until<T>(&mut self, ready: impl Future<Output = T>) -> Result<T, SessionEnd> {
        self.until_told(ready, mpsc::channel(1).1).await
    }

    /// The same; what comes from `news` meanwhile is told by status messages at level warning.
    ///
    /// # Errors
    /// As of [`Waiting::until`].
    pub async fn until_told<T>(
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
                while self.socket.queued() < ANSWERS
                    && let Poll::Ready(Some(words)) = news.poll_recv(cx)
                {
                    self.report(Level::Warning, &words);
                }
                self.step(cx).map(Err)
            });
            match either.await {
                Ok(value) => return Ok(value),
                Err(left) => left,
            }
        };
        Err(self.leave(left).await)
    }

    /// Refuses the connection: a status message at level error, then a close frame.
    pub async fn refuse(mut self, code: u16, reason: &str) {
        self.say_goodbye(code, reason, true).await;
    }

    pub(crate) fn into_parts(self) -> (WebSocket<S>, Kept) {
        (self.socket, self.kept)
    }

    async fn leave(&mut self, left: Left) -> SessionEnd {
        match left {
            Left::Lost(reason) => SessionEnd::Lost(reason),
            Left::Client { code, reason } => {
                self.socket.queue_close(code, "");
                let answered = poll_fn(|cx| self.socket.poll_flush(cx));
                // A client that does not wait for the answer is gone all the same.
                let _ = timeout(self.close_timeout, answered).await;
                SessionEnd::Client { code, reason }
            }
            Left::Refused { code, reason } => {
                self.say_goodbye(code, &reason, false).await;
                SessionEnd::Closed { code, reason }
            }
            Left::Silent(silence) => {
                let reason = format!(
                    "nothing was heard for {} s, not even a pong",
                    silence.as_secs()
                );
                self.say_goodbye(1001, &reason, true).await;
                SessionEnd::Closed { code: 1001, reason }
            }
        }
    }

    fn report(&mut self, level: Level, text: &str) {
        let mut out = Vec::new();
        let status = Status {
            id: None,
            level,
            msg: text.into(),
        };
        Op::from(status).print(&mut out, Format::Json);
        self.socket.queue(frame::TEXT, Bytes::from(out));
    }

    async fn say_goodbye(&mut self, code: u16, reason: &str, readable: bool) {
        self.report(Level::Error, reason);
        self.socket.queue_close(code, reason);
        // A client that does not take its leave in time, or is gone already, is left alone.
        let _ = timeout(self.close_timeout, self.socket.leave(readable)).await;
    }

    fn step(&mut self, cx: &mut Context<'_>) -> Poll<Left> {
        loop {
            let read = match self.read(cx) {
                Poll::Ready(Err(left)) => return Poll::Ready(left),
                read => read,
            };
            let now = Instant::now();
            if let Err(left) = self.mind_the_clock(now) {
                return Poll::Ready(left);
            }
            if let Poll::Ready(Err(error)) = self.socket.poll_flush(cx) {
                return Poll::Ready(Left::Lost(error.to_string()));
            }
            if read.is_ready() {
                cx.waker().wake_by_ref();
                return Poll::Pending;
            }
            let silent_at = self.silent_at();
            let Some(at) = self.ping_at.into_iter().chain(silent_at).min() else {
                return Poll::Pending;
            };
            self.timer.as_mut().reset(at.into());
            if self.timer.as_mut().poll(cx).is_pending() {
                return Poll::Pending;
            }
        }
    }

    /// When the connection counts as silent.
    fn silent_at(&self) -> Option<Instant> {
        let counts = !self.idle_timeout.is_zero();
        counts.then(|| self.heard + self.idle_timeout)
    }

    fn mind_the_clock(&mut self, now: Instant) -> Result<(), Left> {
        if self.silent_at().is_some_and(|at| at <= now) {
            return Err(Left::Silent(now.saturating_duration_since(self.heard)));
        }
        if self.ping_at.is_some_and(|at| at <= now) {
            if self.socket.queued() < ANSWERS {
                self.socket.queue(frame::PING, Bytes::new());
            }
            self.ping_at = Some(now + self.ping_interval);
        }
        Ok(())
    }

    /// Takes what the client has sent. Pending when there is no more; ready without an error when other tasks are to have
    /// their turn.
    fn read(&mut self, cx: &mut Context<'_>) -> Poll<Result<(), Left>> {
        for _ in 0..READ_BATCH {
            let next = self.socket.poll_next(cx);
            if self.heard_bytes != self.socket.received() {
                self.heard_bytes = self.socket.received();
                self.heard = Instant::now();
            }
            let message = match next {
                Poll::Pending => return Poll::Pending,
                Poll::Ready(Ok(message)) => message,
                Poll::Ready(Err(WsError::Refused { code, reason })) => {
                    return Poll::Ready(Err(Left::Refused { code, reason }));
                }
                Poll::Ready(Err(error)) => {
                    return Poll::Ready(Err(Left::Lost(error.to_string())));
                }
            };
            match message {
                Message::Text(_) | Message::Binary(_) => match self.kept.take(message) {
                    Taken::Kept | Taken::LeftOut { first: false } => {}
                    Taken::LeftOut { first: true } => self.report(
                        Level::Error,
                        "publish: too much waits for the servant to start; further messages are left out until it has",
                    ),
                    Taken::Refused(reason) => {
                        return Poll::Ready(Err(Left::Refused { code: 1013, reason }));
                    }
                },
                Message::Ping(payload) if self.socket.queued() < ANSWERS => {
                    self.socket.queue(frame::PONG, payload);
                }
                Message::Ping(_) | Message::Pong(_) => {}
                Message::Close(code, reason) => {
                    return Poll::Ready(Err(Left::Client { code, reason }));
                }
            }
        }
        Poll::Ready(Ok(()))
    }
}
