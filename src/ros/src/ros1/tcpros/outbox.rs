//! What waits to be sent to one subscriber: bounded, newest wins, several messages to one system call.

use std::collections::VecDeque;
use std::io::{self, IoSlice};

use bytes::Bytes;
use parking_lot::Mutex;
use tokio::io::{AsyncWrite, AsyncWriteExt as _};
use tokio::sync::Notify;

/// However long the queue is, it holds no more bytes than this (but always one message).
const MAX_BYTES: usize = 64 << 20;
/// Messages and bytes taken from the queue for one round of writing.
const BATCH: usize = 256;
const BATCH_BYTES: usize = 1 << 20;

/// The queue of one connection.
#[derive(Debug)]
pub struct Outbox {
    state: Mutex<State>,
    capacity: usize,
    ready: Notify,
}

#[derive(Debug, Default)]
struct State {
    queue: VecDeque<Bytes>,
    bytes: usize,
    closed: bool,
}

impl Outbox {
    /// A queue for at most `capacity` messages (0 counts as 1), which begins with `first`, however many.
    pub fn new(capacity: usize, first: impl IntoIterator<Item = Bytes>) -> Self {
        let queue: VecDeque<Bytes> = first.into_iter().collect();
        let bytes = queue.iter().map(Bytes::len).sum();
        Self {
            capacity: capacity.max(1).max(queue.len()),
            state: Mutex::new(State {
                queue,
                bytes,
                closed: false,
            }),
            ready: Notify::new(),
        }
    }

    /// Queues a message; how many older ones had to go for it.
    pub fn push(&self, message: Bytes) -> u64 {
        let mut lost = 0;
        {
            let mut state = self.state.lock();
            if state.closed {
                return 0;
            }
            while state.queue.len() >= self.capacity
                || (state.bytes + message.len() > MAX_BYTES && !state.queue.is_empty())
            {
                let Some(oldest) = state.queue.pop_front() else {
                    break;
                };
                state.bytes -= oldest.len();
                lost += 1;
            }
            state.bytes += message.len();
            state.queue.push_back(message);
        }
        self.ready.notify_one();
        lost
    }

    /// Takes no more messages; [`Outbox::drain`] ends when what is queued was sent.
    pub fn close(&self) {
        self.state.lock().closed = true;
        self.ready.notify_one();
    }

    /// Sends what is queued and what comes, until closed.
    pub async fn drain(&self, stream: &mut (impl AsyncWrite + Unpin)) -> io::Result<()> {
        let mut batch = Vec::new();
        loop {
            if self.take(&mut batch) {
                write_messages(stream, &batch).await?;
                batch.clear();
                continue;
            }
            if self.state.lock().closed {
                return Ok(());
            }
            batch.shrink_to(16);
            self.ready.notified().await;
        }
    }

    fn take(&self, batch: &mut Vec<Bytes>) -> bool {
        let mut state = self.state.lock();
        let mut bytes = 0;
        while batch.len() < BATCH && bytes < BATCH_BYTES {
            let Some(message) = state.queue.pop_front() else {
                break;
            };
            bytes += message.len();
            batch.push(message);
        }
        state.bytes -= bytes;
        !batch.is_empty()
    }
}

/// Writes messages, each with its length before it, without copying them.
pub async fn write_messages(
    stream: &mut (impl AsyncWrite + Unpin),
    messages: &[Bytes],
) -> io::Result<()> {
    let prefixes: Vec<[u8; 4]> = messages
        .iter()
        .map(|message| (message.len() as u32).to_le_bytes())
        .collect();
    let mut slices: Vec<IoSlice<'_>> = Vec::with_capacity(2 * messages.len());
    for (prefix, message) in prefixes.iter().zip(messages) {
        slices.push(IoSlice::new(prefix));
        if !message.is_empty() {
            slices.push(IoSlice::new(message));
        }
    }
    let mut rest = slices.as_mut_slice();
    while !rest.is_empty() {
        let written = stream.write_vectored(rest).await?;
        if written == 0 {
            return Err(io::ErrorKind::WriteZero.into());
        }
        IoSlice::advance_slices(&mut rest, written);
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use bytes::BytesMut;

    use super::*;
    use crate::ros1::tcpros::FrameReader;

    fn message(byte: u8, size: usize) -> Bytes {
        Bytes::from(vec![byte; size])
    }

    async fn sent(outbox: &Outbox) -> Vec<Bytes> {
        let (mut ours, mut theirs) = tokio::io::duplex(1000);
        outbox.close();
        let reading = tokio::spawn(async move {
            let mut frames = FrameReader::new(BytesMut::new(), MAX_BYTES * 2);
            let mut messages = Vec::new();
            while let Some(message) = frames.next(&mut theirs).await.unwrap() {
                messages.push(message);
            }
            messages
        });
        outbox.drain(&mut ours).await.unwrap();
        drop(ours);
        reading.await.unwrap()
    }

    #[tokio::test]
    async fn newest_win() {
        let outbox = Outbox::new(2, []);
        let lost: u64 = (0..5).map(|n| outbox.push(message(n, 10))).sum();
        assert_eq!(lost, 3);
        assert_eq!(sent(&outbox).await, [message(3, 10), message(4, 10)]);
    }

    #[tokio::test]
    async fn all_sizes_arrive_in_order() {
        let all: Vec<Bytes> = (0..=255).map(|n| message(n, usize::from(n) * 50)).collect();
        let outbox = Outbox::new(1000, []);
        for one in all.iter().chain(&all) {
            assert_eq!(outbox.push(one.clone()), 0);
        }
        assert_eq!(sent(&outbox).await, [all.clone(), all].concat());
    }

    #[tokio::test]
    async fn bytes_are_bounded_but_one_message_always_fits() {
        let outbox = Outbox::new(1000, []);
        assert_eq!(outbox.push(message(1, MAX_BYTES / 2 + 1)), 0);
        assert_eq!(outbox.push(message(2, MAX_BYTES / 2 + 1)), 1);
        assert_eq!(outbox.push(message(3, MAX_BYTES + 1)), 1);
        assert_eq!(outbox.state.lock().bytes, MAX_BYTES + 1);
    }

    #[tokio::test]
    async fn what_newcomers_are_given_is_not_dropped() {
        let outbox = Outbox::new(1, [message(1, 1), message(2, 1), message(3, 1)]);
        assert_eq!(sent(&outbox).await.len(), 3);
    }
}
