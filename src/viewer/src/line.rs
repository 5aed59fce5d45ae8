//! The WebSocket to one viewer: read while it is written to, pinged, and given up when nothing comes or nothing goes any more.

use std::future::poll_fn;
use std::pin::Pin;
use std::task::{Context, Poll};
use std::time::Duration;

use bytes::Bytes;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::time::{Instant, Sleep, timeout};
use ws::{Message, WebSocket, WsError, frame};

/// What is sent to a viewer. Both are payloads of one frame.
pub enum Frame {
    /// JSON.
    Text(Bytes),
    /// A message, or an answer.
    Binary(Bytes),
}

/// What came of reading.
pub enum Read {
    /// A message of the viewer's: whether it is text, and its bytes.
    Message(bool, Bytes),
    /// The viewer has said goodbye.
    Left,
    /// The connection is gone.
    Lost,
    /// It has to be closed, with this code (RFC 6455) and reason; whether its bytes can still be told apart.
    Refused(u16, String, bool),
}

/// Between two pings.
const PING: Duration = Duration::from_secs(30);
/// A viewer of which nothing was heard for so long, not even a pong, is gone; so is one that takes nothing for so long.
const SILENT: Duration = Duration::from_secs(90);
/// Bytes that wait for the viewer; while there are more, it is given nothing.
const AHEAD: usize = 1 << 20;
/// For the last frames.
const GOODBYE: Duration = Duration::from_secs(2);

/// One connection.
pub struct Line<S> {
    socket: WebSocket<S>,
    received: u64,
    heard: Instant,
    pinged: Instant,
    queued: usize,
    /// Bytes of what it caused itself, since nothing waited for it.
    answers: usize,
    /// When the socket last took something, or nothing had to be taken.
    took: Instant,
    timer: Pin<Box<Sleep>>,
}

impl<S: AsyncRead + AsyncWrite + Unpin> Line<S> {
    /// Of a connection behind its upgrade.
    pub fn new(socket: WebSocket<S>) -> Self {
        let now = Instant::now();
        Self {
            socket,
            received: 0,
            heard: now,
            pinged: now,
            queued: 0,
            answers: 0,
            took: now,
            timer: Box::pin(tokio::time::sleep_until(now)),
        }
    }

    /// Whether it is given more of what flows in the servant.
    pub fn is_given(&self) -> bool {
        self.socket.queued() < AHEAD
    }

    /// Whether it is read from: until answers pile up, also while it takes nothing. A viewer that takes nothing before all that it
    /// sends is taken, and is sent a big message meanwhile, would wait for ever.
    pub fn is_read(&self) -> bool {
        self.is_given() || self.answers < AHEAD
    }

    /// Sends a frame that the viewer caused, such as an answer or a complaint.
    pub fn answer(&mut self, frame: Frame) {
        self.answers += match &frame {
            Frame::Text(text) => text.len(),
            Frame::Binary(bytes) => bytes.len(),
        };
        self.send(frame);
    }

    /// Sends a frame, as far as [`next`](Self::next) is waited for.
    pub fn send(&mut self, frame: Frame) {
        match frame {
            Frame::Text(text) => self.socket.queue(frame::TEXT, text),
            Frame::Binary(bytes) => self.socket.queue(frame::BINARY, bytes),
        }
    }

    /// Sends what was queued, and gives the next message where one is wanted; comes back without one when the queue has become
    /// shorter.
    pub async fn next(&mut self, wanted: bool) -> Option<Read> {
        let before = self.socket.queued();
        poll_fn(|cx| self.poll(cx, wanted, before)).await
    }

    fn poll(&mut self, cx: &mut Context<'_>, wanted: bool, before: usize) -> Poll<Option<Read>> {
        loop {
            let now = Instant::now();
            if let Poll::Ready(Err(_)) = self.socket.poll_flush(cx) {
                return Poll::Ready(Some(Read::Lost));
            }
            let queued = self.socket.queued();
            if queued < self.queued || queued == 0 {
                self.took = now;
            }
            self.queued = queued;
            if queued == 0 {
                self.answers = 0;
            }
            if queued < before {
                return Poll::Ready(None);
            }
            let mut pongs = false;
            if wanted {
                match self.socket.poll_next(cx) {
                    Poll::Ready(Ok(Message::Text(bytes))) => {
                        return Poll::Ready(Some(Read::Message(true, bytes)));
                    }
                    Poll::Ready(Ok(Message::Binary(bytes))) => {
                        return Poll::Ready(Some(Read::Message(false, bytes)));
                    }
                    Poll::Ready(Ok(Message::Close(..))) => return Poll::Ready(Some(Read::Left)),
                    Poll::Ready(Ok(Message::Ping(payload))) => {
                        self.answers += payload.len() + frame::MAX_CONTROL;
                        self.socket.queue(frame::PONG, payload);
                        pongs = true;
                    }
                    Poll::Ready(Ok(Message::Pong(_))) => pongs = true,
                    Poll::Ready(Err(WsError::Refused { code, reason })) => {
                        return Poll::Ready(Some(Read::Refused(code, reason, false)));
                    }
                    Poll::Ready(Err(_)) => return Poll::Ready(Some(Read::Lost)),
                    Poll::Pending => {}
                }
                if self.socket.received() != self.received {
                    self.received = self.socket.received();
                    self.heard = now;
                }
            }
            if pongs {
                continue;
            }
            // Who is not read from cannot be heard.
            if wanted && now >= self.heard + SILENT {
                let reason = format!("nothing was heard for {} s", SILENT.as_secs());
                return Poll::Ready(Some(Read::Refused(1001, reason, true)));
            }
            if now >= self.took + SILENT {
                return Poll::Ready(Some(Read::Lost));
            }
            if now >= self.pinged + PING {
                self.pinged = now;
                self.socket.queue(frame::PING, Bytes::new());
                continue;
            }
            let silent = wanted.then(|| self.heard + SILENT);
            let stalled = (queued > 0).then(|| self.took + SILENT);
            let due = silent.into_iter().chain(stalled);
            let due = due.chain([self.pinged + PING]).min();
            self.timer.as_mut().reset(due.unwrap_or(now + PING));
            if self.timer.as_mut().poll(cx).is_pending() {
                return Poll::Pending;
            }
        }
    }

    /// Ends the connection with a code and the reason; `readable`: its bytes can still be told apart.
    pub async fn close(mut self, code: u16, reason: &str, readable: bool) {
        self.socket.queue_close(code, reason);
        // Who does not take its leave in time, or is gone already, is left alone.
        let _ = timeout(GOODBYE, self.socket.leave(readable)).await;
    }

    /// Answers the viewer's goodbye.
    pub async fn answer_goodbye(mut self) {
        self.socket.queue_close(1000, "");
        let _ = timeout(GOODBYE, poll_fn(|cx| self.socket.poll_flush(cx))).await;
    }
}

#[cfg(test)]
mod tests {
    use tokio::io::AsyncWriteExt;

    use super::*;

    const BIG: usize = 2 << 20;

    /// A masked binary message of a client, with a mask of nothing.
    fn message() -> Vec<u8> {
        let mut bytes = vec![0x82, 0x80 | 127];
        bytes.extend_from_slice(&(BIG as u64).to_be_bytes());
        bytes.extend_from_slice(&[0; 4]);
        bytes.resize(bytes.len() + BIG, 7);
        bytes
    }

    #[tokio::test]
    async fn a_viewer_that_writes_before_it_reads_is_read() {
        let (ours, mut theirs) = tokio::io::duplex(4096);
        let mut line = Line::new(WebSocket::new(ours, b"", 2 * BIG, 2 * BIG));
        line.send(Frame::Binary(vec![1; BIG].into()));
        assert!(!line.is_given(), "it has enough");
        let viewer = tokio::spawn(async move {
            theirs.write_all(&message()).await.expect("taken");
            // Nothing is read before.
            theirs
        });
        let read = async {
            loop {
                if let Some(read) = line.next(line.is_read()).await {
                    return read;
                }
            }
        };
        let read = timeout(Duration::from_secs(20), read).await;
        let Ok(Read::Message(false, bytes)) = read else {
            panic!("it is not read while it takes nothing");
        };
        assert_eq!(bytes.len(), BIG);
        drop(viewer.await.expect("it has written all"));
    }

    #[tokio::test]
    async fn a_viewer_whose_answers_pile_up_is_not_read() {
        let (ours, _theirs) = tokio::io::duplex(64);
        let mut line = Line::new(WebSocket::new(ours, b"", BIG, BIG));
        assert!(line.is_read() && line.is_given());
        line.answer(Frame::Text("x".repeat(BIG).into()));
        assert!(!line.is_read() && !line.is_given());
    }
}
