//! Send queue of one subscriber: bounded, drops the oldest messages, writes several messages per system call.

use std::io::{self, IoSlice};

use bytes::Bytes;
use parking_lot::Mutex;
use ros_bus::ring::{DropTally, Ring, RingBounds};
use tokio::io::{AsyncWrite, AsyncWriteExt as _};
use tokio::sync::Notify;

/// Maximum number of messages, and of bytes, taken from the queue for one write.
const BATCH: usize = 256;
const BATCH_BYTES: usize = 1 << 20;

/// The queue of one connection.
#[derive(Debug)]
pub struct SendQueue {
    state: Mutex<State>,
    ready: Notify,
}

#[derive(Debug)]
struct State {
    /// Latched messages for a new subscriber, not displaced by newer messages.
    first: Vec<Bytes>,
    ring: Ring<Bytes>,
    closed: bool,
}

impl SendQueue {
    /// Creates a queue for at most `capacity` messages (0 counts as 1) and 64 MiB, after `first`, which is not bounded.
    pub fn new(capacity: usize, first: impl IntoIterator<Item = Bytes>) -> Self {
        Self {
            state: Mutex::new(State {
                first: first.into_iter().collect(),
                ring: Ring::new(RingBounds::with_messages(capacity)),
                closed: false,
            }),
            ready: Notify::new(),
        }
    }

    /// Queues a message; older ones may be dropped to make room.
    pub fn push(&self, message: Bytes) -> DropTally {
        let lost = {
            let mut state = self.state.lock();
            if state.closed {
                return DropTally::default();
            }
            state.ring.push(message)
        };
        self.ready.notify_one();
        lost
    }

    /// Accepts no more messages; [`SendQueue::drain`] returns once the queued ones have been sent.
    pub fn close(&self) {
        self.state.lock().closed = true;
        self.ready.notify_one();
    }

    /// Sends queued messages as they come, until closed.
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
        batch.append(&mut state.first);
        let mut bytes = 0;
        while batch.len() < BATCH && bytes < BATCH_BYTES {
            let Some(message) = state.ring.pop() else {
                break;
            };
            bytes += message.len();
            batch.push(message);
        }
        !batch.is_empty()
    }
}

/// Writes messages, each with its length in front, without copying them.
pub async fn write_messages(stream: &mut (impl AsyncWrite + Unpin), messages: &[Bytes]) -> io::Result<()> {
    let prefixes: Vec<[u8; 4]> = messages.iter().map(|message| (message.len() as u32).to_le_bytes()).collect();
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
    use crate::tcpros::FrameReader;

    fn message(byte: u8, size: usize) -> Bytes {
        Bytes::from(vec![byte; size])
    }

    async fn drain_messages(send_queue: &SendQueue) -> Vec<Bytes> {
        let (mut ours, mut theirs) = tokio::io::duplex(1000);
        send_queue.close();
        let reading = tokio::spawn(async move {
            let mut frames = FrameReader::new(BytesMut::new(), 1 << 20);
            let mut messages = Vec::new();
            while let Some(message) = frames.next(&mut theirs).await.unwrap() {
                messages.push(message);
            }
            messages
        });
        send_queue.drain(&mut ours).await.unwrap();
        drop(ours);
        reading.await.unwrap()
    }

    #[tokio::test]
    async fn newest_win() {
        let send_queue = SendQueue::new(2, []);
        let mut lost = DropTally::default();
        for n in 0..5 {
            lost += send_queue.push(message(n, 10));
        }
        assert_eq!(lost.messages, 3);
        assert_eq!(drain_messages(&send_queue).await, [message(3, 10), message(4, 10)]);
    }

    #[tokio::test]
    async fn all_sizes_arrive_in_order() {
        let all: Vec<Bytes> = (0..=255).map(|n| message(n, usize::from(n) * 50)).collect();
        let send_queue = SendQueue::new(1000, []);
        for one in all.iter().chain(&all) {
            assert_eq!(send_queue.push(one.clone()).messages, 0);
        }
        assert_eq!(drain_messages(&send_queue).await, [all.clone(), all].concat());
    }

    #[tokio::test]
    async fn what_newcomers_are_given_is_not_dropped() {
        let send_queue = SendQueue::new(1, [message(1, 1), message(2, 1), message(3, 1)]);
        assert_eq!(drain_messages(&send_queue).await.len(), 3);
    }
}
