//! Splits a stream of length-prefixed messages into one [`Bytes`] each.
//!
//! Small messages are cut out of a common buffer, which is filled as far as the socket allows; a big one is read
//! straight into an allocation of its own. That allocation grows with the data received, not with the promise of the
//! prefix, and counts in the connection's budget until the message is complete.

use std::io;
use std::time::Duration;

use budget::{Budget, Permit};
use bytes::{Buf as _, BufMut as _, Bytes, BytesMut};
use tokio::io::{AsyncRead, AsyncReadExt as _};
use tokio::time::timeout;

use super::Error;

/// Size from which a message gets its own allocation.
pub(crate) const BIG: usize = 16 << 10;
/// Size of the common buffer: initial, and when the stream is busy.
const SMALL_BUFFER: usize = 4 << 10;
const LARGE_BUFFER: usize = 128 << 10;
/// Size up to which an allocation is reused for the next big message, if nobody holds the previous one any more.
const MAX_REUSED_SIZE: usize = 8 << 20;
/// Maximum wait for that message before the allocation is freed.
const REUSE_TIMEOUT: Duration = Duration::from_secs(1);
/// Space reserved for a big message before any of it has arrived; doubled as it arrives.
const AHEAD: usize = 1 << 20;

/// Limits for the messages of a connection.
#[derive(Debug, Clone)]
pub struct FrameBounds {
    /// Maximum size of one message in bytes.
    pub max: usize,
    /// Budget for incomplete messages.
    pub budget: Budget,
    /// Time limit from a message's length prefix to its last byte.
    pub unfinished: Duration,
}

impl From<usize> for FrameBounds {
    /// Limits messages to `max` bytes, with an unlimited budget.
    fn from(max: usize) -> Self {
        Self { max, budget: Budget::without_limit(), unfinished: super::MESSAGE_TIMEOUT }
    }
}

/// Reads messages from one connection.
#[derive(Debug)]
pub struct FrameReader {
    buffer: BytesMut,
    chunk: usize,
    /// Allocation of the last big message, while it may be reused.
    big: Option<BytesMut>,
    bounds: FrameBounds,
    /// Permit for the big message that is being read.
    permit: Permit,
}

impl FrameReader {
    /// Creates a reader that begins with what was already read and takes messages within `bounds`.
    pub fn new(buffer: BytesMut, bounds: impl Into<FrameBounds>) -> Self {
        let bounds = bounds.into();
        Self { buffer, chunk: SMALL_BUFFER, big: None, permit: bounds.budget.permit(), bounds }
    }

    /// Returns the next message, or `None` when the stream ends between messages.
    pub async fn next(&mut self, stream: &mut (impl AsyncRead + Unpin)) -> Result<Option<Bytes>, Error> {
        loop {
            if let Some(size) = self.peek_size()? {
                if self.buffer.len() >= 4 + size {
                    self.buffer.advance(4);
                    return Ok(Some(self.buffer.split_to(size).freeze()));
                }
                if size >= BIG {
                    self.buffer.advance(4);
                    let message = self.read_big(stream, size).await;
                    // A complete message is charged where it is queued; after an error the connection ends.
                    let _ = self.permit.resize(0);
                    return message.map(Some);
                }
            }
            if !self.fill(stream).await? {
                return if self.buffer.is_empty() { Ok(None) } else { Err(ended_inside()) };
            }
        }
    }

    /// Reads one byte before the messages that follow it (the success flag of a service response).
    pub(super) async fn byte(&mut self, stream: &mut (impl AsyncRead + Unpin)) -> Result<Option<u8>, Error> {
        if self.buffer.is_empty() && !self.fill(stream).await? {
            return Ok(None);
        }
        Ok(Some(self.buffer.get_u8()))
    }

    /// Returns true if no unprocessed bytes are buffered.
    pub(super) fn is_empty(&self) -> bool {
        self.buffer.is_empty()
    }

    /// Returns the next message's size as soon as its prefix has arrived.
    fn peek_size(&self) -> Result<Option<usize>, Error> {
        let Some(prefix) = self.buffer.first_chunk::<4>() else {
            return Ok(None);
        };
        let size = u32::from_le_bytes(*prefix) as usize;
        let max = self.bounds.max;
        if size > max {
            return Err(Error::TooLarge { size, max });
        }
        Ok(Some(size))
    }

    /// Reads what is available; returns false at the end of the stream.
    async fn fill(&mut self, stream: &mut (impl AsyncRead + Unpin)) -> Result<bool, Error> {
        let spare = self.buffer.capacity() - self.buffer.len();
        if spare < self.chunk / 4 {
            self.buffer.reserve(self.chunk);
        }
        let room = self.buffer.capacity() - self.buffer.len();
        let read = stream.read_buf(&mut self.buffer);
        let count = if self.big.is_none() {
            read.await?
        } else {
            match timeout(REUSE_TIMEOUT, read).await {
                Ok(count) => count?,
                Err(_) => {
                    self.big = None;
                    stream.read_buf(&mut self.buffer).await?
                }
            }
        };
        if count == room {
            self.chunk = (self.chunk * 2).min(LARGE_BUFFER);
        } else if count < self.chunk / 16 {
            self.chunk = (self.chunk / 2).max(SMALL_BUFFER);
        }
        Ok(count > 0)
    }

    /// Reserves space for at least `least` more bytes of a message of `size` bytes.
    fn make_room(&mut self, big: &mut BytesMut, size: usize, least: usize) -> Result<(), Error> {
        if big.capacity() - big.len() < least {
            let room = (size - big.len()).min(big.len().max(AHEAD)).max(least);
            self.permit.grow_to(big.len() + room)?;
            big.reserve(room);
        }
        Ok(())
    }

    async fn read_big(&mut self, stream: &mut (impl AsyncRead + Unpin), size: usize) -> Result<Bytes, Error> {
        let mut big = self.big.take().unwrap_or_default();
        let first = self.buffer.len().min(size);
        self.make_room(&mut big, size, first)?;
        big.put(self.buffer.split_to(first));
        let patience = self.bounds.unfinished;
        let reading = async {
            while big.len() < size {
                self.make_room(&mut big, size, 1)?;
                let room = (big.capacity() - big.len()).min(size - big.len());
                if stream.read_buf(&mut (&mut big).limit(room)).await? == 0 {
                    return Err(ended_inside());
                }
            }
            Ok(())
        };
        match timeout(patience, reading).await {
            Ok(read) => read?,
            Err(_) => {
                return Err(Error::Unfinished { size, read: big.len(), after: patience });
            }
        }
        let message = big.split().freeze();
        if size <= MAX_REUSED_SIZE {
            self.big = Some(big);
        }
        Ok(message)
    }
}

fn ended_inside() -> Error {
    Error::Io(io::Error::new(io::ErrorKind::UnexpectedEof, "the connection ended inside a message"))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame_messages(messages: &[Vec<u8>]) -> Vec<u8> {
        let mut out = Vec::new();
        for message in messages {
            out.put_u32_le(message.len() as u32);
            out.extend_from_slice(message);
        }
        out
    }

    async fn all(mut stream: impl AsyncRead + Unpin) -> Result<Vec<Bytes>, Error> {
        let mut frames = FrameReader::new(BytesMut::new(), 1 << 20);
        let mut messages = Vec::new();
        while let Some(message) = frames.next(&mut stream).await? {
            messages.push(message);
        }
        Ok(messages)
    }

    #[tokio::test]
    async fn messages_of_all_sizes_come_out_whole() {
        let sizes = [0, 1, 3, BIG - 1, BIG, BIG + 1, 5, LARGE_BUFFER * 3, 0, 100];
        let messages: Vec<Vec<u8>> = sizes.iter().map(|size| vec![*size as u8; *size]).collect();
        let bytes = frame_messages(&messages);
        let whole = all(bytes.as_slice()).await.unwrap();
        assert_eq!(whole, messages);
        // The same bytes, arriving in small pieces.
        let (mut sender, receiver) = tokio::io::duplex(777);
        let sending = tokio::spawn(async move {
            use tokio::io::AsyncWriteExt as _;
            sender.write_all(&bytes).await.unwrap();
        });
        assert_eq!(all(receiver).await.unwrap(), messages);
        sending.await.unwrap();
    }

    #[tokio::test]
    async fn unfinished_messages_take_no_more_than_their_budget() {
        use tokio::io::AsyncWriteExt as _;
        let budget = Budget::new("servant x", 4 << 20);
        let bounds = FrameBounds { max: 250 << 20, budget: budget.clone(), unfinished: Duration::from_secs(3600) };
        // Eight connections each promise 250 MB and send the first 3 of it.
        let mut reading = tokio::task::JoinSet::new();
        for _ in 0..8 {
            let (mut sender, mut receiver) = tokio::io::duplex(64 << 10);
            let bounds = bounds.clone();
            reading.spawn(async move {
                let sending = async {
                    sender.write_u32_le(250 << 20).await?;
                    sender.write_all(&vec![7; 3 << 20]).await?;
                    std::future::pending::<io::Result<()>>().await
                };
                let mut frames = FrameReader::new(BytesMut::new(), bounds);
                tokio::select! {
                    message = frames.next(&mut receiver) => message,
                    _ = sending => unreachable!("the reader is asked first"),
                }
            });
        }
        // At most one can have its 3 MB; all others get an error.
        for _ in 0..7 {
            let refused = timeout(Duration::from_secs(60), reading.join_next()).await;
            let refused = refused.expect("it is refused").unwrap().unwrap();
            let refused = refused.unwrap_err();
            assert!(refused.to_string().contains("the memory for servant x"), "{refused}");
            assert!(budget.used_bytes() <= 4 << 20);
        }
        reading.shutdown().await;
        assert_eq!(budget.used_bytes(), 0);
    }

    #[tokio::test]
    async fn a_whole_message_counts_no_longer() {
        let budget = Budget::new("servant x", 4 << 20);
        let bounds = FrameBounds { budget: budget.clone(), ..FrameBounds::from(8 << 20) };
        let bytes = frame_messages(&vec![vec![1; 3 << 20]; 3]);
        let mut stream = bytes.as_slice();
        let mut frames = FrameReader::new(BytesMut::new(), bounds);
        let mut held = Vec::new();
        while let Some(message) = frames.next(&mut stream).await.unwrap() {
            assert_eq!(budget.used_bytes(), 0);
            held.push(message);
        }
        assert_eq!(held, vec![vec![1; 3 << 20]; 3]);
    }

    #[tokio::test]
    async fn a_message_that_stays_unfinished_ends_its_connection() {
        use tokio::io::AsyncWriteExt as _;
        let (mut sender, mut receiver) = tokio::io::duplex(64 << 10);
        let bounds = FrameBounds { unfinished: Duration::from_millis(20), ..FrameBounds::from(250 << 20) };
        let bytes = &frame_messages(&[vec![7; 100_000]])[..50_000];
        sender.write_all(bytes).await.unwrap();
        let mut frames = FrameReader::new(BytesMut::new(), bounds);
        let given_up = timeout(Duration::from_secs(60), frames.next(&mut receiver)).await;
        let error = given_up.expect("it is given up").unwrap_err();
        assert!(matches!(error, Error::Unfinished { size: 100_000, .. }), "{error}");
    }

    #[tokio::test]
    async fn a_lying_prefix_is_refused() {
        let error = all([0xff; 4].as_slice()).await.unwrap_err();
        assert!(matches!(error, Error::TooLarge { size: 0xffff_ffff, .. }), "{error}");
    }

    #[tokio::test]
    async fn an_end_inside_a_message_is_an_error() {
        for cut in [2, 5, 4 + BIG] {
            let bytes = frame_messages(&[vec![7; BIG + 10]]);
            let error = all(&bytes[..cut]).await.unwrap_err();
            assert!(matches!(error, Error::Io(_)), "{error}");
        }
    }

    #[tokio::test]
    async fn a_held_message_is_not_overwritten_by_the_next() {
        let bytes = frame_messages(&[vec![1; BIG], vec![2; BIG], vec![3; BIG]]);
        let mut stream = bytes.as_slice();
        let mut frames = FrameReader::new(BytesMut::new(), 1 << 20);
        let first = frames.next(&mut stream).await.unwrap().unwrap();
        drop(frames.next(&mut stream).await.unwrap().unwrap());
        let third = frames.next(&mut stream).await.unwrap().unwrap();
        assert!(first.iter().all(|byte| *byte == 1));
        assert!(third.iter().all(|byte| *byte == 3));
    }
}
