//! WebSocket of one viewer: read while it is written to, kept alive by pings, and closed if nothing is received or
//! sent for too long.

use std::future::poll_fn;
use std::pin::Pin;
use std::task::{Context, Poll};
use std::time::Duration;

use bytes::Bytes;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::time::{Instant, Sleep, timeout};
use ws::{WebSocket, WsError, WsMessage, frame};

/// A frame to send to a viewer; each variant holds the payload of one frame.
pub enum ViewerFrame {
    /// A JSON message.
    Text(Bytes),
    /// A message of a topic, or a service response.
    Binary(Bytes),
}

/// Result of reading from a viewer.
pub enum ViewerInput {
    /// A message and whether it is text.
    Message(bool, Bytes),
    /// The viewer sent a close frame.
    Left,
    /// The connection was lost.
    Lost,
    /// The connection must be closed with this code (RFC 6455) and reason. The flag tells whether the frames that
    /// follow can still be parsed.
    Refused(u16, String, bool),
}

/// Interval between pings.
const PING: Duration = Duration::from_secs(30);
/// Timeout after which a viewer is given up that sends nothing, not even a pong, or reads nothing.
const SILENT: Duration = Duration::from_secs(90);
/// Number of queued bytes above which the viewer is sent no more messages.
const AHEAD: usize = 1 << 20;
/// Timeout for the last frames.
const GOODBYE: Duration = Duration::from_secs(2);

/// The WebSocket to one viewer.
pub struct ViewerSocket<S> {
    socket: WebSocket<S>,
    received: u64,
    heard: Instant,
    pinged: Instant,
    queued: usize,
    /// Queued bytes of replies, since the queue was last empty.
    answers: usize,
    /// Time when the socket last accepted bytes or the queue was empty.
    took: Instant,
    timer: Pin<Box<Sleep>>,
}

impl<S: AsyncRead + AsyncWrite + Unpin> ViewerSocket<S> {
    /// Wraps a connection after its upgrade.
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

    /// Returns true if more of the servant's messages may be queued.
    pub fn can_send(&self) -> bool {
        self.socket.bytes_queued() < AHEAD
    }

    /// Returns true if messages should be read. This holds until replies pile up, even while the viewer reads
    /// nothing: a viewer that reads only after sending everything would otherwise deadlock on a large message.
    pub fn should_read(&self) -> bool {
        self.can_send() || self.answers < AHEAD
    }

    /// Queues a frame that the viewer caused, such as a response or an error.
    pub fn send_reply(&mut self, frame: ViewerFrame) {
        self.answers += match &frame {
            ViewerFrame::Text(text) => text.len(),
            ViewerFrame::Binary(bytes) => bytes.len(),
        };
        self.send(frame);
    }

    /// Queues a frame; [`next`](Self::next) sends it.
    pub fn send(&mut self, frame: ViewerFrame) {
        match frame {
            ViewerFrame::Text(text) => self.socket.queue(frame::TEXT, text),
            ViewerFrame::Binary(bytes) => self.socket.queue(frame::BINARY, bytes),
        }
    }

    /// Sends queued frames and reads the next message if `wanted`. Returns `None` once the queue has become shorter.
    pub async fn next(&mut self, wanted: bool) -> Option<ViewerInput> {
        let before = self.socket.bytes_queued();
        poll_fn(|cx| self.poll(cx, wanted, before)).await
    }

    fn poll(&mut self, cx: &mut Context<'_>, wanted: bool, before: usize) -> Poll<Option<ViewerInput>> {
        loop {
            let now = Instant::now();
            if let Poll::Ready(Err(_)) = self.socket.poll_flush(cx) {
                return Poll::Ready(Some(ViewerInput::Lost));
            }
            let queued = self.socket.bytes_queued();
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
                    Poll::Ready(Ok(WsMessage::Text(bytes))) => {
                        return Poll::Ready(Some(ViewerInput::Message(true, bytes)));
                    }
                    Poll::Ready(Ok(WsMessage::Binary(bytes))) => {
                        return Poll::Ready(Some(ViewerInput::Message(false, bytes)));
                    }
                    Poll::Ready(Ok(WsMessage::Close(..))) => {
                        return Poll::Ready(Some(ViewerInput::Left));
                    }
                    Poll::Ready(Ok(WsMessage::Ping(payload))) => {
                        self.answers += payload.len() + frame::MAX_CONTROL;
                        self.socket.queue(frame::PONG, payload);
                        pongs = true;
                    }
                    Poll::Ready(Ok(WsMessage::Pong(_))) => pongs = true,
                    Poll::Ready(Err(WsError::Refused { code, reason })) => {
                        return Poll::Ready(Some(ViewerInput::Refused(code, reason, false)));
                    }
                    Poll::Ready(Err(_)) => return Poll::Ready(Some(ViewerInput::Lost)),
                    Poll::Pending => {}
                }
                if self.socket.bytes_received() != self.received {
                    self.received = self.socket.bytes_received();
                    self.heard = now;
                }
            }
            if pongs {
                continue;
            }
            // While nothing is read, silence cannot be measured.
            if wanted && now >= self.heard + SILENT {
                let reason = format!("nothing was received for {} s", SILENT.as_secs());
                return Poll::Ready(Some(ViewerInput::Refused(1001, reason, true)));
            }
            if now >= self.took + SILENT {
                return Poll::Ready(Some(ViewerInput::Lost));
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

    /// Closes the connection with a code and a reason. `readable` tells whether incoming frames can still be parsed.
    pub async fn close(mut self, code: u16, reason: &str, readable: bool) {
        self.socket.queue_close(code, reason);
        // A viewer that does not answer in time, or is gone, is not waited for.
        let _ = timeout(GOODBYE, self.socket.shutdown(readable)).await;
    }

    /// Answers the viewer's close frame.
    pub async fn reply_close(mut self) {
        self.socket.queue_close(1000, "");
        let _ = timeout(GOODBYE, poll_fn(|cx| self.socket.poll_flush(cx))).await;
    }
}

#[cfg(test)]
mod tests {
    use tokio::io::AsyncWriteExt;

    use super::*;

    const BIG: usize = 2 << 20;

    /// Encodes a binary message of a client with a zero mask.
    fn masked_message() -> Vec<u8> {
        let mut bytes = vec![0x82, 0x80 | 127];
        bytes.extend_from_slice(&(BIG as u64).to_be_bytes());
        bytes.extend_from_slice(&[0; 4]);
        bytes.resize(bytes.len() + BIG, 7);
        bytes
    }

    #[tokio::test]
    async fn a_viewer_that_writes_before_it_reads_is_read() {
        let (ours, mut theirs) = tokio::io::duplex(4096);
        let mut line = ViewerSocket::new(WebSocket::new(ours, b"", 2 * BIG, 2 * BIG));
        line.send(ViewerFrame::Binary(vec![1; BIG].into()));
        assert!(!line.can_send(), "it has enough");
        let viewer = tokio::spawn(async move {
            theirs.write_all(&masked_message()).await.expect("taken");
            // It reads nothing before all is written.
            theirs
        });
        let read = async {
            loop {
                if let Some(read) = line.next(line.should_read()).await {
                    return read;
                }
            }
        };
        let read = timeout(Duration::from_secs(20), read).await;
        let Ok(ViewerInput::Message(false, bytes)) = read else {
            panic!("it is not read while it takes nothing");
        };
        assert_eq!(bytes.len(), BIG);
        drop(viewer.await.expect("it has written all"));
    }

    #[tokio::test]
    async fn a_viewer_whose_answers_pile_up_is_not_read() {
        let (ours, _theirs) = tokio::io::duplex(64);
        let mut line = ViewerSocket::new(WebSocket::new(ours, b"", BIG, BIG));
        assert!(line.should_read() && line.can_send());
        line.send_reply(ViewerFrame::Text("x".repeat(BIG).into()));
        assert!(!line.should_read() && !line.can_send());
    }
}
