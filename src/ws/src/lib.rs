//! Either end of a WebSocket (RFC 6455) after its upgrade.
//!
//! Written for the portal because the data path must not copy a large message once more: payloads go to the socket from
//! the buffer they were encoded into (one vectored write for header and payload), and are received into a buffer of
//! their own that the ROS message is sliced from. Reading and writing are polled separately, so one task can do both. A
//! robot's link uses the client's end.
//!
//! A message that is being received counts against the [`Budget`] of its sender: a message that does not fit ends the
//! connection with close code 1013, one that is not complete in time with 1008.

#![forbid(unsafe_code)]

pub mod frame;

use std::collections::VecDeque;
use std::future::poll_fn;
use std::io::{self, IoSlice};
use std::pin::Pin;
use std::task::{Context, Poll, ready};
use std::time::Duration;

use budget::{Budget, Permit, UNCOUNTED};
use bytes::{Buf, Bytes, BytesMut};
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::time::{Instant, Sleep};
use tokio_util::io::poll_read_buf;

use frame::Header;

/// Payloads up to this size are copied behind their headers, so that many go into one write.
const MAX_COPIED: usize = 8 * 1024;
/// Smallest free space in the buffer for a read, in bytes.
const READ_SIZE: usize = 32 * 1024;
/// Space reserved for a payload before any of it has arrived; more is added as it arrives.
const READ_AHEAD: usize = 4 << 20;
/// Largest number of slices in one vectored write.
const MAX_SLICES: usize = 16;

/// A message from the peer.
#[derive(Debug, PartialEq, Eq)]
pub enum WsMessage {
    /// A text message, not yet checked to be UTF-8.
    Text(Bytes),
    /// A binary message.
    Binary(Bytes),
    /// A ping, to be answered by a pong with the same payload.
    Ping(Bytes),
    /// The answer to a ping.
    Pong(Bytes),
    /// A close frame: code (1005 if it has none) and reason.
    Close(u16, String),
}

/// Reason why a connection cannot continue.
#[derive(Debug, thiserror::Error)]
pub enum WsError {
    /// The peer violates the protocol or a limit.
    #[error("{reason}")]
    Refused {
        /// Close code to send.
        code: u16,
        /// Description of the violation.
        reason: String,
    },
    /// The socket failed.
    #[error(transparent)]
    Io(#[from] io::Error),
    /// The socket ended without a close frame.
    #[error("the connection ended without a close frame")]
    Eof,
}

impl WsError {
    /// Creates the error for a protocol violation (1002).
    pub fn protocol(reason: &str) -> Self {
        WsError::Refused { code: 1002, reason: reason.to_owned() }
    }

    fn too_long(what: &str, length: u64, limit: usize) -> Self {
        WsError::Refused { code: 1009, reason: format!("a {what} of {length} bytes is over the limit of {limit}") }
    }
}

/// Limits of the message that is being received, besides its length: memory and time.
struct ReceiveBudget {
    /// Memory of the message that is being received, held until the next one is polled for.
    permit: Permit,
    patience: Duration,
    /// Time by which the message that is being received must be complete.
    deadline: Option<Instant>,
    timer: Option<Pin<Box<Sleep>>>,
}

/// A WebSocket connection, of the server or the client.
pub struct WebSocket<S> {
    io: S,
    /// Generator of the masks of a client's frames; a server has none and accepts masked frames only.
    masks: Option<MaskGenerator>,
    max_frame: usize,
    max_message: usize,
    read: BytesMut,
    header: Option<Header>,
    /// Opcode and beginning of a fragmented message.
    partial: Option<(u8, BytesMut)>,
    /// Queued bytes in the order of sending; `tail` is the last chunk, which still grows.
    write: VecDeque<Bytes>,
    tail: BytesMut,
    queued: usize,
    received: u64,
    unfinished: Option<ReceiveBudget>,
}

impl<S: AsyncRead + AsyncWrite + Unpin> WebSocket<S> {
    /// Creates the server's end. `read_ahead` are the bytes that the client sent behind its handshake; frames and
    /// messages longer than `max_frame` and `max_message` (bytes) end the connection.
    pub fn new(io: S, read_ahead: &[u8], max_frame: usize, max_message: usize) -> Self {
        Self {
            io,
            masks: None,
            max_frame,
            max_message,
            read: BytesMut::from(read_ahead),
            header: None,
            partial: None,
            write: VecDeque::new(),
            tail: BytesMut::new(),
            queued: 0,
            received: 0,
            unfinished: None,
        }
    }

    /// Counts received data against `budget`, from the first byte of a message until the next message is polled for,
    /// and limits the time from a message's first byte to its last to `patience`.
    pub fn with_budget(mut self, budget: &Budget, patience: Duration) -> Self {
        self.unfinished = Some(ReceiveBudget { permit: budget.permit(), patience, deadline: None, timer: None });
        self
    }

    /// Creates the client's end; `seed` is a random number for its masks.
    pub fn client(io: S, read_ahead: &[u8], max_frame: usize, max_message: usize, seed: u64) -> Self {
        Self { masks: Some(MaskGenerator(seed | 1)), ..Self::new(io, read_ahead, max_frame, max_message) }
    }

    /// Returns the underlying stream.
    pub fn get_ref(&self) -> &S {
        &self.io
    }

    /// Polls for the next message. Must not be called again after an error.
    pub fn poll_next(&mut self, cx: &mut Context<'_>) -> Poll<Result<WsMessage, WsError>> {
        if self.partial.is_none() && self.header.is_none() {
            // The previous message has been handled, or this is the first one.
            self.unfinished.iter_mut().for_each(ReceiveBudget::reset);
        }
        loop {
            if self.header.is_none() {
                self.header = self.next_header()?;
            }
            let complete = |header: &frame::Header| header.length <= self.read.len() as u64;
            if let Some(header) = self.header.filter(complete) {
                self.header = None;
                let payload = self.read.split_to(header.length as usize);
                if let Some(message) = self.accept(header, payload)? {
                    return Poll::Ready(Ok(message));
                }
                continue;
            }
            self.make_room()?;
            let Poll::Ready(read) = poll_read_buf(Pin::new(&mut self.io), cx, &mut self.read) else {
                ready!(self.poll_deadline(cx));
                return Poll::Ready(Err(self.deadline_error()));
            };
            let read = read?;
            if read == 0 {
                return Poll::Ready(Err(WsError::Eof));
            }
            self.received += read as u64;
        }
    }

    /// Returns the number of bytes received so far, including those of an unfinished message and excluding
    /// `read_ahead`.
    pub fn bytes_received(&self) -> u64 {
        self.received
    }

    /// Returns whether a part of a message has been received.
    pub fn is_receiving(&self) -> bool {
        self.header.is_some() || self.partial.is_some() || !self.read.is_empty()
    }

    fn next_header(&mut self) -> Result<Option<Header>, WsError> {
        let Some((header, size)) = Header::parse(&self.read)? else {
            return Ok(None);
        };
        match (header.mask, &self.masks) {
            (None, None) => return Err(WsError::protocol("a client's frames must be masked")),
            (Some(_), Some(_)) => {
                return Err(WsError::protocol("a server's frames must not be masked"));
            }
            _ => {}
        }
        if header.length > self.max_frame as u64 {
            return Err(WsError::too_long("frame", header.length, self.max_frame));
        }
        self.read.advance(size);
        Ok(Some(header))
    }

    /// Ready when the deadline of the message that is being received has passed.
    fn poll_deadline(&mut self, cx: &mut Context<'_>) -> Poll<()> {
        let is_receiving = self.is_receiving();
        let Some(unfinished) = self.unfinished.as_mut().filter(|_| is_receiving) else {
            return Poll::Pending;
        };
        let patience = unfinished.patience;
        let now = || Instant::now() + patience;
        let deadline = *unfinished.deadline.get_or_insert_with(now);
        let timer = unfinished.timer.get_or_insert_with(|| Box::pin(tokio::time::sleep_until(deadline)));
        // One timer serves all messages: if it was set for an earlier one, it is reset when it fires.
        loop {
            ready!(timer.as_mut().poll(cx));
            if Instant::now() >= deadline {
                return Poll::Ready(());
            }
            timer.as_mut().reset(deadline);
        }
    }

    fn deadline_error(&self) -> WsError {
        let patience = self.unfinished.as_ref().map(|unfinished| unfinished.patience);
        WsError::Refused {
            code: 1008,
            reason: format!("a message is not complete after {} s", patience.unwrap_or_default().as_secs_f32()),
        }
    }

    fn make_room(&mut self) -> Result<(), WsError> {
        let missing = match self.header {
            Some(header) => (header.length as usize - self.read.len()).min(READ_AHEAD.max(self.read.len())),
            None => 0,
        };
        let room = missing.max(READ_SIZE / 2);
        if self.read.capacity() - self.read.len() < room {
            let room = room.max(READ_SIZE);
            let begun = self.partial.as_ref().map_or(0, |(_, begun)| begun.len());
            let size = begun + self.read.len() + room;
            if let Some(unfinished) = self.unfinished.as_mut().filter(|_| size > UNCOUNTED) {
                let counted = unfinished.permit.grow_to(size);
                counted.map_err(|full| WsError::Refused {
                    code: 1013,
                    reason: format!("a message cannot be received: {full}"),
                })?;
            }
            self.read.reserve(room);
        }
        Ok(())
    }

    fn accept(&mut self, header: Header, mut payload: BytesMut) -> Result<Option<WsMessage>, WsError> {
        if let Some(mask) = header.mask {
            frame::unmask(&mut payload, mask);
        }
        match header.opcode {
            frame::PING => return Ok(Some(WsMessage::Ping(payload.freeze()))),
            frame::PONG => return Ok(Some(WsMessage::Pong(payload.freeze()))),
            frame::CLOSE => return parse_close(&payload).map(Some),
            _ => {}
        }
        let (opcode, whole) = match (self.partial.take(), header.opcode) {
            (None, frame::CONTINUATION) => {
                return Err(WsError::protocol("a message begins with a continuation frame"));
            }
            (None, opcode) => (opcode, payload),
            (Some((opcode, mut begun)), frame::CONTINUATION) => {
                let length = begun.len() as u64 + header.length;
                if length > self.max_message as u64 {
                    return Err(WsError::too_long("message", length, self.max_message));
                }
                begun.unsplit(payload);
                (opcode, begun)
            }
            (Some(_), _) => {
                return Err(WsError::protocol("a message begins before the last one has ended"));
            }
        };
        if !header.last {
            self.partial = Some((opcode, whole));
            return Ok(None);
        }
        if whole.len() > self.max_message {
            return Err(WsError::too_long("message", whole.len() as u64, self.max_message));
        }
        let whole = whole.freeze();
        Ok(Some(if opcode == frame::TEXT { WsMessage::Text(whole) } else { WsMessage::Binary(whole) }))
    }

    /// Returns the number of bytes that are queued and not yet written to the socket.
    pub fn bytes_queued(&self) -> usize {
        self.queued
    }

    /// Queues a frame; nothing is sent before [`poll_flush`](Self::poll_flush).
    pub fn queue(&mut self, opcode: u8, payload: Bytes) {
        let before = self.tail.len();
        if let Some(masks) = &mut self.masks {
            let mask = masks.next_mask();
            Header::write(&mut self.tail, opcode, payload.len(), Some(mask));
            // Masking copies the payload in any case.
            let start = self.tail.len();
            self.tail.extend_from_slice(&payload);
            frame::unmask(&mut self.tail[start..], mask);
            self.queued += self.tail.len() - before;
            return;
        }
        Header::write(&mut self.tail, opcode, payload.len(), None);
        self.queued += self.tail.len() - before + payload.len();
        if payload.len() <= MAX_COPIED {
            self.tail.extend_from_slice(&payload);
        } else {
            self.write.push_back(self.tail.split().freeze());
            self.write.push_back(payload);
        }
    }

    /// Queues a close frame; the reason is truncated to what fits.
    pub fn queue_close(&mut self, code: u16, reason: &str) {
        let mut end = reason.len().min(frame::MAX_CONTROL - 2);
        while !reason.is_char_boundary(end) {
            end -= 1;
        }
        let mut payload = BytesMut::with_capacity(2 + end);
        // 1005 means "no code was given" and must not be sent.
        if code != 1005 {
            payload.extend_from_slice(&code.to_be_bytes());
            payload.extend_from_slice(&reason.as_bytes()[..end]);
        }
        self.queue(frame::CLOSE, payload.freeze());
    }

    /// Ready when all queued frames have been written to the socket.
    pub fn poll_flush(&mut self, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        if !self.tail.is_empty() {
            self.write.push_back(self.tail.split().freeze());
        }
        while self.queued > 0 {
            let mut slices = [IoSlice::new(&[]); MAX_SLICES];
            let mut count = 0;
            for (slice, bytes) in slices.iter_mut().zip(&self.write) {
                *slice = IoSlice::new(bytes);
                count += 1;
            }
            let mut written = ready!(Pin::new(&mut self.io).poll_write_vectored(cx, &slices[..count]))?;
            if written == 0 {
                return Poll::Ready(Err(io::ErrorKind::WriteZero.into()));
            }
            self.queued -= written;
            while let Some(first) = self.write.front_mut() {
                if written < first.len() {
                    first.advance(written);
                    break;
                }
                written -= first.len();
                self.write.pop_front();
            }
        }
        Pin::new(&mut self.io).poll_flush(cx)
    }

    /// Sends the queued frames (a close frame last) and waits for the peer's close frame; if the incoming bytes can no
    /// longer be parsed (`readable` is false), waits for the end of the connection. Without this the client might see a
    /// reset instead of the reason.
    pub async fn shutdown(&mut self, readable: bool) -> Result<(), WsError> {
        poll_fn(|cx| self.poll_flush(cx)).await?;
        if readable {
            loop {
                match poll_fn(|cx| self.poll_next(cx)).await {
                    Ok(WsMessage::Close(..)) | Err(WsError::Eof) => return Ok(()),
                    Ok(_) => {}
                    Err(error) => return Err(error),
                }
            }
        }
        poll_fn(|cx| Pin::new(&mut self.io).poll_shutdown(cx)).await?;
        loop {
            self.read.clear();
            self.read.reserve(READ_SIZE);
            if poll_fn(|cx| poll_read_buf(Pin::new(&mut self.io), cx, &mut self.read)).await? == 0 {
                return Ok(());
            }
        }
    }
}

impl ReceiveBudget {
    /// Releases the memory and the deadline after a message.
    fn reset(&mut self) {
        let _ = self.permit.resize(0);
        self.deadline = None;
    }
}

/// Generator of the masks of a client's frames (xorshift64). Masks keep a script in a browser from choosing the bytes
/// on the wire; a program that chooses its own bytes anyway needs them to be valid, not secret.
struct MaskGenerator(u64);

impl MaskGenerator {
    fn next_mask(&mut self) -> [u8; 4] {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        let [a, b, c, d, ..] = self.0.to_le_bytes();
        [a, b, c, d]
    }
}

fn parse_close(payload: &[u8]) -> Result<WsMessage, WsError> {
    match payload {
        [] => Ok(WsMessage::Close(1005, String::new())),
        [high, low, reason @ ..] => {
            let code = u16::from_be_bytes([*high, *low]);
            match std::str::from_utf8(reason) {
                Ok(reason) if is_sendable(code) => Ok(WsMessage::Close(code, reason.to_owned())),
                _ => Err(WsError::protocol("a close frame has no valid code and reason")),
            }
        }
        _ => Err(WsError::protocol("a close frame has half a code")),
    }
}

/// Returns whether a code may be sent in a close frame (RFC 6455, section 7.4).
fn is_sendable(code: u16) -> bool {
    matches!(code, 1000..=1003 | 1007..=1014 | 3000..=4999)
}

#[cfg(test)]
mod tests;
