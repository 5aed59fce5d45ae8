//! A stream of length-prefixed messages → one [`Bytes`] each.
//!
//! Small messages are cut out of a common buffer, which is read as full as the socket gives; a big one is read
//! straight into an allocation of its own.

use std::io;
use std::time::Duration;

use bytes::{Buf as _, BufMut as _, Bytes, BytesMut};
use tokio::io::{AsyncRead, AsyncReadExt as _};
use tokio::time::timeout;

use super::Error;

/// A message of at least this size gets its own allocation.
pub(crate) const BIG: usize = 16 << 10;
/// The common buffer's size, at first and when the stream is busy.
const FEW: usize = 4 << 10;
const MANY: usize = 128 << 10;
/// An allocation up to this size is used again for the next big message, if nobody holds the last one any more.
const REUSED: usize = 8 << 20;
/// ... unless that takes longer than this to come.
const KEPT: Duration = Duration::from_secs(1);

/// Reads messages off one connection.
#[derive(Debug)]
pub struct FrameReader {
    buffer: BytesMut,
    chunk: usize,
    /// The last big message's allocation, while it may be used again.
    big: Option<BytesMut>,
    max: usize,
}

impl FrameReader {
    /// A reader that begins with what was already read, and takes messages up to `max` bytes.
    pub fn new(buffer: BytesMut, max: usize) -> Self {
        Self {
            buffer,
            chunk: FEW,
            big: None,
            max,
        }
    }

    /// The next message; `None` when the stream ends between messages.
    pub async fn next(
        &mut self,
        stream: &mut (impl AsyncRead + Unpin),
    ) -> Result<Option<Bytes>, Error> {
        loop {
            if let Some(size) = self.announced()? {
                if self.buffer.len() >= 4 + size {
                    self.buffer.advance(4);
                    return Ok(Some(self.buffer.split_to(size).freeze()));
                }
                if size >= BIG {
                    self.buffer.advance(4);
                    return self.own_allocation(stream, size).await.map(Some);
                }
            }
            if !self.fill(stream).await? {
                return if self.buffer.is_empty() {
                    Ok(None)
                } else {
                    Err(ended_inside())
                };
            }
        }
    }

    /// One byte, before the messages that follow it (the success flag of a service response).
    pub(super) async fn byte(
        &mut self,
        stream: &mut (impl AsyncRead + Unpin),
    ) -> Result<Option<u8>, Error> {
        if self.buffer.is_empty() && !self.fill(stream).await? {
            return Ok(None);
        }
        Ok(Some(self.buffer.get_u8()))
    }

    /// Whether nothing is left over from what was read.
    pub(super) fn is_empty(&self) -> bool {
        self.buffer.is_empty()
    }

    /// The next message's length, as soon as its prefix is there.
    fn announced(&self) -> Result<Option<usize>, Error> {
        let Some(prefix) = self.buffer.first_chunk::<4>() else {
            return Ok(None);
        };
        let size = u32::from_le_bytes(*prefix) as usize;
        if size > self.max {
            return Err(Error::TooLarge {
                size,
                max: self.max,
            });
        }
        Ok(Some(size))
    }

    /// Reads as much as there is; false at the end of the stream.
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
            match timeout(KEPT, read).await {
                Ok(count) => count?,
                Err(_) => {
                    self.big = None;
                    stream.read_buf(&mut self.buffer).await?
                }
            }
        };
        if count == room {
            self.chunk = (self.chunk * 2).min(MANY);
        } else if count < self.chunk / 16 {
            self.chunk = (self.chunk / 2).max(FEW);
        }
        Ok(count > 0)
    }

    async fn own_allocation(
        &mut self,
        stream: &mut (impl AsyncRead + Unpin),
        size: usize,
    ) -> Result<Bytes, Error> {
        // The pages behind it are only taken as they are written to, whatever the prefix promised.
        let mut big = self.big.take().unwrap_or_default();
        big.reserve(size);
        let first = self.buffer.len().min(size);
        big.put(self.buffer.split_to(first));
        while big.len() < size {
            let missing = size - big.len();
            if stream.read_buf(&mut (&mut big).limit(missing)).await? == 0 {
                return Err(ended_inside());
            }
        }
        let message = big.split().freeze();
        if size <= REUSED {
            self.big = Some(big);
        }
        Ok(message)
    }
}

fn ended_inside() -> Error {
    Error::Io(io::Error::new(
        io::ErrorKind::UnexpectedEof,
        "the connection ended inside a message",
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn framed(messages: &[Vec<u8>]) -> Vec<u8> {
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
        let sizes = [0, 1, 3, BIG - 1, BIG, BIG + 1, 5, MANY * 3, 0, 100];
        let messages: Vec<Vec<u8>> = sizes.iter().map(|size| vec![*size as u8; *size]).collect();
        let bytes = framed(&messages);
        let whole = all(bytes.as_slice()).await.unwrap();
        assert_eq!(whole, messages);
        // The same, arriving in small pieces.
        let (mut sender, receiver) = tokio::io::duplex(777);
        let sending = tokio::spawn(async move {
            use tokio::io::AsyncWriteExt as _;
            sender.write_all(&bytes).await.unwrap();
        });
        assert_eq!(all(receiver).await.unwrap(), messages);
        sending.await.unwrap();
    }

    #[tokio::test]
    async fn a_lying_prefix_is_refused() {
        let error = all([0xff; 4].as_slice()).await.unwrap_err();
        assert!(
            matches!(
                error,
                Error::TooLarge {
                    size: 0xffff_ffff,
                    ..
                }
            ),
            "{error}"
        );
    }

    #[tokio::test]
    async fn an_end_inside_a_message_is_an_error() {
        for cut in [2, 5, 4 + BIG] {
            let bytes = framed(&[vec![7; BIG + 10]]);
            let error = all(&bytes[..cut]).await.unwrap_err();
            assert!(matches!(error, Error::Io(_)), "{error}");
        }
    }

    #[tokio::test]
    async fn a_held_message_is_not_overwritten_by_the_next() {
        let bytes = framed(&[vec![1; BIG], vec![2; BIG], vec![3; BIG]]);
        let mut stream = bytes.as_slice();
        let mut frames = FrameReader::new(BytesMut::new(), 1 << 20);
        let first = frames.next(&mut stream).await.unwrap().unwrap();
        drop(frames.next(&mut stream).await.unwrap().unwrap());
        let third = frames.next(&mut stream).await.unwrap().unwrap();
        assert!(first.iter().all(|byte| *byte == 1));
        assert!(third.iter().all(|byte| *byte == 3));
    }
}
